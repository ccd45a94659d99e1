"""Returns of a turning car that drives at 15 m/s are told from static ones at their own times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.lidar_returns import actor_labels, is_on_actors, is_static
from lightsim.core.sensors import SWEEP_HOLD_S, LidarSweep

SIZE_LWH_M = np.array([4.5, 1.8, 1.5])
SPEED_M_S = 15.0
TURN_RAD_S = 0.3
# Seconds from the sweep's time at which two turning LiDARs scan the car.
SCANS_S = (-0.09, -0.04)
SWEEP_NS = 10**18 + 400_000_000


def driven(seconds: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
    """Poses of the car on its circle at a time in seconds from the sweep's."""
    yaw = TURN_RAD_S * seconds
    radius_m = SPEED_M_S / TURN_RAD_S
    poses = np.tile(np.eye(4), (len(seconds), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 0, 1], poses[:, 1, 0] = -np.sin(yaw), np.sin(yaw)
    poses[:, 0, 3] = radius_m * np.sin(yaw)
    poses[:, 1, 3] = 10.0 + radius_m * (1.0 - np.cos(yaw))
    poses[:, 2, 3] = SIZE_LWH_M[2] / 2
    return poses


@pytest.fixture
def car() -> ActorTrack:
    """The car, with labels at 10 Hz between the two scans of each sweep."""
    times_ns = SWEEP_NS + np.arange(-270_000_000, 100_000_000, 100_000_000, dtype=np.int64)
    poses = driven((times_ns - SWEEP_NS) * 1e-9)
    trajectory = Trajectory("world", "actor", times_ns, poses)
    return ActorTrack("car", ActorKind.CAR, SIZE_LWH_M, trajectory, True)


@pytest.fixture
def parked() -> ActorTrack:
    pose = np.eye(4)
    pose[:3, 3] = 0.0, 14.0, SIZE_LWH_M[2] / 2
    path = Trajectory("world", "actor", np.array([SWEEP_NS], dtype=np.int64), pose[None])
    return ActorTrack("parked", ActorKind.CAR, SIZE_LWH_M, path, False)


def surface(rng: np.random.Generator, count: int) -> Float64[np.ndarray, "n 3"]:
    """Points on all sides of the box, frame `actor`."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    rows, axis = np.arange(count), rng.integers(0, 3, count)
    points[rows, axis] = np.sign(points[rows, axis]) * 0.5
    return points * SIZE_LWH_M


def sweep_of(points: Float64[np.ndarray, "n 3"], offset_s: Float64[np.ndarray, " n"]) -> LidarSweep:
    blank, unknown = np.zeros(len(points), np.float32), np.full(len(points), -1, np.int16)
    origins = np.zeros((len(points), 3), np.float32)
    return LidarSweep(
        "00",
        SWEEP_NS,
        points.astype(np.float32),
        origins,
        blank,
        offset_s.astype(np.float32),
        unknown,
        unknown,
    )


def on_car(rng: np.random.Generator, offset_s: Float64[np.ndarray, " n"]) -> np.ndarray:
    poses, points = driven(offset_s), surface(rng, len(offset_s))
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]


def test_a_car_at_15_m_s_that_two_lidars_scan_leaves_no_return(
    car: ActorTrack, rng: np.random.Generator
) -> None:
    # Each scan lasts 10 ms.
    offset_s = np.concatenate([rng.uniform(scan, scan + 0.01, 500) for scan in SCANS_S])
    body = on_car(rng, offset_s)
    # Road, walls on both sides, and road where the car is at the sweep's end but was not yet.
    wall = np.stack([rng.uniform(-9, 9, 400), rng.choice([7.5, 12.5], 400), rng.uniform(0, 3, 400)])
    ahead = np.stack(
        [rng.uniform(2.2, 2.25, 99), rng.uniform(9.2, 10.8, 99), rng.uniform(0, 1, 99)]
    )
    still = np.concatenate([wall.T, ahead.T])
    early_s = np.full(len(still), -0.09)
    sweep = sweep_of(np.concatenate([body, still]), np.concatenate([offset_s, early_s]))
    expected = np.arange(len(body) + len(still)) >= len(body)
    np.testing.assert_array_equal(is_static(sweep, (car,)), expected)
    # One time for the whole sweep fails on both.
    at_end = replace(sweep, time_offset_s=np.zeros_like(sweep.time_offset_s))
    found = is_static(at_end, (car,))
    assert found[: len(body)].mean() > 0.1
    assert not found[-99:].any()


def test_parked_cars_are_static_actors_that_stand_on_ground(
    parked: ActorTrack, rng: np.random.Generator
) -> None:
    centre = parked.trajectory.positions_m[0]
    body = surface(rng, 400) + centre
    beside = body + [0.0, SIZE_LWH_M[1] + 0.3, 0.0]
    sweep = sweep_of(np.concatenate([body, beside]), rng.uniform(-0.1, 0.0, 800))
    assert is_static(sweep, (parked,)).all()
    np.testing.assert_array_equal(is_on_actors(sweep, (parked,)), np.arange(800) < 400)
    labels = actor_labels(sweep, (replace(parked, trajectory=moved(parked, 50.0)), parked))
    is_high = sweep.points_world[:, 2] > 0.12
    np.testing.assert_array_equal(labels, np.where((np.arange(800) < 400) & is_high, 2, 0))
    assert 0 < (~is_high[:400]).sum() < 200


def moved(track: ActorTrack, by_m: float) -> Trajectory:
    matrices = track.trajectory.matrices.copy()
    matrices[:, 0, 3] += by_m
    return replace(track.trajectory, matrices=matrices)


def test_returns_without_own_times_are_tested_at_the_sweeps_time(
    car: ActorTrack, rng: np.random.Generator
) -> None:
    labelled = replace(car.trajectory, times_ns=car.trajectory.times_ns + 70_000_000)
    car = replace(car, trajectory=labelled)
    body = on_car(rng, np.full(300, -0.07))
    assert not is_static(sweep_of(body, np.zeros(300)), (car,)).any()


def test_an_actor_is_absent_beyond_its_labels(parked: ActorTrack, rng: np.random.Generator) -> None:
    offset_s = SWEEP_HOLD_S + np.array([-0.01, 0.01])
    body = (surface(rng, 1) + parked.trajectory.positions_m[0]).repeat(4, axis=0)
    sweep = sweep_of(body, np.concatenate([offset_s, -offset_s]))
    np.testing.assert_array_equal(is_on_actors(sweep, (parked,)), [True, False, True, False])
    assert not is_on_actors(sweep_of(body[:0], np.zeros(0)), (parked,)).any()
