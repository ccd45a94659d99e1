"""Geometry of the synthetic street: ground, buildings, trees, posts, cars and pedestrians."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim_lab.synthetic.buildings import Building, build_house
from lightsim_lab.synthetic.crossing import (
    CROSS_TRAFFIC,
    CROSSING_M,
    beside_crossing,
    furniture_beside_crossing,
    is_crossed,
)
from lightsim_lab.synthetic.ego_body import build_ego_body
from lightsim_lab.synthetic.finishes import (
    CLOTH_COUNT,
    GLASS_COUNT,
    PAINT_COUNT,
    WALL_COUNT,
    make_finishes,
)
from lightsim_lab.synthetic.greenery import build_post, build_sign, build_tree
from lightsim_lab.synthetic.participants import (
    CAR_SHAPES,
    Participant,
    build_car,
    build_walker,
)
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part, box, merge_parts, rectangle, tube
from lightsim_lab.synthetic.textures import Finish

# Smallest x of the street, frame `street`, in metres. The ego vehicle starts at x = 0.
STREET_START_M = -55.0
# Largest x of the street, in metres: the longest log ends at x = 52.
STREET_END_M = 125.0
# Width of a lane, in metres; there is one per direction.
LANE_M = 3.2
# Half width of the road between the kerbs, in metres: a lane and a row of parked cars.
ROAD_HALF_M = 5.5
# Height of the kerb above the road, in metres.
_KERB_HEIGHT_M = 0.14
# Distance of the facades from the centre line, in metres: the sidewalk is 3 m wide.
FRONT_M = ROAD_HALF_M + 3.0
# Distance of the middle of the row of parked cars from the centre line, in metres.
PARKED_Y_M = LANE_M + 0.5 * (ROAD_HALF_M - LANE_M) - 0.05


@dataclass(frozen=True, eq=False)
class Street:
    """Geometry and materials of the whole scene.

    Args:
        background: static parts, frame `street`.
        participants: actors, each in its own frame `actor`.
        finishes: finishes by material name.
        ego_body: parts of the ego vehicle, frame `ego`; empty if no sensor sees it.
    """

    plan: StreetPlan
    background: tuple[Part, ...]
    participants: tuple[Participant, ...]
    finishes: Mapping[str, Finish]
    ego_body: tuple[Part, ...] = ()


def build_street(
    plan: StreetPlan,
    ego_speed_m_s: float,
    has_fast_traffic: bool = False,
    is_standing: bool = False,
) -> Street:
    """Build the street of a plan; it is reproducible.

    Args:
        is_standing: the ego vehicle has a body and waits at a junction with cross traffic.
    """
    # Finishes, background, participants, fast cars, the ego vehicle's body and cross traffic have
    # separate random streams (3, 2, 4, 10, 11 and 12), so that a change of one does not change the
    # others.
    length, width = STREET_END_M - STREET_START_M, 2 * ROAD_HALF_M
    rng = np.random.default_rng([plan.seed, 3])
    finishes = make_finishes(rng, length, width, LANE_M)
    background = build_background(plan, is_standing)
    if not is_standing:
        participants = build_participants(plan, ego_speed_m_s, has_fast_traffic)
        return Street(plan, background, participants, finishes)
    return Street(plan, background, _waiting_participants(plan), finishes, build_ego_body(plan))


def build_background(plan: StreetPlan, has_crossing: bool = False) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material."""
    rng = np.random.default_rng([plan.seed, 2])
    parts = _ground(has_crossing)
    for side in (-1, 1):
        houses, furniture = _row_of_houses(rng, side), _furniture(rng, side)
        if has_crossing:
            houses, furniture = beside_crossing(houses), furniture_beside_crossing(furniture)
        for house in houses:
            parts += build_house(house)
        parts += furniture
    parts += _ends(rng)
    return merge_parts(parts)


def _ground(has_crossing: bool) -> list[Part]:
    """Build road, kerbs, sidewalks and earth."""
    x0, length = STREET_START_M, STREET_END_M - STREET_START_M
    # Ranges of x with kerb and sidewalk.
    spans = ((x0, CROSSING_M[0]), (CROSSING_M[1], STREET_END_M))
    spans = spans if has_crossing else ((x0, STREET_END_M),)
    parts = [
        rectangle("road", (x0, -ROAD_HALF_M, 0.0), (length, 0, 0), (0, 2 * ROAD_HALF_M, 0)),
        rectangle("earth", (x0 - 150, -200.0, -0.03), (length + 300, 0, 0), (0, 400.0, 0)),
    ]
    for side in (-1.0, 1.0):
        inner, kerb = side * ROAD_HALF_M, side * (ROAD_HALF_M + 0.18)
        outer = side * (FRONT_M + 0.3)
        low, high = sorted((inner, kerb))
        for x in np.arange(x0, STREET_END_M, 1.0).tolist():
            if not (has_crossing and is_crossed(x, x + 1.0)):
                kerb_end = (x + 0.994, high, _KERB_HEIGHT_M)
                parts.append(box("kerb", (x + 0.006, low, -0.02), kerb_end))
        low, high = sorted((kerb, outer))
        for start, end in spans:
            sidewalk_end = (end, high, _KERB_HEIGHT_M - 0.005)
            parts.append(box("sidewalk", (start, low, -0.02), sidewalk_end))
        low, high = sorted((outer, side * 40.0))
        for start, end in spans:
            origin = (start, low, _KERB_HEIGHT_M - 0.02)
            parts.append(rectangle("earth", origin, (end - start, 0, 0), (0, high - low, 0)))
        if has_crossing:
            low, high = sorted((inner, side * 40.0))
            across = (CROSSING_M[1] - CROSSING_M[0], 0, 0)
            parts.append(rectangle("road", (CROSSING_M[0], low, 0.0), across, (0, high - low, 0)))
    return parts


