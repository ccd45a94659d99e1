"""Cars and pedestrians with random shapes, colours and names."""

from __future__ import annotations

import uuid
from collections.abc import Sequence

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim_lab.synthetic.finishes import CLOTH_COUNT, PAINT_COUNT
from lightsim_lab.synthetic.participants import CAR_SHAPES, Participant, build_car, build_walker
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M


def draw_car(
    rng: np.random.Generator,
    x_y_heading: tuple[float, float, float],
    speed_m_s: float,
    ground_m: float = 0.0,
) -> Participant:
    """Draw a car; `ground_m` is the height of its wheels' lowest points."""
    shape = CAR_SHAPES[int(rng.integers(len(CAR_SHAPES)))]
    parts, size = build_car(shape, f"paint{int(rng.integers(PAINT_COUNT))}")
    x, y, heading = x_y_heading
    place = (x, y, ground_m)
    return Participant(draw_name(rng), ActorKind.CAR, parts, size, place, heading, speed_m_s)


def draw_walker(
    rng: np.random.Generator,
    x_y_heading: tuple[float, float, float],
    ground_m: float,
    speed_m_s: float,
) -> Participant:
    """Draw a pedestrian on a sidewalk of height `ground_m`."""
    i, j = rng.integers(CLOTH_COUNT, size=2).tolist()
    parts, size = build_walker(f"cloth{i}", f"cloth{j}")
    x, y, heading = x_y_heading
    kind, place = ActorKind.PEDESTRIAN, (x, y, ground_m)
    return Participant(draw_name(rng), kind, parts, size, place, heading, speed_m_s)


def fast_column(rng: np.random.Generator, y_m: float) -> list[Participant]:
    """Draw oncoming cars in one lane at one speed, 15 to 18 m/s, with gaps of 5 to 11 m."""
    speed_m_s = float(rng.uniform(15.0, 18.0))
    cars: list[Participant] = []
    # Behind the ego vehicle as well; as far beyond the street's end as there is ground.
    x = -30.0
    while x < STREET_END_M + 20.0:
        cars.append(draw_car(rng, (x, y_m, float(np.pi)), speed_m_s))
        x += cars[-1].size_lwh_m[0] + float(rng.uniform(5.0, 11.0))
    return cars


def draw_name(rng: np.random.Generator) -> str:
    """Draw a reproducible UUID, as PandaSet's actors have."""
    return str(uuid.UUID(bytes=rng.bytes(16), version=4))


def parked_row(
    rng: np.random.Generator,
    y_m: float,
    side: int,
    occupancy: float,
    kept_free: Sequence[tuple[float, float]] = (),
) -> list[Participant]:
    """Draw cars at the kerb, heading as the traffic of their side.

    Args:
        occupancy: probability that a place is taken.
        kept_free: ranges of x of drives and gates.
    """
    cars: list[Participant] = []
    x = STREET_START_M + float(rng.uniform(2, 8))
    while x < STREET_END_M - 6:
        # Half the length of the longest car, and 0.5 m to pass.
        is_free = all(not x0 - 3.1 < x < x1 + 3.1 for x0, x1 in kept_free)
        if rng.random() < occupancy and is_free:
            place = (x, y_m + float(rng.uniform(-0.08, 0.08)))
            heading = (0.0 if side < 0 else np.pi) + float(rng.normal(0, 0.015))
            cars.append(draw_car(rng, (*place, float(heading)), 0.0))
        x += float(rng.uniform(6.2, 8.5))
    return cars


def lane_column(
    rng: np.random.Generator,
    y_and_heading: tuple[float, float],
    starts_m: Sequence[float],
    speeds_m_s: tuple[float, float],
) -> list[Participant]:
    """Draw cars in one lane, near the given x and at one speed, so that none overtakes."""
    speed = float(rng.uniform(*speeds_m_s))
    y, heading = y_and_heading
    return [
        draw_car(rng, (x + float(rng.uniform(-4, 4)), y, float(heading)), speed) for x in starts_m
    ]


def placed(
    rng: np.random.Generator,
    kind: ActorKind,
    built: tuple[tuple[Part, ...], tuple[float, float, float]],
    x_y_heading: tuple[float, float, float],
    speed_m_s: float = 0.0,
    ground_m: float = 0.0,
) -> Participant:
    """Return a vehicle at a place, with a random name; `built` are its parts and size."""
    parts, size = built
    x, y, heading = x_y_heading
    return Participant(draw_name(rng), kind, parts, size, (x, y, ground_m), heading, speed_m_s)
