"""A street corner of planes and boxes, scanned and photographed from a moving car."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep

STEP_NS = 100_000_000
SPEED_M_S = 5.0
CAMERA = PinholeCamera("side", 360, 240, 210.0, 210.0, 180.0, 120.0)
BOXES = (
    ((4.0, 6.0, 0.0), (5.5, 7.0, 2.2), 40),
    ((8.5, 8.0, 0.0), (9.2, 8.6, 4.0), 230),
    ((-2.0, 5.5, 0.0), (0.0, 6.5, 1.5), 200),
    ((12.0, 6.5, 0.0), (15.0, 7.5, 1.8), 30),
    ((1.5, 9.0, 0.0), (2.0, 9.6, 5.0), 25),
    ((16.5, 5.0, 0.0), (17.2, 6.0, 3.0), 215),
)
"""Lowest and highest corner, and the grey of each box; ground and a far wall stand around."""
_GROUND_GREY, _WALL_GREY, _SKY_GREY = 90, 130, 250
_WALL_Y_M, _WALL_HEIGHT_M = 16.0, 9.0
_SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""A camera at the car's left: x along the street, z to the left."""
_HEIGHT_M = 2.0


@dataclass(frozen=True, eq=False)
class Hits:
    distance_m: Float64[np.ndarray, " n"]
    grey: UInt8[np.ndarray, " n"]
    is_hit: Bool[np.ndarray, " n"]


def cast(origins: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]) -> Hits:
    """First surface of the scene along each ray."""
    best = np.full(len(origins), np.inf)
    grey = np.full(len(origins), _SKY_GREY, dtype=np.uint8)
    safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    ground = -origins[:, 2] / safe[:, 2]
    wall = (_WALL_Y_M - origins[:, 1]) / safe[:, 1]
    wall_z = origins[:, 2] + wall * directions[:, 2]
    wall[(wall_z < 0) | (wall_z > _WALL_HEIGHT_M)] = -1.0
    for t, value in ((ground, _GROUND_GREY), (wall, _WALL_GREY)):
        is_nearer = (t > 0) & (t < best)
        best[is_nearer], grey[is_nearer] = t[is_nearer], value
    for low, high, value in BOXES:
        near = (np.array(low) - origins) / safe
        far = (np.array(high) - origins) / safe
        enter = np.minimum(near, far).max(axis=1)
        leave = np.maximum(near, far).min(axis=1)
        is_nearer = (enter > 0) & (enter < leave) & (enter < best)
        best[is_nearer], grey[is_nearer] = enter[is_nearer], value
    return Hits(best, grey, best < 60.0)


def ego_x_m(times_ns: np.ndarray) -> np.ndarray:
    """The car starts from rest, so that a time offset differs from a shift."""
    seconds = times_ns * 1e-9
    return SPEED_M_S * seconds * np.minimum(seconds, 1.0)


def make_log(
    count: int,
    *,
    ego_from_camera: RigidTransform | None = None,
    path_error_m: Float64[np.ndarray, "n 3"] | None = None,
    camera_delay_s: float = 0.0,
) -> DrivingLog:
    """The log of `count` sweeps and frames.

    Args:
        ego_from_camera: as the pictures are taken; the log always claims `mounting()`.
        path_error_m: what is added to the points and origins of each sweep.
        camera_delay_s: how much later pictures are taken than the log claims.
    """
    times = np.arange(1, count + 1, dtype=np.int64) * STEP_NS
    knots = np.arange(0, count + 3, dtype=np.int64) * STEP_NS
    poses = np.tile(np.eye(4), (len(knots), 1, 1))
    poses[:, 0, 3] = ego_x_m(knots)
    ego = Trajectory("world", "ego", knots, poses)
    true_mounting = ego_from_camera or mounting()
    frames, sweeps = [], []
    for i, time_ns in enumerate(times.tolist()):
        error = np.zeros(3) if path_error_m is None else path_error_m[i]
        sweep = _scan(f"{i:02d}", time_ns, error, np.random.default_rng(i))
        sweeps.append(LazySweep(sweep.stem, time_ns, lambda sweep=sweep: sweep))
        taken = ego.at(time_ns + round(camera_delay_s * 1e9)) @ true_mounting
        picture = _photograph(taken)
        claimed = ego.at(time_ns) @ mounting()
        frames.append(
            CameraFrame("side", f"{i:02d}", time_ns, claimed, lambda picture=picture: picture)
        )
    parked = ActorTrack("none", ActorKind.CAR, np.ones(3), _far_away(knots), False)
    return DrivingLog(
        "corner", {"side": CAMERA}, tuple(frames), tuple(sweeps), ego, (parked,), None, {}
    )


def mounting() -> RigidTransform:
    return RigidTransform.from_rotation("ego", "camera", _SIDE, np.array([0.0, 0.2, 1.9]))


def _far_away(times_ns: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
    poses[:, 0, 3] = 500.0
    return Trajectory("world", "actor", times_ns, poses)


def _scan(
    stem: str, time_ns: int, error_m: Float64[np.ndarray, "3"], rng: np.random.Generator
) -> LidarSweep:
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(20.0, 160.0, 0.3)), np.radians(np.arange(-24.0, 18.0, 0.4))
    )
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    directions = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    origin = np.array([float(ego_x_m(np.array(time_ns))), 0.0, _HEIGHT_M])
    origins = np.tile(origin, (len(directions), 1))
    hits = cast(origins, directions)
    distance = hits.distance_m[hits.is_hit] + rng.normal(0.0, 0.01, int(hits.is_hit.sum()))
    points = origins[hits.is_hit] + distance[:, None] * directions[hits.is_hit] + error_m
    n = len(points)
    flat, whole = np.zeros(n, dtype=np.float32), np.full(n, -1, dtype=np.int16)
    return LidarSweep(
        stem,
        time_ns,
        points.astype(np.float32),
        (origins[hits.is_hit] + error_m).astype(np.float32),
        flat,
        flat,
        whole,
        whole,
    )


def _photograph(world_from_camera: RigidTransform) -> UInt8[np.ndarray, "h w 3"]:
    uv = CAMERA.pixel_centres().reshape(-1, 2)
    directions = world_from_camera.rotate(CAMERA.directions(uv))
    origins = np.tile(world_from_camera.translation_m, (len(uv), 1))
    grey = cast(origins, directions).grey.reshape(CAMERA.height_px, CAMERA.width_px)
    return np.repeat(grey[..., None], 3, axis=2)
