"""Transforms compose only where frames meet; trajectories interpolate and never extrapolate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lightsim.core.frames import (
    RigidTransform,
    Trajectory,
    matrices_from_quaternions,
    quaternion_from_matrix,
)
from lightsim.errors import FrameMismatchError, InputError, OutOfRangeError

finite = st.floats(-50, 50)


@st.composite
def transforms(draw: st.DrawFn) -> RigidTransform:
    q = np.array([draw(finite) for _ in range(4)])
    if np.linalg.norm(q) < 1e-3:
        q = np.array([1.0, 0.0, 0.0, 0.0])
    return RigidTransform.from_quaternion("world", "ego", q, np.array([draw(finite)] * 3))


@given(transforms())
def test_inverse_undoes(world_from_ego: RigidTransform) -> None:
    both = world_from_ego @ world_from_ego.inverse()
    assert (both.dst, both.src) == ("world", "world")
    np.testing.assert_allclose(both.matrix, np.eye(4), atol=1e-9)


@given(transforms())
def test_quaternion_round_trip(transform: RigidTransform) -> None:
    q = quaternion_from_matrix(transform.rotation)
    np.testing.assert_allclose(matrices_from_quaternions(q[None])[0], transform.rotation, atol=1e-9)


def test_quaternions_have_their_scalar_first() -> None:
    """By the definition: q v q* with q = (cos 30 deg, sin 30 deg about z) turns x by 60 degrees."""
    q = np.array([np.cos(np.pi / 6), 0.0, 0.0, np.sin(np.pi / 6)])
    rotation = matrices_from_quaternions(q[None])[0]
    np.testing.assert_allclose(rotation[:, 0], [0.5, np.sqrt(0.75), 0.0], atol=1e-12)
    np.testing.assert_allclose(quaternion_from_matrix(rotation), q, atol=1e-12)


def test_unequal_inner_frames_are_refused() -> None:
    a = RigidTransform.identity("world", "ego")
    with pytest.raises(FrameMismatchError, match="'ego' and 'world'"):
        _ = a @ a


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, 1.1, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)],
)
def test_matrices_that_are_no_rigid_transform_are_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError):
        RigidTransform("world", "ego", matrix)


def test_trajectory_interpolates_a_constant_turn_exactly() -> None:
    yaws = np.array([0.0, 0.8])
    poses = [
        RigidTransform.from_yaw("world", "ego", y, np.array([10 * y, 0.0, 0.0])).matrix
        for y in yaws
    ]
    path = Trajectory("world", "ego", np.array([0, 1000], dtype=np.int64), np.stack(poses))
    middle = path.at(250)
    assert middle.yaw_rad == pytest.approx(0.2, abs=1e-9)
    np.testing.assert_allclose(middle.translation_m, [2.0, 0, 0], atol=1e-12)


def test_trajectory_never_extrapolates_but_may_hold() -> None:
    path = Trajectory(
        "world", "ego", np.array([0, 1000], dtype=np.int64), np.stack([np.eye(4)] * 2)
    )
    with pytest.raises(OutOfRangeError, match="0 to 1000"):
        path.at(1001)
    np.testing.assert_array_equal(path.at(1001, hold_s=1e-6).matrix, np.eye(4))


def test_held_poses_are_those_of_the_ends_and_of_many_times_at_once() -> None:
    ends = [RigidTransform.from_yaw("world", "ego", k, np.full(3, k)).matrix for k in (0.0, 1.0)]
    path = Trajectory("world", "ego", np.array([100, 200], dtype=np.int64), np.stack(ends))
    times_ns = np.array([0, 100, 130, 200, 900])
    one_by_one = np.stack([path.held(int(time_ns)).matrix for time_ns in times_ns])
    np.testing.assert_allclose(path.held_at(times_ns), one_by_one, atol=1e-12)
    np.testing.assert_allclose(path.held_positions_m(times_ns), one_by_one[:, :3, 3], atol=1e-12)
    np.testing.assert_array_equal(one_by_one[[0, -1]], ends)


def test_points_move_to_the_source_frame_each_at_its_own_time(rng: np.random.Generator) -> None:
    poses = [
        RigidTransform.from_quaternion("world", "ego", q, t).matrix
        for q, t in zip(rng.normal(size=(4, 4)), rng.normal(size=(4, 3)), strict=True)
    ]
    times_ns = 10**18 + np.array([0, 700, 1000, 1800], dtype=np.int64)
    times = np.concatenate([times_ns, 10**18 + rng.integers(-200, 2000, 50)])
    points = rng.normal(size=(len(times), 3))
    for count in (1, 4):
        path = Trajectory("world", "ego", times_ns[:count], np.stack(poses[:count]))
        expected = [
            path.held(int(t)).inverse().apply(p[None])[0]
            for t, p in zip(times, points, strict=True)
        ]
        np.testing.assert_allclose(path.to_src(points, times), expected, atol=1e-9)


def test_times_must_increase() -> None:
    with pytest.raises(InputError, match="increase"):
        Trajectory("world", "ego", np.array([5, 5], dtype=np.int64), np.stack([np.eye(4)] * 2))


def test_shapes_are_checked_in_tests() -> None:
    """The type checker of the test run is on: a wrong shape passed on purpose must fail."""
    with pytest.raises(Exception, match=r"points"):
        RigidTransform.identity("a", "b").apply(np.zeros((4, 2)))
