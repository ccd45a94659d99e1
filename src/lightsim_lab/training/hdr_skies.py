"""Pool of measured skies: HDR panoramas at working resolution, each with its sun separated."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun, find_sun, irradiance, split_sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.lighting.sky.clear_sky import clear_sky_parts
from lightsim.progress import Progress, SilentProgress
from lightsim.store.images import read_sky
from lightsim.store.reading import read_bytes

Side = Literal["train", "validation", "test"]
Split = Literal["train", "validation", "test", "out"]
Tier = Literal["A", "B", "C"]
Scene = Literal["ground", "none", "canopy"]
COLUMNS = ("name", "split", "group", "tier", "scene", "reason")
# Largest accepted size of a split file: about a hundred thousand lines.
_MAX_SPLIT_BYTES = 16 << 20
_SUFFIXES = (".hdr", ".exr")
# World z axis: normal of level ground.
_UP = np.array([0.0, 0.0, 1.0])
# Radius of the spot about the brightest pixel whose centre is the sun's direction, in degrees.
# Sensitivity not measured.
_SPOT_DEG = 6.0
# Turbidity of the model whose sun replaces a clipped sun: a clear, slightly hazy day. Not fitted.
_REPLACEMENT_TURBIDITY = 3.5
# Quantile of the upper half's blue radiance at which brighter sky is clipped before the threshold.
# Sensitivity not measured.
_SKY_CLIP_QUANTILE = 0.4
# Minimum ratio of the geometric mean blue radiances of sky and scene; below it both classes are
# sky. Sensitivity not measured.
_CLASS_RATIO = 2.5


@dataclass(frozen=True)
class SplitEntry:
    """Line of the split file: side and properties of one sky file.

    Args:
        split: "validation" selects among trainings, "test" is for releases, "out" is unused
            (night, or no open sky).
        group: common name of files of one place, series or sky; all of a group are on one side.
        tier: A: sun measured; B: no sun disc, or a veiled one; C: sun clipped in the recording.
        scene: "ground": the lower half shows a real place; "none": only sky; "canopy": trees or
            roofs occlude most of the sky, which therefore cannot light other scenes.
    """

    name: str
    split: Split
    group: str
    tier: Tier
    scene: Scene


@dataclass(frozen=True, eq=False)
class HdrSky:
    """Measured sky at working resolution; its median luminance above the horizon is 1.

    Args:
        rest: radiance of the whole panorama without the sun.
        sun: the sun, or None if there is no distinct bright spot.
        sky_seen: pixels of the upper half that show sky instead of scene.
    """

    entry: SplitEntry
    rest: Float32[np.ndarray, "h w 3"]
    sun: Sun | None
    sky_seen: Bool[np.ndarray, "h/2 w"]


def read_split(path: Path) -> dict[str, SplitEntry]:
    """Return the entries of a split file by file stem.

    Raises:
        InputError: the file is missing, a column or value is wrong, a name occurs twice, or a
            group is on several sides.
    """
    text = read_bytes(path, "split file", _MAX_SPLIT_BYTES).decode()
    reader = csv.DictReader(io.StringIO(text, newline=""))
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise InputError(
            "the split file has the wrong columns",
            where=path,
            got=reader.fieldnames,
            expected=COLUMNS,
        )
    rows = list(reader)
    entries: dict[str, SplitEntry] = {}
    side: dict[str, str] = {}
    for row in rows:
        entry = _entry(row, path)
        if entry.name in entries:
            raise InputError(
                "a name occurs twice", where=path, got=entry.name, expected="one line per file"
            )
        if entry.split != "out" and side.setdefault(entry.group, entry.split) != entry.split:
            raise InputError(
                "a group is on several sides",
                where=path,
                got=entry.group,
                expected="all files of a group in train, in validation or in test",
            )
        entries[entry.name] = entry
    return entries


def _entry(row: Mapping[str, str], path: Path) -> SplitEntry:
    allowed = {
        "split": ("train", "validation", "test", "out"),
        "tier": ("A", "B", "C"),
        "scene": ("ground", "none", "canopy"),
    }
    for column, choices in allowed.items():
        if row[column] not in choices:
            raise InputError(
                f"the {column} of '{row['name']}' is unknown",
                where=path,
                got=row[column],
                expected=choices,
            )
    split: Split = row["split"]  # type: ignore[assignment]
    tier: Tier = row["tier"]  # type: ignore[assignment]
    scene: Scene = row["scene"]  # type: ignore[assignment]
    return SplitEntry(row["name"], split, row["group"], tier, scene)


def split_hash(entries: Iterable[SplitEntry]) -> str:
    """Return the SHA-256 of the sorted lines `name,side` of all skies in use."""
    lines = sorted(f"{entry.name},{entry.split}\n" for entry in entries if entry.split != "out")
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def read_pool(
    folder: Path,
    split: Mapping[str, SplitEntry] | None,
    height_px: int,
    progress: Progress | None = None,
) -> tuple[HdrSky, ...]:
    """Read the skies of a folder that the split uses; without a split all files train.

    Raises:
        InputError: the folder has no .hdr or .exr file, or a file is missing in the split.
    """
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in _SUFFIXES)
    if not paths:
        raise InputError(
            "the folder contains no .hdr or .exr file",
            where=folder,
            remedy="Give the folder with the panoramas as --hdri.",
        )
    skies = []
    for path in (progress or SilentProgress()).track(paths, "measured skies"):
        entry = None if split is None else split.get(path.stem)
        if split is not None and entry is None:
            raise InputError(
                "the split has no line for this file",
                where=path,
                remedy="Add a line, or omit --split to train on all files.",
            )
        if entry is None or entry.split != "out":
            skies.append(measured_sky(read_sky(path).radiance, path.stem, entry, height_px))
    return tuple(skies)


def measured_sky(
    radiance: Float32[np.ndarray, "h w 3"], name: str, entry: SplitEntry | None, height_px: int
) -> HdrSky:
    """Convert an HDR panorama to a sky at working resolution, with its sun separated.

    A sun that was clipped in the recording (tier C) gets at least the irradiance of the clear sun
    of the Hosek-Wilkie model (turbidity 3.5, same elevation), relative to the skylight.

    Args:
        entry: None: the tier is estimated from the brightest spot, and the lower half is ground.
    """
    if entry is None:
        entry = SplitEntry(name, "train", name, _tier_of(radiance), "ground")
    sun = find_sun(radiance)
    # A clipped disc may be too weak for `find_sun`; its direction is still that of the brightest
    # spot.
    if entry.tier == "C" and sun is None:
        sun = Sun(_brightest(radiance), np.zeros(3, np.float32))
    if sun is None:
        rest = radiance
    else:
        rest, parted = split_sun(SkyDome(radiance, sun))
        sun = parted or sun
    # Under a canopy the skylight is blocked, and gives no estimate of the sun's irradiance.
    if sun is not None and entry.tier == "C" and entry.scene != "canopy":
        sun = _raised(rest, sun)
    small = shrunk(rest, height_px)
    unit = max(float(np.median(luminance(small[: height_px // 2]))), 1e-6)
    if sun is not None:
        irradiance_rgb = (sun.irradiance / unit).astype(np.float32)
        sun = Sun(sun.direction_world, irradiance_rgb)
    # The cache stores half precision, whose largest number is 65504.
    small = np.minimum(small / unit, 6e4).astype(np.float32)
    return HdrSky(entry, small, sun, sky_mask(small, entry.scene == "none"))


def shrunk(radiance: Float32[np.ndarray, "a b 3"], height_px: int) -> Float32[np.ndarray, "h w 3"]:
    """Resize a panorama by means weighted by solid angle, which preserves every irradiance."""
    height, width = radiance.shape[:2]
    weight = np.broadcast_to(solid_angles_sr(height)[..., None], (height, width, 1))
    weight = weight.astype(np.float32)
    size = (height_px, 2 * height_px)
    return resize_area(radiance * weight, *size) / resize_area(weight.copy(), *size)


def sky_mask(panorama: Float32[np.ndarray, "h w 3"], is_all_sky: bool) -> Bool[np.ndarray, "h/2 w"]:
    """Return the sky pixels of the upper half of an HDR panorama: those of high blue radiance.

    The threshold is that of Otsu (1979, doi:10.1109/TSMC.1979.4310076), weighted by solid angle.
    The brightest part is clipped first; otherwise the aureole of a clear sky is a separate class.
    Small regions are removed.
    """
    from scipy import ndimage

    half = panorama.shape[0] // 2
    if is_all_sky:
        return np.ones((half, panorama.shape[1]), dtype=bool)
    value = np.log(np.maximum(panorama[:half, :, 2], 1e-6)).astype(np.float64)
    weight = np.repeat(solid_angles_sr(2 * half)[:half], value.shape[1], axis=1)
    value = np.minimum(value, _weighted_quantile(value, weight, _SKY_CLIP_QUANTILE))
    bright = value > _otsu(value, weight)
    width = bright.shape[1]
    # Three copies side by side, so that regions connect across the seam at azimuth 180 degrees.
    wide = np.concatenate([bright, bright, bright], axis=1)
    labelled, _ = ndimage.label(wide)  # type: ignore[misc]
    labels = np.asarray(labelled)[:, width : 2 * width]
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.isin(labels, np.flatnonzero(sizes >= max(4, 0.01 * value.size)))


def _weighted_quantile(
    value: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"], quantile: float
) -> float:
    order = np.argsort(value, axis=None)
    mass = np.cumsum(weight.ravel()[order])
    return float(value.ravel()[order[int(np.searchsorted(mass, quantile * mass[-1]))]])


def _otsu(value: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"]) -> float:
    """Return Otsu's threshold, or minus infinity if the two classes are too close."""
    edges = np.linspace(float(value.min()), float(value.max()) + 1e-9, 65)
    mass, _ = np.histogram(value, edges, weights=weight)
    centre = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(mass)[:-1]
    above = mass.sum() - below
    first = np.cumsum(mass * centre)
    low = first[:-1] / np.maximum(below, 1e-12)
    high = (first[-1] - first[:-1]) / np.maximum(above, 1e-12)
    # Otsu's criterion: variance between the classes, up to a constant factor.
    best = int(np.argmax(below * above * (high - low) ** 2))
    is_one_class = high[best] - low[best] < np.log(_CLASS_RATIO)
    return -np.inf if is_one_class else float(edges[best + 1])


