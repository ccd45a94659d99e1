"""The ego vehicle in its own pictures: what stays put below a fixed edge while the ego moves."""

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

_SMALL_WIDTH_PX = 480
_TINY = 1e-3
_HOLD_S = 1.0
"""Pictures may be taken a little before the first pose of the ego and after the last."""


# Grey levels run from 0 to 255. None was measured alone; the mask as a whole is worth 0.6 dB on
# held-out frames of log 002 (docs/benchmarks/reconstruction.md).

# Pictures looked at, spread over the drive.
_PICTURES = 12
# The ego must have moved this far between the first and the last picture.
_MIN_PATH_M = 5.0
# The outline is looked for in this lower fraction of the picture.
_SEARCH_HEIGHT = 0.4
# Grey levels per pixel of a standing edge that counts as outline.
_MIN_EDGE = 6.0
# Steepness of the outline: rows per column of the reduced picture.
_MAX_STEP_PX = 2
# Fraction of the picture's width over which the outline must stand.
_MIN_COLUMNS = 0.3
# Median change in time, in grey levels, of what lies below the outline.
_MAX_CHANGE = 2.0
# The mask is grown upwards by this many reduced pixels.
_MARGIN_PX = 2
# Of the picture's height, below the outline: a car that follows ends there.
_BELOW_OUTLINE = 0.06
# Pairs of pictures in which the road is looked for, and how far the ego drives between them.
_PAIRS = 8
_PAIR_PATH_M = 0.5
# Where the road may lie below a camera, metres.
_ROAD_BELOW_M = np.geomspace(0.8, 4.0, 24)
# Squared change along the road's motion over that in place: noise alone gives 1. Roads in plain
# shade gave .10 to .32, the bonnet of log 002 23 (docs/datasets.md).
_ROAD_RATIO = 0.7
# Mean square of the difference of two rounded grey levels.
_ROUNDING = 1 / 6


def find_ego_vehicle(images: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "h w"]:
    """True where the ego vehicle covers the picture; all False where none is found.

    Plain road between standing edges passes for one (`moves_as_road`).

    Outside, edges wander while the ego moves; those of the ego vehicle stand still. So for every
    column the row of the strongest standing edge is sought, joined to one outline from left to
    right by dynamic programming in which a column without ego vehicle costs nothing. What lies
    below must moreover hardly change, which a kerb beside textured road does not pass.

    Args:
        images: grey pictures (0 to 255) of one camera, taken along the drive and reduced to a few
            hundred pixels width.

    Raises:
        InputError: fewer than three pictures.
    """
    n, height, width = images.shape
    if n < 3:
        raise InputError("too few pictures to find the ego vehicle", got=n, expected="3 or more")
    top = min(height - 2, int(height * (1.0 - _SEARCH_HEIGHT)))
    outline = _outline(_standing_edges(images)[top:] - _MIN_EDGE, _MAX_STEP_PX) + top
    is_car_column = outline < height - 1
    mask = np.arange(height)[:, None] >= outline[None, :]
    mask &= is_car_column[None, :]
    if is_car_column.mean() < _MIN_COLUMNS:
        return np.zeros((height, width), dtype=bool)
    change = np.median(np.abs(images - np.median(images, axis=0)), axis=0)
    if float(np.median(change[mask])) > _MAX_CHANGE:
        return np.zeros((height, width), dtype=bool)
    return _grown_upwards(mask, _MARGIN_PX)


def moves_as_road(
    mask: Bool[np.ndarray, "h w"], camera: PinholeCamera, frames: Sequence[CameraFrame]
) -> bool:
    """Whether what a mask covers moves as road below the camera does, and not with the ego.

    Road in even shade hardly changes and its kerb stands still, as does a car that follows the ego:
    then they look like an ego vehicle. But the little that they show of dashes and patches moves
    with a level plane, at one height for all pairs of pictures.

    Args:
        mask: at the size of reduced pictures.
        frames: of the camera, in order of time.
    """
    height, width = mask.shape
    rows = round(_BELOW_OUTLINE * height)
    inner = np.zeros_like(mask)
    inner[rows:] = mask[rows:] & mask[:-rows] if rows else mask
    v, u = np.nonzero(inner)
    full_from_small = np.array([camera.width_px / width, camera.height_px / height])
    pixels_uv = np.stack([u + 0.5, v + 0.5], axis=1) * full_from_small
    ratios = []
    for first, second in _pairs(frames):
        before, after = _small_grey(first), _small_grey(second)
        origins, directions = first.pixel_rays(camera, pixels_uv)
        is_down = directions[:, 2] < -_TINY
        seen = before[inner]
        in_place = np.square(seen - after[inner])
        ratio = np.ones(len(_ROAD_BELOW_M))
        for k, below_m in enumerate(_ROAD_BELOW_M):
            reach_m = below_m / np.where(is_down, -directions[:, 2], 1.0)
            points = (origins + directions * reach_m[:, None]).astype(np.float32)
            found_uv, is_inside = second.project(camera, points)
            told = is_inside & is_down
            if told.any():
                along = np.square(seen[told] - _at(after, found_uv[told] / full_from_small))
                ratio[k] = (along.mean() + _ROUNDING) / (in_place[told].mean() + _ROUNDING)
        ratios.append(ratio)
    return bool(ratios) and float(np.mean(ratios, axis=0).min()) < _ROAD_RATIO


