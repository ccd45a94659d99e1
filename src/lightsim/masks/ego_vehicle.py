"""Mask of the ego vehicle in its own images: pixels that do not change while the ego moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import Trajectory
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError

# The mask as a whole improves held-out frames of log 002 by 0.6 dB
# (docs/benchmarks/reconstruction.md); sensitivity to each constant is not measured.

# Width of the reduced images; bounds the time.
_SMALL_WIDTH_PX = 480
# Time before the first ego pose and after the last one at which images are accepted.
_HOLD_S = 1.0
# Images that are compared, evenly distributed over the drive.
_IMAGES = 12
# Least distance of the ego between the first and the last image.
_MIN_PATH_M = 5.0
# Fraction of the image's height, from below, in which the outline is searched.
_SEARCH_HEIGHT = 0.4
# Least gradient of the outline in all images, in grey levels (0 to 255) per pixel.
_MIN_EDGE = 6.0
# Steepest outline, in rows per column of the reduced image.
_MAX_STEP_PX = 2
# Least fraction of the image's columns that have an outline.
_MIN_COLUMNS = 0.3
# Largest median change of the pixels below the outline, in grey levels.
_MAX_CHANGE = 2.0
# Reduced pixels by which the mask is grown upwards.
_MARGIN_PX = 2
# Fraction of the image's height below the outline that the road test omits: there the road between
# the ego and a following car ends.
_BELOW_OUTLINE = 0.06
# Pairs of images in the road test.
_PAIRS = 8
# Distance of the ego between the two images of a pair.
_PAIR_PATH_M = 0.5
# Tested heights of a camera above the road, in metres.
_ROAD_BELOW_M = np.geomspace(0.8, 4.0, 24)
# Ratio of squared change along the road's motion to squared change in place, below which pixels are
# road; noise alone gives 1. Shaded roads had 0.10 to 0.32, the bonnet of log 002 had 23 (no
# script repeats this).
_ROAD_RATIO = 0.7


def find_ego_vehicle(images: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "h w"]:
    """Return True for pixels of the ego vehicle; all False if none is found.

    Edges of the ego vehicle are static while the ego moves, other edges are not. Dynamic
    programming finds the outline with the strongest static edges, one row per column; a column
    without ego vehicle has no cost. Pixels below the outline must be nearly constant, which
    excludes a kerb beside textured road. Road without texture between static edges can still be
    mistaken for the ego vehicle: test the mask with `moves_as_road`.

    Args:
        images: grey images (0 to 255) of one camera, from the whole drive, reduced to a width of
            a few hundred pixels.

    Raises:
        InputError: fewer than three images.
    """
    n, height, width = images.shape
    if n < 3:
        raise InputError("too few images to find the ego vehicle", got=n, expected="3 or more")
    top = min(height - 2, int(height * (1.0 - _SEARCH_HEIGHT)))
    outline = _outline(_static_edges(images)[top:] - _MIN_EDGE) + top
    is_car_column = outline < height - 1
    mask = np.arange(height)[:, None] >= outline[None, :]
    mask &= is_car_column[None, :]
    if is_car_column.mean() < _MIN_COLUMNS:
        return np.zeros((height, width), dtype=bool)
    change = np.median(np.abs(images - np.median(images, axis=0)), axis=0)
    if float(np.median(change[mask])) > _MAX_CHANGE:
        return np.zeros((height, width), dtype=bool)
    return _grown_upwards(mask)


def moves_as_road(
    mask: Bool[np.ndarray, "h w"], camera: PinholeCamera, frames: Sequence[CameraFrame]
) -> bool:
    """Return True if the pixels of a mask move as the road below the camera, not with the ego.

    Evenly shaded road is nearly constant, and its kerb or a following car has static edges, as an
    ego vehicle has. The weak texture of such a road moves with a horizontal plane, at one height
    for all pairs of images.

    Args:
        mask: mask at the size of reduced images.
        camera: the camera at full size.
        frames: frames of the camera, in order of time.
    """
    height, width = mask.shape
    rows = round(_BELOW_OUTLINE * height)
    inner = np.zeros_like(mask)
    inner[rows:] = mask[rows:] & mask[:-rows] if rows else mask
    v, u = np.nonzero(inner)
    full_from_small = np.array([camera.width_px / width, camera.height_px / height])
    pixels_uv = np.stack([u + 0.5, v + 0.5], axis=1) * full_from_small
    rounding = 1 / 6  # mean square of the difference of two rounded grey levels
    ratios = []
    for first, second in _pairs(frames):
        before, after = _small_grey(first), _small_grey(second)
        origins, directions = first.pixel_rays(camera, pixels_uv)
        is_down = directions[:, 2] < -1e-3
        values = before[inner]
        in_place = np.square(values - after[inner])
        ratio = np.ones(len(_ROAD_BELOW_M))
        for k, below_m in enumerate(_ROAD_BELOW_M):
            reach_m = below_m / np.where(is_down, -directions[:, 2], 1.0)
            points = (origins + directions * reach_m[:, None]).astype(np.float32)
            found_uv, is_inside = second.project(camera, points)
            is_valid = is_inside & is_down
            if is_valid.any():
                moved = _at(after, found_uv[is_valid] / full_from_small)
                along = np.square(values[is_valid] - moved)
                ratio[k] = (along.mean() + rounding) / (in_place[is_valid].mean() + rounding)
        ratios.append(ratio)
    # The height is the same in all pairs: average first, then take the best height.
    return bool(ratios) and float(np.mean(ratios, axis=0).min()) < _ROAD_RATIO


def _pairs(frames: Sequence[CameraFrame]) -> Iterator[tuple[CameraFrame, CameraFrame]]:
    """Yield pairs of frames `_PAIR_PATH_M` apart, evenly distributed over the drive."""
    for i in np.unique(np.linspace(0, len(frames) - 1, _PAIRS).round().astype(int)):
        start_m = frames[i].world_from_camera.translation_m
        for later in frames[i + 1 :]:
            if np.linalg.norm(later.world_from_camera.translation_m - start_m) > _PAIR_PATH_M:
                yield frames[i], later
                break


def _at(
    image: Float32[np.ndarray, "h w"], uv: Float64[np.ndarray, "n 2"]
) -> Float32[np.ndarray, " n"]:
    """Return bilinear values of an image at (u, v)."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(image, uv[:, ::-1].T - 0.5, order=1, mode="nearest")