def _tier_of(radiance: Float32[np.ndarray, "h w 3"]) -> Tier:
    """Estimate the tier: C if several pixels have the largest value, as in a clipped disc."""
    upper = luminance(radiance[: radiance.shape[0] // 2])
    is_flat = int((upper >= 0.98 * upper.max()).sum()) > 6
    has_spot = float(upper.max()) > 20 * float(np.median(upper))
    if is_flat and has_spot:
        return "C"
    return "A" if find_sun(radiance) is not None else "B"


def _brightest(radiance: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"]:
    """Return the direction of the brightest spot of a panorama's upper half."""
    half = radiance.shape[0] // 2
    value = luminance(radiance[:half]).astype(np.float64)
    return spot_centre(value, pixel_directions(2 * half)[:half], 0.5)


def spot_centre(
    value: Float[np.ndarray, "h w"], directions: Float[np.ndarray, "h w 3"], level: float
) -> Float[np.ndarray, "3"]:
    """Return the direction of the luminance-weighted centre of an upper half's brightest spot.

    Args:
        value: luminance.
        directions: unit directions of the pixels.
        level: smallest luminance of the spot, relative to its peak.
    """
    peak = directions.reshape(-1, 3)[int(value.argmax())]
    near = (directions @ peak > np.cos(np.radians(_SPOT_DEG))) & (value > level * value.max())
    weight = np.where(near, value, 0.0) * solid_angles_sr(2 * len(value))[: len(value)]
    centre = np.einsum("hw,hwc->c", weight, directions)
    return centre / np.linalg.norm(centre)


def _raised(rest: Float32[np.ndarray, "h w 3"], sun: Sun) -> Sun:
    """Return the sun, at least as strong as the model's clear sun for the same skylight."""
    direction = sun.direction_world
    # The model has no clear sun at the horizon (elevations below about 1 degree).
    if direction[2] <= 0.02:
        return sun
    height = rest.shape[0]
    upper = rest.copy()
    upper[height // 2 :] = 0
    model_sky, model_sun = clear_sky_parts(direction, _REPLACEMENT_TURBIDITY, 0.2, 32)
    skylight = luminance(irradiance(upper, _UP).astype(np.float32))
    model_skylight = luminance(irradiance(model_sky, _UP).astype(np.float32))
    raised = model_sun.irradiance * float(skylight / model_skylight)
    return Sun(direction, np.maximum(raised, sun.irradiance).astype(np.float32))


def skies_of_side(hdri: Path | None, split: Path | None, side: Side) -> list[Path]:
    """Return the complete measured skies of a side, ordered by name; empty without a folder.

    Raises:
        InputError: the split is missing or wrong, or the folder has no sky of the side.
    """
    if hdri is None:
        return []
    if split is None:
        raise InputError(
            "no train/test split is given for the skies",
            where="--hdri",
            remedy="Give --split, which keeps training, validation and test skies apart.",
        )
    entries = read_split(split)
    files = sorted(p for p in hdri.iterdir() if p.suffix.lower() in _SUFFIXES)
    found = [p for p in files if p.stem in entries and _is_open(entries[p.stem], side)]
    if not found:
        raise InputError(
            f"the folder contains no sky of the {side} side",
            where=hdri,
            expected=f".hdr or .exr files of this side in {split}",
        )
    return found


def _is_open(entry: SplitEntry, side: Side) -> bool:
    """Return whether a sky is on a side, its sun is not clipped, and trees do not cover it."""
    return entry.split == side and entry.tier != "C" and entry.scene != "canopy"


def some_of(skies: Sequence[Path], seed: int, count: int) -> list[Path]:
    """Draw `count` skies for the street or log of a seed; the draw does not depend on other
    streets."""
    # The second number separates this stream from others of the same seed.
    order = np.random.default_rng([seed, 17]).permutation(len(skies))
    return [skies[k] for k in order[:count]]
