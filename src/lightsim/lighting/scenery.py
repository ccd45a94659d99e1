"""Removal of scenery (trees, roofs, ground) from an HDR panorama, so that only sky remains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import luminance, srgb8_from_linear
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions, sample_bilinear
from lightsim.core.frames import RigidTransform
from lightsim.core.resample import resize_area
from lightsim.lighting.panorama.inpaint import (
    SMOOTH_HEIGHT_PX,
    blend_into_observed,
    fill_by_laplace,
)

EstimateMatte = Callable[
    [UInt8[np.ndarray, "h w 3"], PinholeCamera, RigidTransform], Float32[np.ndarray, "h w"]
]
"""Function (picture, camera, world_from_camera) that returns the sky fraction of each pixel."""

# Mean step of log luminance between columns, at `_WORKING_ROWS` rows, above which a panorama
# contains scenery; larger of two bands: 4 to 0 degrees above the horizon, 0 to 40 degrees below. Of
# 53 outdoor day HDRIs the 9 without scenery have at most 0.023, the 44 with scenery at least 0.037
# (docs/benchmarks/lighting.md).
_MIN_COLUMN_CONTRAST = 0.03
# Rows of the reduced panorama on which `_MIN_COLUMN_CONTRAST` was measured; a limit on time only.
_WORKING_ROWS = 256
# Value of the 60th percentile of the upper half in the segmented pictures. Low, so that sunlit
# walls do not clip and are not classified as sky; with 0.25 and 0.4 more walls were (no script
# repeats this).
_EXPOSURE_LEVEL = 0.12
# Azimuth and elevation of the segmented pictures. Their field of view is 90 degrees; together they
# cover the upper half of the sphere.
_VIEWS_DEG = (*((60.0 * number, 25.0) for number in range(6)), (0.0, 89.0))
# Side of the segmented pictures, at most, in pixels; a limit on time, sensitivity not measured.
_MAX_VIEW_PX = 480
# Sky fraction below which a pixel counts as scenery; sensitivity not measured.
_PURE_SKY = 0.98
# Angular width of the rim around scenery whose pixels may be mixed with it, in degrees.
_RIM_DEG = 0.7
# Poles are thinner than the first and longer than the second angle, in degrees.
_POLE_DEG = (2.0, 3.0)
# Difference of log radiance between a pole and the sky beside it, at least.
_POLE_STEP = 0.1
# Smallest piece of sky that is used, as a fraction of the upper half.
_MIN_SKY = 0.01


def without_scenery(dome: SkyDome, estimate_matte: EstimateMatte) -> tuple[SkyDome, float]:
    """Return the sky of a dome as a background, and the fraction of the upper half that was
    scenery.

    Observed sky keeps the radiance of the file, bit for bit. Behind scenery and below the horizon,
    the log radiance of the sky is extrapolated smoothly (Laplace), continuous with the observed
    sky. The sun is added at its position in the file. A file without scenery, or without any sky,
    is returned unchanged.

    Args:
        estimate_matte: finds sky in a perspective picture.
    """
    if not _contains_scenery(dome.radiance):
        return dome, 0.0
    height = dome.height_px
    rest, _ = split_sun(dome)
    matte = _sky_matte(rest, estimate_matte)
    is_seen = _seen_sky(rest, matte)
    hidden = float(1.0 - matte[: height // 2].mean())
    if not is_seen.any():
        return dome, hidden
    filled = np.where(is_seen[..., None], rest, _continued(rest, is_seen))
    return SkyDome((filled + (dome.radiance - rest)).astype(np.float32), dome.sun), hidden


def _contains_scenery(radiance: Float32[np.ndarray, "h w 3"]) -> bool:
    """Return True if the skyline or the ground has structure; smooth or mirrored lower halves have
    none."""
    return column_contrast(radiance) > _MIN_COLUMN_CONTRAST


def column_contrast(radiance: Float32[np.ndarray, "h w 3"]) -> float:
    """Mean step of log luminance between columns, in the rougher of skyline and ground band."""
    height = min(len(radiance), _WORKING_ROWS)
    value = luminance(resize_area(radiance, height, 2 * height))
    level = float(np.median(value[: height // 2]))
    log_value = np.log(value + 1e-4 * max(level, 1e-12))
    step = np.abs(log_value - np.roll(log_value, 1, axis=1))
    rows = [round(height * (90.0 - elevation_deg) / 180.0) for elevation_deg in (4.0, 0.0, -40.0)]
    bands = (step[rows[0] : rows[1]], step[rows[1] : rows[2]])
    return max((float(band.mean()) for band in bands if band.size), default=0.0)


def _sky_matte(
    radiance: Float32[np.ndarray, "h w 3"], estimate_matte: EstimateMatte
) -> Float[np.ndarray, "h w"]:
    """Sky fraction of each pixel: a weighted mean over perspective views whose weights fall to
    their borders."""
    height = len(radiance)
    upper = luminance(radiance[: height // 2])
    exposure = _EXPOSURE_LEVEL / max(float(np.percentile(upper, 60)), 1e-12)
    size = min(height, _MAX_VIEW_PX)
    camera = PinholeCamera("view", size, size, size / 2, size / 2, size / 2, size / 2)
    directions = pixel_directions(height).reshape(-1, 3)
    total, weights = np.zeros(len(directions)), np.full(len(directions), 1e-9)
    for azimuth_deg, elevation_deg in _VIEWS_DEG:
        pose = _camera_towards(azimuth_deg, elevation_deg)
        rays = pose.rotate(camera.directions(camera.pixel_centres()))
        picture = np.clip(sample_bilinear(radiance, rays) * exposure, 0.0, 1.0)
        matte = estimate_matte(srgb8_from_linear(picture.astype(np.float32)), camera, pose)
        uv, inside = camera.project(pose.inverse().rotate(directions))
        column, row = uv[inside].astype(np.int64).T
        weight = 1.0 - np.abs(uv[inside] - size / 2).max(axis=1) / (size / 2)
        total[inside] += weight * matte[row, column]
        weights[inside] += weight
    return (total / weights).reshape(height, 2 * height)


def _camera_towards(azimuth_deg: float, elevation_deg: float) -> RigidTransform:
    """Return `world_from_camera` at the origin; azimuth is counter-clockwise from world +x."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    flat = np.cos(elevation)
    forward = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return RigidTransform.from_rotation("world", "camera", rotation, np.zeros(3))