def _row_of_houses(rng: np.random.Generator, side: int) -> list[Building]:
    """Draw one row of buildings of various widths and heights, some with gaps between them."""
    houses = []
    # Widths are clipped at the end of the street.
    x = STREET_START_M
    while x < STREET_END_M - 8.0:
        width = float(rng.uniform(8.0, 17.0))
        wall = int(rng.integers(WALL_COUNT))
        houses.append(
            Building(
                start_m=x,
                width_m=min(width, STREET_END_M - x),
                depth_m=float(rng.uniform(9.0, 13.0)),
                floors=int(rng.choice([2, 2, 3, 3, 4, 5, 6])),
                side=side,
                front_m=FRONT_M + float(rng.choice([0.0, 0.0, 0.25, 1.2])),
                wall=f"wall{wall}",
                trim=f"trim{int(rng.integers(3))}",
                glass=f"glass{int(rng.integers(GLASS_COUNT))}",
                bay_m=float(rng.uniform(2.3, 3.2)),
                seed=int(rng.integers(2**31)),
            )
        )
        x += width + (float(rng.uniform(2.5, 7.0)) if rng.random() < 0.45 else 0.0)
    return houses


def _ends(rng: np.random.Generator) -> list[Part]:
    """Build distant buildings beyond both ends of the street and behind the gaps."""
    parts: list[Part] = []
    x0, x1 = STREET_START_M, STREET_END_M
    for low, high in ((x0 - 45.0, x0 - 25.0), (x1 + 25.0, x1 + 45.0)):
        for y in np.arange(-36.0, 36.0, 18.0).tolist():
            parts += _distant_building(rng, (low, y), (high, y + 17.0), 13.0)
    for low, high in ((-46.0, -32.0), (32.0, 46.0)):
        for x in np.arange(x0 - 20.0, x1 + 20.0, 20.0).tolist():
            parts += _distant_building(rng, (x, low), (x + float(rng.uniform(14, 20)), high), 11.0)
    return parts


def _distant_building(
    rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float], tallest_m: float
) -> list[Part]:
    """Build a distant building: a box with windows on its four sides."""
    height = float(rng.uniform(6.0, tallest_m))
    wall = f"wall{int(rng.integers(WALL_COUNT))}"
    parts = [box(wall, (*low, 0.0), (*high, height))]
    for z in np.arange(1.2, height - 2.0, 3.1).tolist():
        for s in np.arange(low[1] + 1.5, high[1] - 2.0, 3.0).tolist():
            parts.append(box("glass0", (low[0] - 0.02, s, z), (high[0] + 0.02, s + 1.3, z + 1.6)))
        for s in np.arange(low[0] + 1.5, high[0] - 2.0, 3.0).tolist():
            parts.append(box("glass0", (s, low[1] - 0.02, z), (s + 1.3, high[1] + 0.02, z + 1.6)))
    return parts


def _furniture(rng: np.random.Generator, side: int) -> list[Part]:
    """Build trees, lamp posts, signs, bins and bollards along one sidewalk."""
    parts: list[Part] = []
    edge = side * (ROAD_HALF_M + 0.7)
    ground = _KERB_HEIGHT_M
    offset = float(rng.uniform(0, 12))
    for x in np.arange(STREET_START_M + 4 + offset, STREET_END_M - 4, 26.0).tolist():
        parts += build_post((x, edge, ground), -side, float(rng.uniform(6.2, 7.5)))
    offset = float(rng.uniform(6, 16))
    for x in np.arange(STREET_START_M + 8 + offset, STREET_END_M - 6, 17.0).tolist():
        if rng.random() < 0.7:
            place = (x + float(rng.uniform(-2, 2)), edge + side * 0.25, ground)
            parts += build_tree(rng, place, float(rng.uniform(4.8, 7.2)))
    for x in rng.uniform(STREET_START_M, STREET_END_M, 7).tolist():
        parts += build_sign((x, edge - side * 0.25, ground), f"sign{int(rng.integers(3))}")
    for x in rng.uniform(STREET_START_M, STREET_END_M, 9).tolist():
        y = side * (FRONT_M - 0.55)
        parts.append(tube("bin", (x, y, ground), (x, y, ground + 0.95), (0.26, 0.3), 16))
    for x in np.arange(STREET_START_M + 2, STREET_END_M, 9.3).tolist():
        y = side * (ROAD_HALF_M + 0.45)
        parts.append(tube("steel", (x, y, ground), (x, y, ground + 0.85), (0.05, 0.05), 10))
    return parts


