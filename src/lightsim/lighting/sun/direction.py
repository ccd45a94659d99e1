"""Sun direction in frame `world`, from place and time or from the panorama."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from lightsim.core.colour import luminance
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.log import GeoReference
from lightsim.core.solar import angle_between_deg, direction_world
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.sky.clear_sky import GROUND_ALBEDO, clear_sky_parts, overcast_shape

# Standard deviation of a heading whose residual was not recorded, in degrees; an assumption.
UNKNOWN_HEADING_STD_DEG = 1.0

# Sensitivity to the following constants was not measured.

# Smallest and largest radius of a clipped spot that may be the sun, in degrees. Smaller spots are
# glints or lamps, because lens and air widen the sun; larger ones are clouds.
_BLOB_RADIUS_DEG = (0.3, 12.0)
# Usual radius of the sun's clipped spot, in degrees.
_TYPICAL_SUN_RADIUS_DEG = 1.5
# Fraction of its bounding disc that a spot fills, at least: the sun's spot is round.
_BLOB_MIN_FILL = 0.1
# Largest gap between pieces of one spot, in degrees.
_PIECE_GAP_DEG = 1.0


@dataclass(frozen=True, eq=False)
class SunDirection:
    """Direction of the sun, with its uncertainty and its source.

    Args:
        direction_world: unit vector towards the sun.
        azimuth_deg: clockwise from true north, or None where the heading is unknown.
        origin: "gps+time", "time+image" (heading unknown) or "image".
        uncertainty_deg: one standard deviation of each component of its error.
        notes: evidence of the estimate.
        sunny_probability: probability that it casts shadows; None where it was not estimated.
    """

    direction_world: Float[np.ndarray, "3"]
    azimuth_deg: float | None
    elevation_deg: float
    origin: str
    uncertainty_deg: float
    notes: tuple[str, ...] = ()
    sunny_probability: float | None = None


@dataclass(frozen=True, eq=False)
class SunBlob:
    """Compact clipped spot of the observed sky.

    Args:
        direction_world: its solid-angle-weighted centre.
        radius_deg: radius of the disc of equal solid angle.
        is_cut: it touches pixels that were not observed as sky, so that its centre is biased.
        plausibility: relative weight among the spots of one panorama; an isolated, round spot of
            usual size in a uniform sky has about 1.
    """

    direction_world: Float[np.ndarray, "3"]
    radius_deg: float
    is_cut: bool
    plausibility: float = 1.0


def sun_from_geo(geo: GeoReference, time_ns: int) -> SunDirection:
    """Return the sun of place and time, rotated into frame `world`.

    The uncertainty combines those of heading, levelling, place and clock.

    Args:
        time_ns: of the log's clock.

    Raises:
        InputError: place, time or heading is unknown, or the sun is below the horizon.
    """
    if geo.enu_from_world is None:
        raise InputError(
            "the heading of the log is unknown, so the sun cannot be placed by time alone",
            remedy="Give it with --heading-deg (azimuth of world +x, clockwise from north).",
        )
    position = geo.sun_at(time_ns)
    if position is None:
        raise InputError(
            "place or time of the log is unknown, so the position of the sun is, too",
            remedy="Give them with --place and --utc, or the sun with --sun.",
        )
    if position.elevation_deg <= 0:
        raise InputError(
            "the sun is below the horizon: twilight and night are not modelled",
            got=f"elevation {position.elevation_deg:.2f} degrees",
            remedy="Give an HDR file as the sky.",
        )
    direction = direction_world(position.azimuth_deg, position.elevation_deg, geo.enu_from_world)
    residual_deg = geo.heading_residual_deg
    heading_deg = UNKNOWN_HEADING_STD_DEG if residual_deg is None else residual_deg
    return SunDirection(
        direction,
        position.azimuth_deg,
        position.elevation_deg,
        "gps+time",
        float(np.hypot(heading_deg, geo.sun_std_deg)),
        (f"heading: {geo.heading_origin}, {heading_deg:.2f} degrees",),
    )


def find_sun_blob(
    panorama: Panorama, near_world: Float[np.ndarray, "3"] | None = None
) -> SunBlob | None:
    """Return the most plausible clipped spot of the sky, or None.

    With `near_world`, return the nearest spot that touches or lies within 8 degrees of it.
    """
    blobs = find_sun_blobs(panorama)
    if near_world is None:
        return max(blobs, key=lambda blob: blob.plausibility, default=None)
    off_deg = [angle_between_deg(blob.direction_world, near_world) for blob in blobs]
    near = [
        (off, blob)
        for off, blob in zip(off_deg, blobs, strict=True)
        if off <= 8.0 + blob.radius_deg
    ]
    return min(near, key=lambda pair: pair[0])[1] if near else None


def find_sun_blobs(panorama: Panorama) -> list[SunBlob]:
    """Return all clipped spots of the sky that may be the sun: connected, smaller than a disc of 12
    degrees radius, and filling 10 % of their own bounding disc."""
    mask = panorama.is_sky & panorama.is_clipped & panorama.is_seen
    # Thin cloud and cables divide the spot: pieces up to a degree apart are joined.
    pieces_px = max(1, round(mask.shape[0] * _PIECE_GAP_DEG / 180.0))
    padded = np.pad(mask, ((0, 0), (pieces_px, pieces_px)), mode="wrap")
    grown = ndimage.binary_dilation(padded, iterations=pieces_px)[:, pieces_px:-pieces_px]
    labels = np.where(mask, _wrapped_labels(grown), 0)
    unseen = ndimage.binary_dilation(~panorama.is_sky, iterations=2)
    value = luminance(panorama.radiance)
    usable = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    directions = pixel_directions(mask.shape[0])[usable]
    sky = _Glow(directions, value[usable].astype(np.float64))
    found = [_describe_blob(labels == i, unseen, sky) for i in np.unique(labels[labels > 0])]
    return [blob for blob in found if blob is not None]


class _Glow:
    """Brightness of the sky around a spot, relative to the whole sky."""

    def __init__(
        self, directions: Float[np.ndarray, "n 3"], value: Float[np.ndarray, " n"]
    ) -> None:
        self._directions, self._value = directions, value
        self._usual = float(np.median(value)) if len(value) else 1.0

    def around(self, centre: Float[np.ndarray, "3"], radius_deg: float) -> float:
        """Mean radiance within twice the radius plus 2 degrees of `centre`, over the whole sky's
        median."""
        cosine = self._directions @ centre
        ring = cosine > np.cos(np.radians(2.0 * radius_deg + 2.0))
        if not ring.any():
            return 1.0
        return float(self._value[ring].mean()) / max(self._usual, 1e-6)


def _describe_blob(
    mask: Bool[np.ndarray, "h w"], unseen: Bool[np.ndarray, "h w"], sky: _Glow
) -> SunBlob | None:
    """Return the spot of a mask with its plausibility; None if it cannot be the sun."""
    height = mask.shape[0]
    row, column = np.nonzero(mask)
    weight = solid_angles_sr(height)[row, 0]
    area_sr = float(weight.sum())
    directions = pixel_directions(height)[row, column]
    centre = weight @ directions
    centre /= np.linalg.norm(centre)
    radius_deg = float(np.degrees(np.sqrt(area_sr / np.pi)))
    smallest_deg, largest_deg = _BLOB_RADIUS_DEG
    if not smallest_deg <= radius_deg <= largest_deg:
        return None
    cosine = np.clip(directions @ centre, -1.0, 1.0)
    extent_deg = float(np.degrees(np.arccos(np.percentile(cosine, 10))))
    fill = (radius_deg / max(extent_deg, radius_deg)) ** 2
    if fill < _BLOB_MIN_FILL:
        return None
    is_cut = bool((mask & unseen).any())
    # The sun's spot is round, isolated and has a glow; clouds and gaps in leaves have neither.
    glow = float(np.clip(sky.around(centre, radius_deg), 0.3, 3.0))
    size = float(np.exp(-0.5 * (np.log(radius_deg / _TYPICAL_SUN_RADIUS_DEG) / 1.2) ** 2))
    plausibility = fill * glow**2 * size * (0.4 if is_cut else 1.0)
    return SunBlob(centre, radius_deg, is_cut, plausibility)


def _wrapped_labels(mask: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Labels of connected regions, where the first and last columns are neighbours."""
    labels = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, structure=np.ones((3, 3)), output=labels)
    for left, right in zip(labels[:, 0], labels[:, -1], strict=True):
        if left and right and left != right:
            labels[labels == right] = left
    return labels


