"""What is wrong with each pixel of a relit frame, and what it costs.

    python benchmarks/relight_faults.py WORK --truth DIR [--made WORK/scenarios/NAME]
        [--only low_sun/front_camera/03 ...] [--by fault|material]

Pixels of the frames that have exact buffers (of streets of the benchmark, which have none: of all
frames that are relit), each counted with the first fault that it has: the target sun's shadow, the
source sun's visibility, depth (0.3 m or 2 %), normal (20 degrees), and then by what it shows. --by
material: with what is truly seen there instead, steep ground apart.
--made: pictures that a method made under several skies (those of `lightsim evaluate relight`)
instead of the physical estimate; --only: a table of single pictures, TARGET/CAMERA/STEM each.
Fraction of the surface, fraction of the squared error and root of its mean (sRGB, 0 to 1), and the
median of the log of made over true luminance, which tells too bright from too dark; Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from relight_parts import Street, TracedFrame
from target_shadows import true_parts

from lightsim.core.buffers import BACKGROUND
from lightsim.core.colour import linear_from_srgb, luminance
from lightsim.core.dome import SkyDome
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.images import read_srgb8

_DEPTH_M, _DEPTH_FRACTION = 0.3, 0.02
_LEAST_COSINE = float(np.cos(np.radians(20.0)))
_LEVEL, _UPRIGHT = 0.9, 0.3
_DARKEST = 1 / 255
_GROUND = ("road", "earth", "kerb", "sidewalk")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--made", type=Path)
    parser.add_argument("--only", nargs="+", default=())
    parser.add_argument("--by", choices=("fault", "material"), default="fault")
    options = parser.parse_args()
    if any(words.count("/") != 2 for words in options.only):
        parser.error("--only takes pictures as TARGET/CAMERA/STEM: low_sun/front_camera/03")
    street = Street(options.work, options.truth)
    materials = _Materials(street, options.truth) if options.by == "material" else None
    counts: dict[tuple[str, str], np.ndarray] = defaultdict(lambda: np.zeros(2))
    ratios: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    named = {(words.split("/")[1], words.split("/")[2]) for words in options.only}
    for camera, stem in sorted(named) or _frames(options.truth):
        is_asked = {t: f"{t}/{camera}/{stem}" in options.only for t in street.targets()}
        targets = [target for target, is_wanted in is_asked.items() if is_wanted or not named]
        seen = street.frame(camera, stem)
        for target in targets:
            file = options.truth / "relit" / target / camera / f"{stem}.jpg"
            made, true = _made(options, street, seen, target), read_srgb8(file) / 255
            square = np.square(made - true).mean(axis=-1)
            here, there = (luminance(linear_from_srgb(picture)) for picture in (made, true))
            ratio = np.log(np.maximum(here, _DARKEST) / np.maximum(there, _DARKEST))
            row = f"{target}, {camera} {stem}" if named else target
            left = seen.is_surface.copy()
            if materials is None:
                parts = _faults(street, seen, street.skies[target])
            else:
                parts = materials.seen_by(seen)
            for fault, members in parts:
                counts[row, fault] += [(left & members).sum(), square[left & members].sum()]
                ratios[row, fault].append(ratio[left & members].astype(np.float32))
                left &= ~members
    sys.stdout.write(_table(counts, {key: np.concatenate(own) for key, own in ratios.items()}))


def _frames(truth: Path) -> list[tuple[str, str]]:
    """Camera and stem of frames that have exact buffers; of streets of the benchmark, which have
    none, of all that were relit."""
    buffers = sorted((truth / "base_colour").glob("*/*.exr"))
    pictures = buffers or (truth / "relit").glob("*/*/*.jpg")
    return sorted({(path.parent.name, path.stem) for path in pictures})


def _made(
    options: argparse.Namespace, street: Street, seen: TracedFrame, target: str
) -> np.ndarray:
    """The relit picture, sRGB from 0 to 1."""
    if options.made is None:
        return street.relit(seen, "estimated", target) / 255
    folder = options.made / target / "frames" / seen.frame.camera_name
    return read_srgb8(folder / f"{seen.frame.stem}.png") / 255


def _faults(street: Street, seen: TracedFrame, target: SkyDome) -> Iterator[tuple[str, np.ndarray]]:
    """In the order in which they are told."""
    estimated, true = seen.estimated.buffers, seen.true.buffers
    off = np.abs(
        np.where(estimated.has_surface, estimated.depth_z_m, 1e6)
        - np.where(true.has_surface, true.depth_z_m, 0.0)
    )
    is_elsewhere = off > np.maximum(_DEPTH_M, _DEPTH_FRACTION * true.depth_z_m)
    if target.sun is not None:
        is_lit, lit_here = (
            traced.light(target).sun_visibility > 0.5 for traced in (seen.true, seen.estimated)
        )
        yield "false target shadow", is_lit & ~lit_here & ~is_elsewhere
        yield "missing target shadow", ~is_lit & lit_here & ~is_elsewhere
    source = street.skies["estimated"]
    visibility = seen.estimated.light(source).sun_visibility
    found = seen.estimated.found_visibility(source.sun)
    if found is not None:
        # Where none was found, relighting takes the rendered one.
        visibility = np.where(np.isfinite(found), found, visibility)
    yield "source visibility", (visibility > 0.5) != (seen.visibility > 0.5)
    yield "depth", is_elsewhere
    cosine = (estimated.normal_world * true.normal_world).sum(axis=-1)
    yield "normal", cosine < _LEAST_COSINE
    yield "none, ground", true.normal_world[..., 2] > _LEVEL
    yield "none, upright", np.abs(true.normal_world[..., 2]) < _UPRIGHT
    yield "none, other", np.ones_like(is_elsewhere)


class _Materials:
    """What the pixels of a street truly show."""

    def __init__(self, street: Street, truth: Path) -> None:
        self._parts = true_parts(truth)
        self._caster = make_embree_caster(list(self._parts.values()))
        self._log = street.log

    def seen_by(self, seen: TracedFrame) -> Iterator[tuple[str, np.ndarray]]:
        """Materials and their pixels."""
        true = seen.true.buffers
        is_background = true.actor_index == BACKGROUND
        yield "actors", true.has_surface & ~is_background
        camera = self._log.cameras[seen.frame.camera_name]
        pixels = camera.pixel_centres()[is_background]
        rays = seen.frame.world_from_camera.rotate(camera.directions(pixels))
        eye = seen.frame.world_from_camera.translation_m
        hits = self._caster.intersect(np.broadcast_to(eye, rays.shape).copy(), rays)
        part = np.full(is_background.shape, -1)
        part[is_background] = np.where(hits.is_hit, hits.mesh_index, -1)
        is_steep = np.abs(true.normal_world[..., 2]) < _UPRIGHT
        for number, name in enumerate(self._parts):
            if name in _GROUND:
                yield f"{name}, steep", (part == number) & is_steep
            yield name, part == number


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _table(
    counts: dict[tuple[str, str], np.ndarray], ratios: dict[tuple[str, str], np.ndarray]
) -> str:
    lines = ["| target | fault | surface | squared error | rms | log |", f"|---|---|{'---:|' * 4}"]
    told: set[str] = set()
    for (target, fault), (area, error) in counts.items():
        total = np.sum([found for (name, _), found in counts.items() if name == target], axis=0)
        if target not in told:
            told.add(target)
            rms = np.sqrt(total[1] / total[0])
            lines.append(f"| {target} | all, {-20 * np.log10(rms):.1f} dB | 1 | 1 | {rms:.3f} | |")
        lines.append(
            f"| {target} | {fault} | {area / total[0]:.3f} | {error / total[1]:.3f} |"
            f" {np.sqrt(error / max(area, 1)):.3f} | {_median(ratios[target, fault]):+.2f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