def build_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool = False
) -> tuple[Participant, ...]:
    """Draw parked cars, cars ahead of and behind the ego vehicle, oncoming cars and pedestrians.

    Args:
        has_fast_traffic: a dense column of faster cars replaces the three oncoming ones.
    """
    rng = np.random.default_rng([plan.seed, 4])
    people: list[Participant] = []
    for side in (-1, 1):
        x = STREET_START_M + float(rng.uniform(2, 8))
        while x < STREET_END_M - 6:
            if rng.random() < 0.62:
                y = side * (PARKED_Y_M + float(rng.uniform(-0.1, 0.1)))
                heading = 0.0 if side < 0 else np.pi
                place = (x, y, float(heading + rng.normal(0, 0.02)))
                people.append(_car(rng, place, 0.0))
            x += float(rng.uniform(5.9, 8.5))
    # One car ahead of the ego vehicle and one behind it, at similar speeds.
    people.append(_car(rng, (14.0, -LANE_M / 2, 0.0), ego_speed_m_s * 0.92))
    people.append(_car(rng, (-13.0, -LANE_M / 2, 0.0), ego_speed_m_s * 1.02))
    oncoming: list[Participant] = []
    for x in (22.0, 44.0, 88.0):
        place = (x + float(rng.uniform(-4, 4)), LANE_M / 2 + 0.05, float(np.pi))
        oncoming.append(_car(rng, place, float(rng.uniform(8.0, 11.0))))
    people += _fast_column(plan) if has_fast_traffic else oncoming
    people += [
        _walker(rng, (float(rng.uniform(9, 13)), -FRONT_M + 1.4, 0.0), 1.4),
        _walker(rng, (float(rng.uniform(16, 24)), FRONT_M - 1.3, float(np.pi)), 1.2),
    ]
    return tuple(people)


def _waiting_participants(plan: StreetPlan) -> tuple[Participant, ...]:
    """Return the usual participants, those on the road at rest, and cars that cross."""
    people: list[Participant] = []
    for actor in build_participants(plan, 0.0):
        x, y, z = actor.start_m
        is_car = actor.kind is ActorKind.CAR
        half_m = actor.size_lwh_m[0] / 2
        if is_car and abs(y) < LANE_M and is_crossed(x - half_m, x + half_m):
            # The car ahead of the ego vehicle waits beyond the junction.
            x = CROSSING_M[1] + half_m + 2.0
        if not (is_car and is_crossed(x - half_m, x + half_m)):
            speed_m_s = 0.0 if is_car else actor.speed_m_s
            people.append(replace(actor, start_m=(x, y, z), speed_m_s=speed_m_s))
    rng = np.random.default_rng([plan.seed, 12])
    for x, heading, y, speed_m_s in CROSS_TRAFFIC:
        people.append(_car(rng, (x, y, heading), speed_m_s))
    return tuple(people)


def _fast_column(plan: StreetPlan) -> list[Participant]:
    """Draw oncoming cars at one speed, 15 to 18 m/s, with gaps of 5 to 11 m."""
    rng = np.random.default_rng([plan.seed, 10])
    speed_m_s = float(rng.uniform(15.0, 18.0))
    cars: list[Participant] = []
    # Behind the ego vehicle as well; as far beyond the street's end as there is ground.
    x = -30.0
    while x < STREET_END_M + 20.0:
        cars.append(_car(rng, (x, LANE_M / 2 + 0.05, float(np.pi)), speed_m_s))
        x += cars[-1].size_lwh_m[0] + float(rng.uniform(5.0, 11.0))
    return cars


def _car(
    rng: np.random.Generator, x_y_heading: tuple[float, float, float], speed_m_s: float
) -> Participant:
    shape = CAR_SHAPES[int(rng.integers(len(CAR_SHAPES)))]
    parts, size = build_car(shape, f"paint{int(rng.integers(PAINT_COUNT))}")
    x, y, heading = x_y_heading
    return Participant(_name(rng), ActorKind.CAR, parts, size, (x, y, 0.0), heading, speed_m_s)


def _walker(
    rng: np.random.Generator, x_y_heading: tuple[float, float, float], speed_m_s: float
) -> Participant:
    i, j = rng.integers(CLOTH_COUNT, size=2).tolist()
    parts, size = build_walker(f"cloth{i}", f"cloth{j}")
    x, y, heading = x_y_heading
    place = (x, y, _KERB_HEIGHT_M - 0.005)
    kind = ActorKind.PEDESTRIAN
    return Participant(_name(rng), kind, parts, size, place, heading, speed_m_s)


def _name(rng: np.random.Generator) -> str:
    """Draw a reproducible UUID, as PandaSet's actors have."""
    return str(uuid.UUID(bytes=rng.bytes(16), version=4))
