"""The ego vehicle's body from LiDAR: a box around its returns, and masks of cameras at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.masks.ego_body import find_ego_box, with_ego_body

LIDAR_M = np.array([0.0, 0.0, 2.0])
# Camera axes (right, down, forward) of a camera that looks ahead, in frame `ego`.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA = PinholeCamera("front", 320, 240, 200.0, 200.0, 160.0, 120.0)
BONNET = (1.5, 3.0)


def grid(x: tuple[float, float], y: tuple[float, float], z: float, step: float) -> np.ndarray:
    """Points of a horizontal rectangle."""
    xy = np.stack(np.meshgrid(np.arange(*x, step), np.arange(*y, step)), axis=-1).reshape(-1, 2)
    return np.concatenate([xy, np.full((len(xy), 1), z)], axis=1)


def scene() -> dict[str, np.ndarray]:
    """Points in the world: ground around the unseen disc, a kerb beside the vehicle, and the rear
    of a car without a box, 2.2 m ahead of the bonnet."""
    ground = grid((-12.0, 20.0), (-12.0, 12.0), 0.0, 0.25)
    rear = np.stack(np.meshgrid(np.arange(-0.8, 0.8, 0.1), np.arange(0.4, 1.4, 0.1)), axis=-1)
    rear = np.concatenate([np.full((rear[..., 0].size, 1), 5.2), rear.reshape(-1, 2)], axis=1)
    return {
        "ground": ground[np.hypot(*ground[:, :2].T) > 4.0],
        "kerb": grid((-3.0, 4.0), (1.2, 1.5), 0.18, 0.1),
        "car": rear,
    }


def body() -> np.ndarray:
    """Returns of the body in frame `ego`: parts of the roof and the bonnet."""
    roof, bonnet = grid((-1.2, -0.5), (-0.7, 0.7), 1.6, 0.1), grid(BONNET, (-0.8, 0.8), 1.0, 0.05)
    return np.concatenate([roof, bonnet])


def log_of(*, speed_m: float, has_body: bool = True) -> DrivingLog:
    """Return six sweeps of an ego vehicle that moves `speed_m` between them."""
    times_ns = np.arange(8, dtype=np.int64) * 10**8
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = speed_m * np.arange(8)
    ego = Trajectory("world", "ego", times_ns, poses)
    sweeps, frames = [], []
    for i in range(6):
        at = ego.at(int(times_ns[i]))
        points = np.concatenate([*scene().values()] + [at.apply(body())] * has_body)
        count = len(points)
        sweep = LidarSweep(
            f"{i}", int(times_ns[i]), points.astype(np.float32),
            np.tile(at.apply(LIDAR_M[None]), (count, 1)).astype(np.float32),
            np.ones(count, np.float32), np.zeros(count, np.float32),
            np.zeros(count, np.int16), np.full(count, -1, np.int16),
        )  # fmt: skip
        sweeps.append(LazySweep(sweep.stem, sweep.time_ns, lambda sweep=sweep: sweep))
        pose = at @ RigidTransform.from_rotation("ego", "camera", AHEAD, np.array([0.3, 0, 1.9]))
        black = np.zeros((240, 320, 3), np.uint8)
        frames.append(CameraFrame("front", f"{i}", sweep.time_ns, pose, lambda black=black: black))
    return DrivingLog("toy", {"front": CAMERA}, tuple(frames), tuple(sweeps), ego, (), None, {})


@pytest.mark.parametrize("speed_m", [0.0, 0.02, 0.3])
def test_returns_of_the_body_are_left_out_and_nothing_else(speed_m: float) -> None:
    log = log_of(speed_m=speed_m)
    found = with_ego_body(log)
    assert "left out" in found.notes[-1]
    for before, after in zip(log.sweeps, found.without_ego_returns().sweeps, strict=True):
        assert len(before.load().ring) - len(after.load().ring) == len(body())
    box = find_ego_box(log, [lazy.load() for lazy in log.sweeps])
    assert box is not None
    assert BONNET[1] <= box.high_m[0] < BONNET[1] + 0.6
    assert -1.2 - 0.6 < box.low_m[0] <= -1.2
    assert box.low_m[2] == pytest.approx(0.3, abs=0.02)
    assert np.abs(box.high_m[1]) < 1.2


def test_a_log_without_returns_of_the_body_stays_as_it_is() -> None:
    for speed_m in (0.0, 2.0):
        log = log_of(speed_m=speed_m, has_body=False)
        assert with_ego_body(log) is log
    assert with_ego_body(replace(log, sweeps=())).sweeps == ()


def test_a_camera_at_rest_gets_the_mask_of_the_body() -> None:
    """The front edge of the bonnet, 1 m high and 2.7 m ahead of a camera at 1.9 m, is 0.9 / 2.7 of
    a focal length below the middle; its sides reach 0.8 / 2.7 of it to both sides."""
    mask = with_ego_body(log_of(speed_m=0.01)).ego_vehicle_masks["front"]
    row, left, right = (120 + 200 * 0.9 / 2.7, 160 - 200 * 0.8 / 2.7, 160 + 200 * 0.8 / 2.7)
    rows, columns = np.nonzero(mask)
    assert rows.min() == pytest.approx(row, abs=3)
    at_edge = columns[rows == rows.min() + 2]
    assert at_edge.min() == pytest.approx(left, abs=5)
    assert at_edge.max() == pytest.approx(right, abs=5)
    assert mask[-1].mean() > 0.5


def test_a_driving_camera_keeps_the_evidence_of_motion() -> None:
    assert not with_ego_body(log_of(speed_m=2.0)).ego_vehicle_masks
