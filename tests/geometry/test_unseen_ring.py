"""Ground around a standing ego vehicle, where no beam reaches it: level, not a cone up to the
bonnet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.geometry.mesh_scene import mesh_background
from lightsim.masks.ego_body import with_ego_body
from lightsim.progress import SilentProgress
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.tsdf import fuse_log
from lightsim.render.casters.embree import make_embree_caster

LIDAR_M = np.array([0.0, 0.0, 2.0])
CONFIG = FuseConfig(voxel_m=(0.15,), radius_m=(9.0,), azimuth_step_deg=0.5, elevation_step_deg=0.3)


def scanned() -> Float64[np.ndarray, "n 3"]:
    """Returns of beams 25 to 6 degrees below the horizon: roof (1.6 m high, up to 1.3 m ahead),
    bonnet (1 m high, up to 3 m) or ground beyond 4.3 m."""
    down, turn = np.meshgrid(np.radians(np.arange(6.0, 25.1, 0.6)), np.radians(np.arange(0, 360)))
    rays = np.stack(
        [np.cos(down) * np.cos(turn), np.cos(down) * np.sin(turn), -np.sin(down)], axis=-1
    ).reshape(-1, 3)
    points = LIDAR_M + rays * (-2.0 / rays[:, 2:])
    # The roof hides the bonnet, and both hide the ground: from below upwards.
    for height_m, front_m in ((1.0, 3.0), (1.6, 1.3)):
        top = LIDAR_M + rays * ((height_m - 2.0) / rays[:, 2:])
        is_measured = (np.abs(top[:, 1]) < 0.9) & (top[:, 0] > 0.0) & (top[:, 0] < front_m)
        points = np.where(is_measured[:, None], top, points)
    return points


def standing_log() -> DrivingLog:
    points = scanned().astype(np.float32)
    count = len(points)
    sweeps = []
    for i in range(3):
        sweep = LidarSweep(
            f"{i}", i * 10**8, points, np.tile(LIDAR_M, (count, 1)).astype(np.float32),
            np.ones(count, np.float32), np.zeros(count, np.float32),
            np.zeros(count, np.int16), np.full(count, -1, np.int16),
        )  # fmt: skip
        sweeps.append(LazySweep(sweep.stem, sweep.time_ns, lambda sweep=sweep: sweep))
    ego = Trajectory("world", "ego", np.arange(3) * 10**8, np.tile(np.eye(4), (3, 1, 1)))
    return DrivingLog("toy", {}, (), tuple(sweeps), ego, (), None, {})


def heights_m(log: DrivingLog) -> Float64[np.ndarray, " n"]:
    """Heights of the mesh within the unseen disc; NaN without a surface."""
    mesh = mesh_background(fuse_log(log, CONFIG, progress=SilentProgress()), make_embree_caster)
    xy = np.stack(np.meshgrid(*[np.arange(-4.2, 4.3, 0.3)] * 2), axis=-1).reshape(-1, 2)
    xy = xy[np.hypot(*xy.T) < 4.2]
    origins = np.concatenate([xy, np.full((len(xy), 1), 3.0)], axis=1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape).copy()
    hits = make_embree_caster([mesh]).intersect(origins, down)
    return np.where(hits.is_hit, 3.0 - hits.distance_m, np.nan)


def test_the_unseen_ring_is_level_ground() -> None:
    log = standing_log()
    # With the returns of the body the disc is not level ground.
    assert (np.abs(np.nan_to_num(heights_m(log), nan=np.inf)) > 0.1).mean() > 0.2
    found = with_ego_body(log)
    assert found.ego_box is not None
    level = heights_m(found.without_ego_returns())
    assert np.isfinite(level).all()
    assert np.abs(level).max() < 0.05
