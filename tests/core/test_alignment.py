"""Corrections move what was located by the ego's pose, and nothing else."""

from __future__ import annotations

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.alignment import Alignment, CameraCorrection, PathCorrection
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import (
    RigidTransform,
    Trajectory,
    rotation_from_vector,
    vector_from_rotation,
)
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep, RollingShutter

SECOND = 1_000_000_000


def small_log() -> DrivingLog:
    """The car drives along x at 10 m/s; one frame, one sweep and one box at 0.5 s."""
    times = np.arange(11, dtype=np.int64) * (SECOND // 10)
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = np.arange(11.0)
    half = SECOND // 2
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = RigidTransform.from_rotation("world", "camera", turn, np.array([5.0, 0.0, 2.0]))
    shutter = RollingShutter(0.03, np.array([10.0, 0.0, 0.0]), np.zeros(3))
    frame = CameraFrame(
        "front", "05", half, pose, lambda: np.zeros((4, 6, 3), dtype=np.uint8), shutter
    )

    def load() -> LidarSweep:
        points = np.array([[15.0, 0.0, 0.0], [5.0, 9.0, 1.0]], dtype=np.float32)
        origins = np.array([[5.0, 0.0, 2.0], [5.0, 0.0, 2.0]], dtype=np.float32)
        flat = np.zeros(2, dtype=np.float32)
        classes = np.full(2, -1, dtype=np.int16)
        return LidarSweep("05", half, points, origins, flat, flat, classes, classes)

    still = Trajectory("world", "actor", times, np.tile(np.eye(4), (11, 1, 1)))
    actor = ActorTrack("car", ActorKind.CAR, np.array([4.0, 2.0, 1.5]), still, False)
    return DrivingLog(
        "log",
        {"front": PinholeCamera("front", 6, 4, 5.0, 5.0, 3.0, 2.0)},
        (frame,),
        (LazySweep("05", half, load),),
        Trajectory("world", "ego", times, poses),
        (actor,),
        None,
        {},
    )


def path() -> PathCorrection:
    times = np.array([0, SECOND], dtype=np.int64)
    turns = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]])
    return PathCorrection(times, np.array([5.0, 0.0, 0.0]), turns, np.array([[0.1, 0, 0]] * 2))


def test_rotation_vectors_round_trip(rng: np.random.Generator) -> None:
    for vector in rng.uniform(-1.5, 1.5, (20, 3)):
        np.testing.assert_allclose(
            vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-9
        )


def test_points_and_poses_move_together() -> None:
    log = small_log()
    aligned = Alignment(path=path()).applied_to(log)
    before, after = log.sweeps[0].load(), aligned.sweeps[0].load()
    move = path().at(log.sweeps[0].time_ns)
    np.testing.assert_allclose(after.points_world, move.apply(before.points_world), atol=1e-5)
    for old, new in ((log, aligned),):
        seen = old.frames[0].world_from_camera.inverse().apply(before.points_world)
        now = new.frames[0].world_from_camera.inverse().apply(after.points_world)
        np.testing.assert_allclose(now, seen, atol=1e-5)
    np.testing.assert_allclose(after.distances_m, before.distances_m, atol=1e-5)
    np.testing.assert_allclose(aligned.ego.positions_m[5], [5.1, 0.0, 0.0], atol=1e-9)
    assert aligned.actors[0].trajectory.matrices[5, 1, 0] > 0.009


def test_a_camera_that_ticks_later_sees_from_farther_on() -> None:
    log = small_log()
    correction = CameraCorrection(np.array([0.0, 0.01, 0.0]), np.array([0.0, 0.0, 0.2]), 0.02)
    frame = Alignment(cameras={"front": correction}).applied_to(log).frames[0]
    assert frame.time_ns == log.frames[0].time_ns + 20_000_000
    np.testing.assert_allclose(frame.world_from_camera.translation_m, [5.4, 0, 2], atol=1e-6)
    axis = frame.world_from_camera.rotate(np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(axis, [np.cos(0.01), -np.sin(0.01), 0.0], atol=1e-9)


def test_the_rolling_shutter_can_be_left_out() -> None:
    log = small_log()
    assert Alignment().applied_to(log).frames[0].shutter is not None
    assert Alignment(has_rolling_shutter=False).applied_to(log).frames[0].shutter is None