def _static_edges(images: Float32[np.ndarray, "n h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the strength of the vertical gradient that 85 % of the images have with one sign."""
    gradient = np.gradient(images.astype(np.float64), axis=1)
    low, high = np.percentile(gradient, [15, 85], axis=0)
    return np.maximum(np.maximum(low, -high), 0.0)


def _outline(reward: Float64[np.ndarray, "h w"]) -> Int64[np.ndarray, " w"]:
    """Return the row of the outline in each column; the last row means no ego vehicle."""
    height, width = reward.shape
    reward = reward.copy()
    reward[-1] = 0.0
    best = np.empty_like(reward)
    origin = np.zeros((height, width), dtype=np.int64)
    best[:, 0] = reward[:, 0]
    rows = np.arange(height)
    for column in range(1, width):
        padded = np.pad(best[:, column - 1], _MAX_STEP_PX, constant_values=-np.inf)
        candidates = sliding_window_view(padded, 2 * _MAX_STEP_PX + 1)
        choice = np.argmax(candidates, axis=1)
        best[:, column] = candidates[rows, choice] + reward[:, column]
        origin[:, column] = rows + choice - _MAX_STEP_PX
    path = np.empty(width, dtype=np.int64)
    path[-1] = int(np.argmax(best[:, -1]))
    for column in range(width - 1, 0, -1):
        path[column - 1] = origin[path[column], column]
    return path


def _grown_upwards(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    from scipy.ndimage import maximum_filter1d

    size = _MARGIN_PX + 1
    # The negative origin shifts the window below each pixel.
    return maximum_filter1d(mask, size, axis=0, mode="constant", origin=-(size // 2))


def ego_vehicle_masks(
    views: Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], ego: Trajectory
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[str, ...]]:
    """Return masks at full size by camera name, of cameras that see the ego vehicle, and notes.

    Args:
        views: cameras with their frames in order of time.
        ego: trajectory `world_from_ego`.
    """
    masks: dict[str, Bool[np.ndarray, "h w"]] = {}
    notes: list[str] = []
    for camera, frames in views:
        if not is_moved_enough(frames, ego):
            notes.append(f"{camera.name}: too little motion to find the ego vehicle by motion")
            continue
        chosen = np.unique(np.linspace(0, len(frames) - 1, _IMAGES).round().astype(int))
        small = find_ego_vehicle(np.stack([_small_grey(frames[i]) for i in chosen]))
        if small.any() and not moves_as_road(small, camera, frames):
            masks[camera.name] = enlarged(small, camera)
    return masks, tuple(notes)


def is_moved_enough(frames: Sequence[CameraFrame], ego: Trajectory) -> bool:
    """Return True if the ego moves enough between the frames of a camera to find it by motion."""
    if len(frames) < 3:
        return False
    first, last = (ego.at(f.time_ns, _HOLD_S).translation_m for f in (frames[0], frames[-1]))
    return float(np.linalg.norm(last - first)) >= _MIN_PATH_M


def _small_grey(frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
    image = Image.fromarray(frame.load_srgb8()).convert("L")
    # Images narrower than `_SMALL_WIDTH_PX` retain their size.
    width = min(_SMALL_WIDTH_PX, image.width)
    height = max(8, round(image.height * width / image.width))
    small = image.resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, dtype=np.float32)


def enlarged(mask: Bool[np.ndarray, "h w"], camera: PinholeCamera) -> Bool[np.ndarray, "h2 w2"]:
    """Return the mask of reduced images at the camera's full size."""
    image = Image.fromarray(mask.astype(np.uint8) * 255)
    size = (camera.width_px, camera.height_px)
    return np.asarray(image.resize(size, Image.Resampling.BILINEAR)) >= 128
