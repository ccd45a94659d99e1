"""The style `boulevard`: a wide road, two rows of trees, tram tracks, and tall ornate terraces."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim_lab.synthetic.greenery import build_post, build_sign
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part, box, merge_parts, tube
from lightsim_lab.synthetic.styles import boulevard_table as table
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M, StreetStyle
from lightsim_lab.synthetic.styles.coatings import style_finishes
from lightsim_lab.synthetic.styles.ground import Kerbside, carriageway, flat, surroundings
from lightsim_lab.synthetic.styles.tall_facades import TallBuilding, build_tall, distant_block
from lightsim_lab.synthetic.styles.traffic import (
    draw_car,
    draw_walker,
    fast_column,
    lane_column,
    parked_row,
    placed,
)
from lightsim_lab.synthetic.styles.vegetation import dense_tree
from lightsim_lab.synthetic.styles.vehicles import build_tram
from lightsim_lab.synthetic.textures import Finish

# Height of the rails above the median, in metres.
_RAIL_M = 0.02


def sidewalk(side: int) -> Kerbside:
    """Return kerb and sidewalk at the outer edge of the near (-1) or far (+1) road."""
    edge = table.NEAR_ROAD_M[0] if side < 0 else table.FAR_ROAD_M[1]
    return Kerbside(side, edge, (("sidewalk", table.SIDEWALK_M),), table.KERB_HEIGHT_M)


def median() -> Kerbside:
    """Return the median from the kerb of the near road."""
    return Kerbside(1, table.NEAR_ROAD_M[1], table.MEDIAN, table.KERB_HEIGHT_M)


def build_boulevard(plan: StreetPlan) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material."""
    rng = plan.stream(3)
    parts = [carriageway(table.NEAR_ROAD_M), carriageway(table.FAR_ROAD_M, is_reversed=True)]
    parts += [*surroundings(), *median().build()]
    parts += Kerbside(-1, table.FAR_ROAD_M[0], (), table.KERB_HEIGHT_M).build()
    for building in draw_terraces(plan):
        parts += build_tall(building)
    for side in (-1, 1):
        edge = sidewalk(side)
        parts += edge.build()
        street = (STREET_START_M, STREET_END_M)
        parts.append(flat("earth", street, (edge.outer_y_m, side * 60.0), edge.top_m - 0.015))
        parts += _sidewalk_furniture(rng, edge)
    parts += _tracks() + _overhead_wires() + _median_furniture(rng) + _ends(rng)
    return merge_parts(parts)


def draw_terraces(plan: StreetPlan) -> list[TallBuilding]:
    """Draw a closed row of buildings on each side."""
    rng = plan.stream(2)
    buildings = []
    for side in (-1, 1):
        x = STREET_START_M
        while x < STREET_END_M - 10.0:
            width = min(float(rng.uniform(*table.WIDTH_M)), STREET_END_M - x)
            kind = str(rng.choice(["stone", "stone", "brick", "tile"]))
            building = TallBuilding(
                kind=kind,
                side=side,
                x=(x, x + width),
                front_m=sidewalk(side).outer_y_m,
                floors=int(rng.choice(table.FLOORS)),
                wall=str(rng.choice(table.WALLS[kind])),
                trim=f"trim{int(rng.integers(2))}",
                glass=f"glass{int(rng.integers(table.GLASSES))}",
                roof=str(rng.choice(table.ROOFS)),
                seed=int(rng.integers(2**31)),
            )
            buildings.append(building)
            x += width
    return buildings


def _tracks() -> list[Part]:
    """Build four rails in the median's track bed."""
    z = median().top_m
    parts = []
    for middle in table.TRACKS_Y_M:
        for y in (middle - table.HALF_GAUGE_M, middle + table.HALF_GAUGE_M):
            low, high = (STREET_START_M, y - 0.035, 0.0), (STREET_END_M, y + 0.035, z + _RAIL_M)
            parts.append(box("rail", low, high))
            parts.append(box("paving", (low[0], y - 0.2, 0.0), (high[0], y + 0.2, z + 0.006)))
    return parts


def _overhead_wires() -> list[Part]:
    """Build masts between the tracks, with arms, and contact and catenary wires."""
    z = median().top_m
    middle = sum(table.TRACKS_Y_M) / 2
    masts = np.arange(STREET_START_M + 6, STREET_END_M, table.MAST_PITCH_M).tolist()
    wire = z + _RAIL_M + table.WIRE_M
    parts = []
    for x in masts:
        parts.append(tube("iron", (x, middle, z), (x, middle, wire + 1.6), (0.13, 0.09), 12))
        ends = [(x, y, wire + 0.7) for y in (table.TRACKS_Y_M[0] - 0.3, table.TRACKS_Y_M[1] + 0.3)]
        parts.append(tube("iron", ends[0], ends[1], (0.045, 0.045), 8))
        for y in table.TRACKS_Y_M:
            parts.append(tube("iron", (x, y, wire), (x, y, wire + 0.7), (0.015, 0.015), 5))
    for y in table.TRACKS_Y_M:
        parts.append(tube("iron", (masts[0], y, wire), (masts[-1], y, wire), (0.012, 0.012), 4))
        for x0, x1 in pairwise(masts):
            # The carrying wire sags between the masts.
            low = (x0 + x1) / 2
            for x in (x0, x1):
                start, end = (x, y, wire + 0.7), (low, y, wire + 0.25)
                parts.append(tube("iron", start, end, (0.01, 0.01), 4))
            parts.append(tube("iron", (low, y, wire), (low, y, wire + 0.25), (0.008, 0.008), 4))
    return parts