def _pairs(frames: Sequence[CameraFrame]) -> Iterator[tuple[CameraFrame, CameraFrame]]:
    """Spread over the drive; the next picture from a place a little further on."""
    for i in np.unique(np.linspace(0, len(frames) - 1, _PAIRS).round().astype(int)):
        start_m = frames[i].world_from_camera.translation_m
        for later in frames[i + 1 :]:
            if np.linalg.norm(later.world_from_camera.translation_m - start_m) > _PAIR_PATH_M:
                yield frames[i], later
                break


def _at(
    image: Float32[np.ndarray, "h w"], uv: Float64[np.ndarray, "n 2"]
) -> Float32[np.ndarray, " n"]:
    """The picture between its pixels."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(image, uv[:, ::-1].T - 0.5, order=1, mode="nearest")


def _standing_edges(images: Float32[np.ndarray, "n h w"]) -> Float64[np.ndarray, "h w"]:
    """Strength of the vertical gradient that nearly all pictures show with the same sign."""
    gradient = np.gradient(images.astype(np.float64), axis=1)
    low, high = np.percentile(gradient, [15, 85], axis=0)
    return np.maximum(np.maximum(low, -high), 0.0)


def _outline(reward: Float64[np.ndarray, "h w"], max_step_px: int) -> Int64[np.ndarray, " w"]:
    """The row of the outline in each column; the last row stands for no ego vehicle."""
    height, width = reward.shape
    reward = reward.copy()
    reward[-1] = 0.0
    best = np.empty_like(reward)
    origin = np.zeros((height, width), dtype=np.int64)
    best[:, 0] = reward[:, 0]
    rows = np.arange(height)
    for column in range(1, width):
        padded = np.pad(best[:, column - 1], max_step_px, constant_values=-np.inf)
        candidates = sliding_window_view(padded, 2 * max_step_px + 1)
        choice = np.argmax(candidates, axis=1)
        best[:, column] = candidates[rows, choice] + reward[:, column]
        origin[:, column] = rows + choice - max_step_px
    path = np.empty(width, dtype=np.int64)
    path[-1] = int(np.argmax(best[:, -1]))
    for column in range(width - 1, 0, -1):
        path[column - 1] = origin[path[column], column]
    return path


def _grown_upwards(mask: Bool[np.ndarray, "h w"], n_px: int) -> Bool[np.ndarray, "h w"]:
    from scipy.ndimage import maximum_filter1d

    size = n_px + 1
    return maximum_filter1d(mask, size, axis=0, mode="constant", origin=-(size // 2))


def ego_vehicle_masks(
    views: Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], ego: Trajectory
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[str, ...]]:
    """The ego vehicle's mask of every camera that sees it, by camera name, and notes.

    Args:
        views: cameras with their frames in order of time.
        ego: `world_from_ego`.
    """
    masks: dict[str, Bool[np.ndarray, "h w"]] = {}
    notes: list[str] = []
    for camera, frames in views:
        if len(frames) < 3 or _path_m(frames, ego) < _MIN_PATH_M:
            notes.append(
                f"{camera.name}: too little motion to find the ego vehicle in its pictures"
            )
            continue
        chosen = np.unique(np.linspace(0, len(frames) - 1, _PICTURES).round().astype(int))
        small = find_ego_vehicle(np.stack([_small_grey(frames[i]) for i in chosen]))
        if small.any() and not moves_as_road(small, camera, frames):
            masks[camera.name] = _enlarged(small, camera)
    return masks, tuple(notes)


def _path_m(frames: Sequence[CameraFrame], ego: Trajectory) -> float:
    first, last = (ego.at(f.time_ns, _HOLD_S).translation_m for f in (frames[0], frames[-1]))
    return float(np.linalg.norm(last - first))


def _small_grey(frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
    image = Image.fromarray(frame.load_srgb8()).convert("L")
    # Only ever reduced: narrow pictures would grow in both directions.
    width = min(_SMALL_WIDTH_PX, image.width)
    height = max(8, round(image.height * width / image.width))
    small = image.resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, dtype=np.float32)


def _enlarged(mask: Bool[np.ndarray, "h w"], camera: PinholeCamera) -> Bool[np.ndarray, "h2 w2"]:
    image = Image.fromarray(mask.astype(np.uint8) * 255)
    size = (camera.width_px, camera.height_px)
    return np.asarray(image.resize(size, Image.Resampling.BILINEAR)) >= 128
