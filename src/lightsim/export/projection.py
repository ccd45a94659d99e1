"""Rectangles of boxes in pictures, for formats that have no masks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame

# Least depth of a projected point, in metres: edges of boxes are cut there.
_NEAR_M = 0.1
Rectangle = tuple[float, float, float, float]
"""Left, top, right and bottom in pixels."""


def box_rectangle(track: ActorTrack, frame: CameraFrame, camera: PinholeCamera) -> Rectangle | None:
    """Return the rectangle around a projected box, not limited to the picture; None if the box is
    behind the camera."""
    camera_from_world = frame.world_from_camera.inverse()
    corners = _before_camera(
        (camera_from_world @ track.world_from_actor(frame.time_ns)).apply(track.corners_actor)
    )
    if not len(corners):
        return None
    uv, _ = camera.project(corners)
    left, top, right, bottom = (float(v) for v in (*uv.min(axis=0), *uv.max(axis=0)))
    return left, top, right, bottom


def _before_camera(corners: Float64[np.ndarray, "8 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the corners of the part of a box in front of the camera."""
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    is_front = corners[:, 2] >= _NEAR_M
    cut = [
        corners[a] + (_NEAR_M - corners[a, 2]) / (corners[b, 2] - corners[a, 2])
        * (corners[b] - corners[a])
        for a, b in pairs
        if is_front[a] != is_front[b]
    ]  # fmt: skip
    return np.concatenate([corners[is_front], np.array(cut).reshape(-1, 3)])


def inside_picture(rectangle: Rectangle, camera: PinholeCamera) -> Rectangle | None:
    """Return the part of a rectangle inside the picture; None if it is outside."""
    left, top = max(rectangle[0], 0.0), max(rectangle[1], 0.0)
    right = min(rectangle[2], float(camera.width_px))
    bottom = min(rectangle[3], float(camera.height_px))
    return (left, top, right, bottom) if left < right and top < bottom else None


def truncation(rectangle: Rectangle, camera: PinholeCamera) -> float:
    """Return the fraction of a rectangle outside the picture."""
    inside = inside_picture(rectangle, camera)
    return 1.0 if inside is None else 1.0 - _area(inside) / _area(rectangle)


def _area(rectangle: Rectangle) -> float:
    left, top, right, bottom = rectangle
    return (right - left) * (bottom - top)


def intrinsic_matrix(camera: PinholeCamera) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix of a pinhole camera, with the origin at the centre of the first pixel."""
    return np.array(
        [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]],
        dtype=np.float64,
    )