def _median_furniture(rng: np.random.Generator) -> list[Part]:
    """Build the two rows of trees, with benches between them."""
    z = median().top_m
    parts: list[Part] = []
    for y in table.TREE_ROWS_Y_M:
        start = STREET_START_M + float(rng.uniform(2, 6))
        for x in np.arange(start, STREET_END_M - 3, table.TREE_PITCH_M).tolist():
            place = (x + float(rng.uniform(-0.4, 0.4)), y, z - 0.05)
            parts += dense_tree(rng, place, table.ROW_TREE)
            if rng.random() < 0.3:
                parts += _bench((x + table.TREE_PITCH_M / 2, y, z))
    return parts


def _bench(foot_m: tuple[float, float, float]) -> list[Part]:
    x, y, z = foot_m
    parts = [
        box("iron", (x + s, y - 0.22, z), (x + s + 0.06, y + 0.22, z + 0.42)) for s in (-0.8, 0.74)
    ]
    for d in (-0.22, -0.06, 0.1):
        parts.append(box("bench", (x - 0.95, y + d, z + 0.42), (x + 0.95, y + d + 0.12, z + 0.46)))
    return parts


def _sidewalk_furniture(rng: np.random.Generator, edge: Kerbside) -> list[Part]:
    """Build lamps, young trees, signs, advertising columns and bollards."""
    parts: list[Part] = []
    side, z = edge.side, edge.top_m
    y = edge.kerb_y_m + side * 0.8
    start = STREET_START_M + float(rng.uniform(3, 9))
    for number, x in enumerate(np.arange(start, STREET_END_M - 3, 11.0).tolist()):
        if number % 2 == 0:
            parts += build_post((x, y, z), -side, 8.2)
        elif rng.random() < 0.6:
            parts += dense_tree(rng, (x, y + side * 0.4, z - 0.05), table.SIDEWALK_TREE)
        elif rng.random() < 0.5:
            place = (x, y + side * 0.9)
            parts.append(tube("shop", (*place, z), (*place, z + 3.0), (0.6, 0.6), 20))
            parts.append(tube("iron", (*place, z + 3.0), (*place, z + 3.3), (0.72, 0.3), 20))
        else:
            parts += build_sign((x, y, z), f"sign{int(rng.integers(table.SIGNS))}")
    for x in np.arange(STREET_START_M + 2, STREET_END_M, 4.5).tolist():
        at = (x, edge.kerb_y_m + side * 0.35)
        parts.append(tube("iron", (*at, z), (*at, z + 0.9), (0.05, 0.04), 8))
    return parts


def _ends(rng: np.random.Generator) -> list[Part]:
    """Build blocks across both ends of the boulevard."""
    parts: list[Part] = []
    for x in (STREET_START_M - 62.0, STREET_END_M + 40.0):
        for y in np.arange(-34.0, 48.0, 20.0).tolist():
            area = (x, y, x + 20.0, y + 19.9)
            parts += distant_block(rng, area, float(rng.uniform(17, 26)))
    return parts


def build_boulevard_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool
) -> tuple[Participant, ...]:
    """Draw parked rows, two lanes of traffic on each road, trams and pedestrians."""
    rng = plan.stream(4)
    people: list[Participant] = []
    for side, y in zip((-1, 1), table.PARKED_Y_M, strict=True):
        people += parked_row(rng, y, side, 0.75)
    own, beside = table.LANES_Y_M
    people.append(draw_car(rng, (15.0, own, 0.0), ego_speed_m_s * 0.92))
    people.append(draw_car(rng, (-14.0, own, 0.0), ego_speed_m_s * 1.02))
    people += lane_column(rng, (beside, 0.0), (-24.0, 9.0, 34.0), (9.5, 11.5))
    inner, outer = table.FAR_LANES_Y_M
    if has_fast_traffic:
        people += fast_column(plan.stream(5), inner)
    else:
        people += lane_column(rng, (inner, np.pi), (18.0, 44.0, 76.0), (10.0, 12.0))
    people += lane_column(rng, (outer, np.pi), (6.0, 33.0, 60.0), (9.0, 11.0))
    people += _trams(rng)
    for side, heading in ((-1, 0.0), (1, np.pi)):
        edge = sidewalk(side)
        for x in rng.uniform(6.0, 34.0, 2).tolist():
            y = edge.outer_y_m - side * float(rng.uniform(1.2, 2.6))
            people.append(draw_walker(rng, (x, y, float(heading)), edge.top_m, 1.3))
    return tuple(people)


def _trams(rng: np.random.Generator) -> list[Participant]:
    """Draw an oncoming tram, and in half of the streets one that stands on the near track."""
    ground = median().top_m + _RAIL_M
    near, far = table.TRACKS_Y_M
    tram, kind = build_tram(table.WIRE_M), ActorKind.RAIL_VEHICLE
    place = (float(rng.uniform(34.0, 60.0)), far, float(np.pi))
    trams = [placed(rng, kind, tram, place, float(rng.uniform(7.0, 10.0)), ground)]
    if rng.random() < 0.5:
        place = (float(rng.uniform(8.0, 30.0)), near, 0.0)
        trams.append(placed(rng, kind, tram, place, 0.0, ground))
    return trams


def make_boulevard_finishes(plan: StreetPlan) -> dict[str, Finish]:
    """Return all finishes by name."""
    return style_finishes(plan, table.COATINGS, table.ROAD)


# Avenue with trees in rows and a tram in its median.
BOULEVARD = StreetStyle(
    make_boulevard_finishes,
    build_boulevard,
    build_boulevard_participants,
    (
        (table.PARKED_Y_M[0], 0.0),
        *((y, 0.0) for y in table.LANES_Y_M),
        *((y, np.pi) for y in table.FAR_LANES_Y_M),
        (table.PARKED_Y_M[1], np.pi),
    ),
)
