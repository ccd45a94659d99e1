"""The style `city`: terraced box houses, street trees, rows of parked cars."""

from __future__ import annotations

import numpy as np

from lightsim_lab.synthetic.buildings import Building, build_house
from lightsim_lab.synthetic.finishes import GLASS_COUNT, WALL_COUNT, make_finishes
from lightsim_lab.synthetic.greenery import build_post, build_sign, build_tree
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part, box, merge_parts, rectangle, tube
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M, StreetStyle
from lightsim_lab.synthetic.styles.crossing import (
    CROSSING_M,
    beside_crossing,
    furniture_beside_crossing,
    is_crossed,
)
from lightsim_lab.synthetic.styles.traffic import draw_car, draw_walker, fast_column
from lightsim_lab.synthetic.textures import Finish

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


def make_city_finishes(plan: StreetPlan) -> dict[str, Finish]:
    """Return all finishes by name."""
    # Finishes, background, participants and fast cars have separate random streams (3, 2, 4 and
    # 10), so that a change of one does not change the others.
    rng = np.random.default_rng([plan.seed, 3])
    return make_finishes(rng, STREET_END_M - STREET_START_M, 2 * ROAD_HALF_M, LANE_M)


def build_city(plan: StreetPlan, has_crossing: bool = False) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material; the junction is optional."""
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


def build_city_participants(
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
                people.append(draw_car(rng, place, 0.0))
            x += float(rng.uniform(5.9, 8.5))
    # One car ahead of the ego vehicle and one behind it, at similar speeds.
    people.append(draw_car(rng, (14.0, -LANE_M / 2, 0.0), ego_speed_m_s * 0.92))
    people.append(draw_car(rng, (-13.0, -LANE_M / 2, 0.0), ego_speed_m_s * 1.02))
    oncoming: list[Participant] = []
    for x in (22.0, 44.0, 88.0):
        place = (x + float(rng.uniform(-4, 4)), LANE_M / 2 + 0.05, float(np.pi))
        oncoming.append(draw_car(rng, place, float(rng.uniform(8.0, 11.0))))
    if has_fast_traffic:
        oncoming = fast_column(np.random.default_rng([plan.seed, 10]), LANE_M / 2 + 0.05)
    people += oncoming
    ground_m = _KERB_HEIGHT_M - 0.005
    people += [
        draw_walker(rng, (float(rng.uniform(9, 13)), -FRONT_M + 1.4, 0.0), ground_m, 1.4),
        draw_walker(rng, (float(rng.uniform(16, 24)), FRONT_M - 1.3, float(np.pi)), ground_m, 1.2),
    ]
    return tuple(people)


# Street of a city with continuous facades.
CITY = StreetStyle(
    make_city_finishes,
    build_city,
    build_city_participants,
    # Parking rows and lanes on both sides, each with its direction of travel.
    ((-PARKED_Y_M, 0.0), (PARKED_Y_M, np.pi), (-LANE_M / 2, 0.0), (LANE_M / 2, np.pi)),
)
