"""A cloud of points in place of LiDAR: of COLMAP, photogrammetry or another mapper.

Geometry needs beams, not only points. The beam of a point starts at the nearest camera position
that sees it; that it is not hidden is checked against the cloud itself.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.lenses import Lens
from lightsim.datasets.point_files import as_doubles, read_points
from lightsim.datasets.recorded import (
    PointFrame,
    PointsProvenance,
    RawSweep,
    RecordedCamera,
    RecordedSweep,
)
from lightsim.errors import InputError

_LOGGER = logging.getLogger(__name__)
POINTS_NAME = "points.ply"
"""File of the cloud in a recording."""
# Distance between the camera positions that are tried, in metres: a beam's direction to a point
# 10 m away changes by 6 degrees.
_STEP_M = 1.0
# Angle of a cell of the depth image in which the nearest point hides others, in degrees: ten times
# the resolution of a camera, about the spacing of a dense cloud.
_CELL_DEG = 0.25
# A point is hidden if it is farther than the nearest one of its cell by more than this factor. A
# road 50 m ahead of a camera 1.5 m high spans a factor of 1.16 in one cell.
_HIDDEN_FACTOR = 1.25
# Points farther than this from the drive are outliers, in metres.
_FAR_M = 1e5
# Least length of a beam, in metres: nothing is reconstructed on the lens.
_NEAR_M = 0.1
# Largest length of a beam, in metres.
_REACH_M = 1000.0
# Reflectance of the points, which was not measured: the middle of the range.
_INTENSITY = 0.5


def points_sweep(path: Path, cameras: Sequence[RecordedCamera], ego: Trajectory) -> RecordedSweep:
    """Return the single sweep of a log without LiDAR. Its points are those of a file, in the
    recording's world frame.

    Args:
        path: .ply, or another format of point_files.py.
        ego: `world_from_ego`, for pictures without a pose of their own.
    """
    load = partial(_load, path, tuple(cameras), ego)
    return RecordedSweep(ego.start_ns, path, load, PointsProvenance.GIVEN)


def points_note(path: Path) -> str:
    """Return the note on a log whose surfaces come from given points."""
    return (
        f"no LiDAR: geometry comes from the given points of {path.name}, whose beams are assumed "
        "to start at the nearest camera that sees them; reflectance and times are unknown"
    )


def _load(path: Path, cameras: Sequence[RecordedCamera], ego: Trajectory) -> RawSweep:
    points = as_doubles(read_points(path)["xyz"])
    origin = np.round(ego.positions_m[0])
    # In float32 relative to the drive: half the memory, and a step of 8 mm at 100 km.
    near = np.where(np.abs(points - origin) < _FAR_M, points - origin, np.nan).astype(np.float32)
    best_m = np.full(len(near), np.inf, dtype=np.float32)
    starts = np.zeros_like(near)
    for lens, pose in _positions(cameras, ego):
        start = (pose.translation_m - origin).astype(np.float32)
        is_nearest = _seen_nearer(near, start, pose.rotation, lens, best_m)
        starts[is_nearest] = start
    is_seen = np.isfinite(best_m)
    if not is_seen.any():
        raise InputError(
            "no camera sees any of the points",
            where=path,
            got=f"{len(points)} points",
            expected="points in metres, in the world frame of ego.csv",
            remedy="Align the reconstruction with the ego path (colmap model_aligner).",
        )
    if not is_seen.all():
        dropped = int((~is_seen).sum())
        _LOGGER.warning("%s: dropped %d of %d points that no camera sees", path, dropped,
                        len(is_seen))  # fmt: skip
    return RawSweep(
        points[is_seen],
        PointFrame.WORLD,
        np.zeros(3),
        np.full(int(is_seen.sum()), _INTENSITY),
        origins_world=starts[is_seen].astype(np.float64) + origin,
    )


def _positions(
    cameras: Sequence[RecordedCamera], ego: Trajectory
) -> Iterator[tuple[Lens, RigidTransform]]:
    """Yield lens and `world_from_camera` of pictures that are at least 1 m apart."""
    for camera in cameras:
        last: RigidTransform | None = None
        for picture in camera.pictures:
            pose = picture.world_from_camera or ego.held(picture.time_ns) @ camera.ego_from_camera
            if last is None or np.linalg.norm(pose.translation_m - last.translation_m) >= _STEP_M:
                last = pose
                yield camera.lens, pose


def _seen_nearer(
    points: Float32[np.ndarray, "n 3"],
    start: Float32[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    lens: Lens,
    best_m: Float32[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Return the points that a camera sees from nearer than `best_m`, which is lowered to it."""
    rays = points - start
    distance_m = np.linalg.norm(rays, axis=1)
    # NaN fails the comparisons.
    tried = np.flatnonzero((distance_m > _NEAR_M) & (distance_m < _REACH_M))
    uv, is_inside = lens.project(rays[tried].astype(np.float64) @ rotation)
    tried, uv = tried[is_inside], uv[is_inside]
    found = np.zeros(len(points), dtype=bool)
    if not len(tried):
        return found
    cell_px = max(1.0, _pixels_per_degree(lens) * _CELL_DEG)
    cell = (uv / cell_px).astype(np.int64)
    number = cell[:, 1] * (1 + int(lens.width_px / cell_px)) + cell[:, 0]
    nearest_m = np.full(int(number.max()) + 1, np.inf, dtype=np.float32)
    np.minimum.at(nearest_m, number, distance_m[tried])
    is_free = distance_m[tried] <= _HIDDEN_FACTOR * nearest_m[number]
    chosen = tried[is_free & (distance_m[tried] < best_m[tried])]
    best_m[chosen] = distance_m[chosen]
    found[chosen] = True
    return found


def _pixels_per_degree(lens: Lens) -> float:
    """Return the resolution in the centre of the picture."""
    near = np.array([[0.0, 0.0, 1.0], [np.tan(1e-3), 0.0, 1.0]])
    uv, _ = lens.project(near)
    return float(np.linalg.norm(uv[1] - uv[0]) / np.degrees(1e-3))
