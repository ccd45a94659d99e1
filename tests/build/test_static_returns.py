"""Returns of a car that drives are left out, those of a parked one and of the street are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky
from tests.tiny_world import BOX_LWH_M, STEMS, driving_box, tiny_world

from lightsim.build.static_returns import static_returns
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.masks.sky import gather_high_points

SENSOR = np.array([0.0, -9.0, 1.0], np.float32)


@pytest.fixture
def street(rng: np.random.Generator) -> np.ndarray:
    """Points beside the lane of the driving box, one of them within a cell of 0.15 m."""
    cells = np.stack(np.meshgrid(np.arange(20, 60), np.arange(-40, 40), np.arange(20)), axis=-1)
    cells = cells.reshape(-1, 3)
    return ((cells + rng.uniform(0.1, 0.9, cells.shape)) * 0.15).astype(np.float32)


@pytest.fixture
def log(street: np.ndarray, rng: np.random.Generator) -> DrivingLog:
    """Three sweeps of the street, with 500 returns in and just around the driving box, which are
    up to 0.1 s older than the sweep."""
    world = tiny_world(constant_sky()).log
    car = driving_box()[1]
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, 3] = 6.0, 0.0, 0.8
    parked = replace(
        car,
        actor_id="parked",
        is_moving=False,
        trajectory=replace(car.trajectory, matrices=matrices),
    )

    def sweep(number: int) -> LazySweep:
        time_ns = world.frames[number].time_ns
        age_ns = rng.integers(0, 100_000_000, 500)
        centre = car.trajectory.held_positions_m(time_ns - age_ns)
        body = centre + rng.uniform(-0.5, 0.5, (500, 3)) * (BOX_LWH_M + 0.49)
        points = np.concatenate([street, body]).astype(np.float32)
        row = np.arange(len(points), dtype=np.float32)
        unknown = np.full(len(points), -1, np.int16)
        origins = np.tile(SENSOR, (len(points), 1))
        offset_s = np.concatenate([np.zeros(len(street)), -age_ns * 1e-9]).astype(np.float32)
        made = LidarSweep(STEMS[number], time_ns, points, origins, row, offset_s, unknown, unknown)
        return LazySweep(STEMS[number], time_ns, lambda: made)

    sweeps = tuple(sweep(number) for number in range(3))
    return replace(world, actors=(car, parked), sweeps=sweeps)


def test_a_driving_car_leaves_no_return_in_the_background(
    log: DrivingLog, street: np.ndarray, rng: np.random.Generator
) -> None:
    whole = static_returns(log, 10**9, rng)
    np.testing.assert_array_equal(whole.points, np.tile(street, (3, 1)))
    assert (whole.origins == SENSOR).all()
    margin_m = BOX_LWH_M / 2 + log.actors[1].box_margin_m
    is_on_parked = (np.abs(street - [6.0, 0.0, 0.8]) <= margin_m).all(axis=1)
    np.testing.assert_array_equal(whole.is_on_actor, np.tile(is_on_parked, 3))
    assert 0 < is_on_parked.sum() < len(street)
    drawn = static_returns(log, 12_000, rng)
    expected = 12_000 * len(street) / (len(street) + 500)
    # Four standard deviations of a binomial count.
    assert abs(len(drawn.points) - expected) < 4 * np.sqrt(expected)
    assert set(map(tuple, drawn.points)) <= set(map(tuple, street))
    assert len(static_returns(replace(log, sweeps=()), 10, rng).points) == 0


def test_high_points_are_those_of_the_street_once_a_cell(
    log: DrivingLog, street: np.ndarray
) -> None:
    found = gather_high_points(log)
    high = street[street[:, 2] > SENSOR[2] - 0.5]
    order = [np.lexsort(points.T) for points in (found, high)]
    np.testing.assert_array_equal(found[order[0]], high[order[1]])
    assert len(gather_high_points(replace(log, sweeps=()))) == 0