def _seen_sky(
    radiance: Float32[np.ndarray, "h w 3"], matte: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pure sky pixels: the matte without poles, the rim of scenery and small
    gaps between leaves."""
    height, width = matte.shape
    scenery = matte < _PURE_SKY
    scenery[height // 2 :] = True
    rim_px = int(np.ceil(_RIM_DEG / 180.0 * height))
    poles = ndimage.binary_dilation(_upright_lines(radiance), iterations=rim_px)
    around = ((0, 0), (width // 2, width // 2))
    scenery, poles = (
        np.asarray(np.pad(mask, around, mode="wrap"), bool) for mask in (scenery, poles)
    )
    # Thin lines count as poles only where they touch scenery; isolated lines are wisps of cloud.
    scenery = ndimage.binary_propagation(scenery, mask=scenery | poles)
    seen = ~np.asarray(ndimage.binary_dilation(scenery, iterations=rim_px), bool)
    labels, count = ndimage.label(seen)  # type: ignore[misc]
    sizes = np.bincount(np.ravel(labels), minlength=count + 1)
    sizes[0] = 0
    large = sizes >= _MIN_SKY * height * width / 2
    return large[labels][:, width // 2 : width // 2 + width]


def _upright_lines(radiance: Float32[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of narrow, tall lines (poles and trunks that the matte misses), brighter or darker
    than the sky beside them."""
    height = len(radiance)
    thin_px, long_px = (round(degrees / 180.0 * height) for degrees in _POLE_DEG)
    value = np.log(radiance + 1e-6 * float(radiance.mean()))
    beside = ndimage.median_filter(value, size=(1, 2 * thin_px + 1, 1), mode="wrap")
    # Grey paint may be as bright as the sky beside it, but not in every channel.
    is_other = np.abs(value - beside).max(axis=-1) > _POLE_STEP
    upright = np.ones((max(long_px, 2), 1), bool)
    return ndimage.binary_opening(ndimage.binary_closing(is_other, upright), upright)


def _continued(
    radiance: Float32[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Smooth continuation of the observed sky over the whole sphere."""
    height = len(radiance)
    rows = min(height, SMOOTH_HEIGHT_PX)
    weight = is_seen[..., None].astype(np.float32)
    fraction = resize_area(weight, rows, 2 * rows)
    mean = resize_area(radiance * weight, rows, 2 * rows) / np.maximum(fraction, 1e-6)
    # Logarithms, so that the continuation stays positive and gradients are relative.
    floor = 1e-6 * float(radiance[is_seen].mean()) + 1e-12
    small = fill_by_laplace(np.log(mean + floor).astype(np.float32), fraction[..., 0] > 0)
    large = small if rows == height else sample_bilinear(small, pixel_directions(height))
    log_seen = np.log(radiance + floor)
    return np.exp(blend_into_observed(large, log_seen, is_seen, 1.5 * height / rows)) - floor