def gradient_candidates(
    panorama: Panorama,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return candidate sun directions and the residuals of clear skies with these suns.

    Candidates lie on rings of equal elevation. Each residual is the mean squared relative residual
    of a clear sky, plus an overcast part, fitted to the observed, unsaturated sky.

    Raises:
        InputError: almost no sky was observed.
    """
    height, step = 32, panorama.radiance.shape[0] // 32
    usable = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    count = usable.reshape(height, step, 2 * height, step).sum((1, 3))
    total = (panorama.radiance * usable[..., None]).reshape(height, step, 2 * height, step, 3)
    is_used = count >= max(1, step * step // 8)
    is_used[height // 2 :] = False
    if is_used.sum() < 8:
        raise InputError(
            "the sun cannot be found: almost no sky was observed in the images",
            got=f"{int(is_used.sum())} cells of observed, unsaturated sky",
            expected="8 cells or more (of 32 x 64)",
            remedy="Give place, time and heading of the log, or an HDR file as the sky.",
        )
    observed = luminance((total.sum((1, 3)) / np.maximum(count, 1)[..., None]).astype(np.float32))
    candidates = _gradient_residuals(np.maximum(observed, 1e-4).astype(np.float64), is_used)
    return np.array([c[0] for c in candidates]), np.array([c[1] for c in candidates])


def _gradient_residuals(
    observed: Float[np.ndarray, "h w"], is_used: Bool[np.ndarray, "h w"]
) -> list[tuple[Float[np.ndarray, "3"], float]]:
    """Return (sun direction, mean squared relative residual) of every candidate."""
    height, width = observed.shape
    values = observed[is_used]
    overcast = luminance(overcast_shape(height))[is_used] / values
    azimuths = np.radians(-360.0 / width * np.arange(width))
    found: list[tuple[Float[np.ndarray, "3"], float]] = []
    for elevation in np.radians(np.arange(5.0, 80.0, 10.0)):
        forward = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        skies = [
            luminance(clear_sky_parts(forward, turbidity, GROUND_ALBEDO, height)[0])
            for turbidity in (2.0, 4.0, 8.0)
        ]
        # A clear sky at another azimuth is the same sky, shifted by columns.
        for shift, azimuth in enumerate(azimuths):
            direction = np.array(
                [
                    np.cos(elevation) * np.cos(azimuth),
                    np.cos(elevation) * np.sin(azimuth),
                    np.sin(elevation),
                ]
            )
            rolled = [np.roll(sky, shift, axis=1)[is_used] / values for sky in skies]
            found.append((direction, min(_fit_residual(sky, overcast) for sky in rolled)))
    return found


def _fit_residual(clear: Float[np.ndarray, " n"], overcast: Float[np.ndarray, " n"]) -> float:
    """Mean squared residual of 1 = a clear + b overcast with a, b >= 0 (relative errors)."""
    cc, co, oo = clear @ clear, clear @ overcast, overcast @ overcast
    c1, o1 = clear.sum(), overcast.sum()
    determinant = max(cc * oo - co * co, 1e-12)
    a, b = (oo * c1 - co * o1) / determinant, (cc * o1 - co * c1) / determinant
    if a < 0:
        a, b = 0.0, o1 / oo
    elif b < 0:
        a, b = c1 / cc, 0.0
    return float(np.mean((1 - a * clear - b * overcast) ** 2))
