"""Pictures of a log with its LiDAR returns, boxes, sun and shadows drawn over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from PIL import Image, ImageDraw

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.view.figures import depth_colours, reduced

# Colour of the edges of boxes: green.
_BOX = (80, 255, 120)
# Colour of the front face of boxes: pink.
_FRONT = (255, 90, 200)
# Colour of shadow lines: yellow.
_SHADOW = (255, 220, 60)
# Colour of the ring around the sun: orange.
_SUN = (255, 120, 0)
# Edges of a box by the indices of `ActorTrack.corners_actor`.
_EDGES = tuple((i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit)
# Samples of an edge: with a rolling shutter, and near the camera plane, lines are cut into pieces.
_SAMPLES = 12
# Longest drawn shadow, in metres: a low sun casts shadows over the whole street.
_MAX_SHADOW_M = 15.0


@dataclass(frozen=True, eq=False)
class Overlay:
    """A picture of a camera with what was drawn over it.

    Args:
        returns: number of LiDAR returns inside the picture.
        boxes: number of boxes with a visible edge.
        sweep_gap_s: time from the picture to the sweep.
    """

    camera_name: str
    stem: str
    image: UInt8[np.ndarray, "h w 3"]
    returns: int
    boxes: int
    sweep_gap_s: float | None


def draw_overlay(
    log: DrivingLog, frame: CameraFrame, sweep: LidarSweep | None, width_px: int
) -> Overlay:
    """Draw LiDAR returns (coloured by depth), boxes (green, front pink), the sun (orange ring) and
    the shadow line of each box on the ground (yellow) on the picture of a frame.

    Args:
        sweep: the sweep nearest in time; None draws no returns.
        width_px: largest width of the picture.
    """
    camera = log.cameras[frame.camera_name]
    picture = Image.fromarray(reduced(frame.load_srgb8(), width_px))
    scale = picture.width / camera.width_px
    pen = ImageDraw.Draw(picture)
    count = 0 if sweep is None else _draw_returns(picture, frame, camera, sweep, scale)
    actors = log.actors_at(frame.time_ns)
    lines = [edge for actor in actors for edge in _box_edges(actor, frame.time_ns)]
    is_drawn = _draw_lines(pen, frame, camera, lines, scale)
    boxes = int(is_drawn.reshape(-1, len(_EDGES)).any(axis=1).sum())
    towards_sun = None if log.geo is None else log.geo.direction_at(frame.time_ns)
    if towards_sun is not None and towards_sun[2] > 0.02:
        shadows = [_shadow(actor, frame, towards_sun) for actor in actors]
        _draw_lines(pen, frame, camera, shadows, scale)
        far = frame.world_from_camera.translation_m + 1e4 * towards_sun
        uv, is_inside = frame.project(camera, far[None])
        if is_inside[0]:
            u, v = uv[0] * scale
            radius = max(6.0, picture.width / 60)
            pen.ellipse((u - radius, v - radius, u + radius, v + radius), outline=_SUN, width=3)
    gap_s = None if sweep is None else (sweep.time_ns - frame.time_ns) * 1e-9
    return Overlay(frame.camera_name, frame.stem, np.asarray(picture), count, boxes, gap_s)


def _draw_returns(
    picture: Image.Image,
    frame: CameraFrame,
    camera: PinholeCamera,
    sweep: LidarSweep,
    scale: float,
) -> int:
    points = sweep.points_world.astype(np.float64)
    uv, is_inside = frame.project(camera, points)
    depth_m = (points[is_inside] - frame.world_from_camera.translation_m) @ (
        frame.world_from_camera.rotation[:, 2]
    )
    # The farthest first, so that near returns stay visible.
    order = np.argsort(-depth_m)
    at = np.floor(uv[is_inside][order] * scale).astype(np.int64)
    colours = depth_colours(depth_m[order][None])[0]
    drawn = np.asarray(picture).copy()
    height, width = drawn.shape[:2]
    for dv, du in ((0, 0), (0, 1), (1, 0), (1, 1)):
        drawn[np.minimum(at[:, 1] + dv, height - 1), np.minimum(at[:, 0] + du, width - 1)] = colours
    picture.paste(Image.fromarray(drawn))
    return int(is_inside.sum())


_Line = tuple[Float64[np.ndarray, "2 3"], tuple[int, int, int]]
"""Ends in frame `world`, and a colour."""


def _box_edges(actor: ActorTrack, time_ns: int) -> list[_Line]:
    corners = actor.world_from_actor(time_ns).apply(actor.corners_actor)
    return [
        (corners[[first, last]], _FRONT if first & 4 and last & 4 else _BOX)
        for first, last in _EDGES
    ]


def _shadow(actor: ActorTrack, frame: CameraFrame, towards_sun: Float[np.ndarray, "3"]) -> _Line:
    """Return the line on the ground from the foot of a box to the shadow of its top's centre."""
    pose = actor.world_from_actor(frame.time_ns)
    height_m = float(actor.size_lwh_m[2])
    foot = pose.apply(np.array([[0.0, 0.0, -height_m / 2]]))[0]
    away = -towards_sun[:2] / towards_sun[2] * height_m
    length_m = float(np.linalg.norm(away))
    away *= min(1.0, _MAX_SHADOW_M / max(length_m, 1e-6))
    return np.stack([foot, foot + np.array([away[0], away[1], 0.0])]), _SHADOW


def _draw_lines(
    pen: ImageDraw.ImageDraw,
    frame: CameraFrame,
    camera: PinholeCamera,
    lines: Sequence[_Line],
    scale: float,
) -> Bool[np.ndarray, " n"]:
    """Draw the visible pieces of lines; return which lines have one inside the picture."""
    if not lines:
        return np.zeros(0, dtype=bool)
    ends = np.stack([line for line, _ in lines])[:, :, None]
    parts = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    samples = ends[:, 0] + parts * (ends[:, 1] - ends[:, 0])
    flat_uv, inside = frame.project(camera, samples.reshape(-1, 3))
    uv = flat_uv.reshape(len(lines), _SAMPLES, 2)
    size = np.array([camera.width_px, camera.height_px])
    # Points behind the camera are NaN and fail the comparison.
    is_near = np.all(np.logical_and(uv >= -size, uv <= 2 * size), axis=2)
    for line, sample in np.argwhere(np.logical_and(is_near[:, :-1], is_near[:, 1:])).tolist():
        first, last = uv[line, sample] * scale, uv[line, sample + 1] * scale
        pen.line([*first, *last], fill=lines[line][1], width=2)
    return np.any(inside.reshape(len(lines), _SAMPLES), axis=1)
