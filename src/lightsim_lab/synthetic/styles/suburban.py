"""The style `suburban`: detached houses with pitched roofs, gardens, hedges and drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightsim_lab.synthetic.greenery import build_post
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part, box, merge_parts
from lightsim_lab.synthetic.styles import suburban_table as table
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M, StreetStyle
from lightsim_lab.synthetic.styles.coatings import style_finishes
from lightsim_lab.synthetic.styles.fences import fence
from lightsim_lab.synthetic.styles.ground import Kerbside, Span, carriageway, flat, surroundings
from lightsim_lab.synthetic.styles.houses import House, build_garage, build_house, distant_house
from lightsim_lab.synthetic.styles.traffic import (
    draw_car,
    draw_walker,
    fast_column,
    lane_column,
    parked_row,
)
from lightsim_lab.synthetic.styles.vegetation import dense_tree, hedge, shrub
from lightsim_lab.synthetic.textures import Finish


@dataclass(frozen=True)
class Lot:
    """Plot of land with a house, a garage and a drive.

    Args:
        house: the house; its front is parallel to the street.
        garage: range of x of garage and drive.
        border: edge towards the sidewalk: `hedge`, `pickets` or `open`.
    """

    span: Span
    house: House
    garage: Span
    border: str
    seed: int


def draw_lots(plan: StreetPlan) -> list[Lot]:
    """Draw the lots of both sides; background and actors share them."""
    rng = plan.stream(2)
    lots = []
    for side in (-1, 1):
        x = STREET_START_M
        while (lot := _draw_lot(rng, side, x)).span[1] <= STREET_END_M:
            lots.append(lot)
            x = lot.span[1]
    return lots


def _draw_lot(rng: np.random.Generator, side: int, start_m: float) -> Lot:
    width = float(rng.uniform(*table.HOUSE_M))
    garage = float(rng.choice(table.GARAGES_M))
    left = start_m + float(rng.uniform(*table.SIDE_M))
    span = (start_m, left + width + garage + float(rng.uniform(*table.SIDE_M)))
    is_garage_first = rng.random() < 0.5
    house_x = left + garage if is_garage_first else left
    garage_x = left if is_garage_first else left + width
    front = kerbside(side).outer_y_m + side * float(rng.uniform(*table.SETBACK_M))
    wall = f"wall{int(rng.integers(table.WALLS))}"
    house = House(
        side=side,
        x=(house_x, house_x + width),
        front_m=front,
        depth_m=float(rng.uniform(*table.DEPTH_M)),
        storeys=int(rng.choice([1, 2, 2])),
        walls=(wall, f"wall{int(rng.integers(3))}" if rng.random() < 0.4 else wall),
        roof=f"roof{int(rng.integers(table.ROOFS))}",
        trim=f"trim{int(rng.choice([0, 0, 0, 1]))}",
        door=f"door{int(rng.integers(table.DOORS))}",
        glass=f"glass{int(rng.integers(table.GLASSES))}",
        pitch=float(rng.uniform(*table.PITCH)),
        roof_form=str(rng.choice(["gable", "gable", "front gable", "hip"])),
        has_bay=bool(rng.random() < 0.45),
    )
    border = str(rng.choice(["hedge", "pickets", "open", "open"]))
    drive = (garage_x + 0.25, garage_x + garage - 0.25)
    return Lot(span, house, drive, border, int(rng.integers(2**31)))


def kerbside(side: int, lots: list[Lot] | None = None) -> Kerbside:
    """Return kerb and sidewalk of a side, lowered at the drives of the lots."""
    lowered = [lot.garage for lot in lots or [] if lot.house.side == side]
    height = table.KERB_HEIGHT_M
    return Kerbside(side, side * table.ROAD_HALF_M, table.STRIPS, height, lowered)


def build_suburb(plan: StreetPlan) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material."""
    lots = draw_lots(plan)
    rng = plan.stream(3)
    parts = [carriageway((-table.ROAD_HALF_M, table.ROAD_HALF_M)), *surroundings()]
    for side in (-1, 1):
        edge = kerbside(side, lots)
        parts += edge.build()
        street = (STREET_START_M, STREET_END_M)
        parts.append(flat("lawn", street, (edge.outer_y_m, side * 75.0), edge.top_m - 0.015))
        parts += _furniture(rng, edge)
    for lot in lots:
        parts += build_house(lot.house, np.random.default_rng(lot.seed))
        parts += build_garage(lot.house, lot.garage)
        parts += _garden(lot, np.random.default_rng(lot.seed + 1))
    parts += _distance(rng)
    return merge_parts(parts)


def _garden(lot: Lot, rng: np.random.Generator) -> list[Part]:
    """Build drive, path, border, fences between neighbours, trees and shrubs of a lot."""
    side, edge = lot.house.side, kerbside(lot.house.side)
    outer, front, ground = edge.outer_y_m, lot.house.front_m, edge.top_m
    path_x = lot.house.door_x_m
    parts = [
        _paved("drive", lot.garage, (outer, front), ground),
        _paved("paving", (path_x - 0.6, path_x + 0.6), (outer, front - side * 0.9), ground),
    ]
    near = outer + side * 0.45
    openings = sorted([lot.garage, (path_x - 0.8, path_x + 0.8)])
    ends = [lot.span[0] + 0.2, *(x for span in openings for x in span), lot.span[1] - 0.2]
    for x0, x1 in zip(ends[::2], ends[1::2], strict=True):
        if x1 - x0 > 0.6 and lot.border == "hedge":
            low, high = sorted((near, near + side * 0.6))
            height = float(rng.uniform(0.9, 1.3))
            parts += hedge(rng, (x0, low, ground - 0.03), (x1, high, ground + height))
        elif x1 - x0 > 0.6 and lot.border == "pickets":
            parts += fence((x0, near, ground), (x1, near, ground), table.PICKETS)
    # A board fence to the neighbour, from the front of the house backwards.
    x, back = lot.span[0] + 0.05, front + side * (lot.house.depth_m + 12.0)
    y0, y1 = sorted((front + side * 0.5, back))
    parts += fence((x, y0, ground), (x, y1, ground), table.BOARDS)
    parts += _plants(lot, rng, (near + side * 1.0, ground))
    return parts


def _plants(lot: Lot, rng: np.random.Generator, near_and_ground: Span) -> list[Part]:
    """Build shrubs along the front, and trees beside the drive and behind the house."""
    house, side = lot.house, lot.house.side
    near, ground = near_and_ground
    parts: list[Part] = []
    for x in np.arange(house.x[0] + 0.7, house.x[1] - 0.5, 1.3).tolist():
        if abs(x - house.door_x_m) > 1.9 and not house.covers_bay(x) and rng.random() < 0.75:
            place = (x, house.front_m - side * 0.75, ground - 0.02)
            parts += shrub(rng, place, float(rng.uniform(0.35, 0.6)))
    free = (lot.span[0] + 1.5, lot.garage[0] - 1.5)
    if free[1] - free[0] < lot.span[1] - 1.5 - (lot.garage[1] + 1.5):
        free = (lot.garage[1] + 1.5, lot.span[1] - 1.5)
    if free[1] - free[0] > 2.0 and rng.random() < 0.7:
        x = float(rng.uniform(*free))
        if abs(x - house.door_x_m) > 1.5:
            y = near + side * float(rng.uniform(1.5, 3.2))
            parts += dense_tree(rng, (x, y, ground - 0.05), table.GARDEN_TREE)
    x = float(rng.uniform(lot.span[0] + 3.0, lot.span[1] - 3.0))
    behind = house.front_m + side * (house.depth_m + float(rng.uniform(4.5, 8.0)))
    parts += dense_tree(rng, (x, behind, ground - 0.05), table.GARDEN_TREE)
    return parts


def _paved(material: str, x: Span, y: Span, top_m: float) -> Part:
    low, high = sorted(y)
    return box(material, (x[0], low, 0.0), (x[1], high, top_m))


def _furniture(rng: np.random.Generator, edge: Kerbside) -> list[Part]:
    """Build street trees, lamps, hydrants and bins on the verge, away from the crossings."""
    parts: list[Part] = []
    y = edge.kerb_y_m + edge.side * 0.95
    for x in np.arange(STREET_START_M + 5 + float(rng.uniform(0, 6)), STREET_END_M, 11.0).tolist():
        if any(x0 - 1.2 < x < x1 + 1.2 for x0, x1 in edge.lowered):
            continue
        kind = rng.random()
        if kind < 0.5:
            parts += dense_tree(rng, (x, y, edge.top_m - 0.05), table.VERGE_TREE)
        elif kind < 0.75:
            parts += build_post((x, y, edge.top_m), -edge.side, 6.0)
        else:
            low, high = sorted((y - 0.28, y + 0.28))
            parts.append(box("bin", (x, low, edge.top_m), (x + 0.6, high, edge.top_m + 1.05)))
    return parts


def _distance(rng: np.random.Generator) -> list[Part]:
    """Build houses and trees behind the gardens and beyond both ends of the street."""
    parts: list[Part] = []
    x0, x1 = STREET_START_M, STREET_END_M
    for side in (-1.0, 1.0):
        for x in np.arange(x0 - 10.0, x1 + 10.0, 19.0).tolist():
            parts += distant_house(rng, (x + float(rng.uniform(0, 5)), side * 56.0))
            place = (x + float(rng.uniform(-4, 4)), side * float(rng.uniform(42, 48)), 0.0)
            parts += dense_tree(rng, place, table.FAR_TREE)
    for x in (x0 - 30.0, x1 + 32.0):
        for y in np.arange(-34.0, 35.0, 17.0).tolist():
            parts += distant_house(rng, (x, y))
            place = (x + (14.0 if x < 0 else -14.0), y + 8.5, -0.05)
            parts += dense_tree(rng, place, table.FAR_TREE)
    return parts


def build_suburb_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool
) -> tuple[Participant, ...]:
    """Draw cars in drives and at the kerb, moving cars and pedestrians."""
    rng = plan.stream(4)
    lots = draw_lots(plan)
    people: list[Participant] = []
    for lot in lots:
        if rng.random() < 0.6:
            edge = kerbside(lot.house.side)
            middle = (lot.garage[0] + lot.garage[1]) / 2
            y = (edge.outer_y_m + lot.house.front_m) / 2
            heading = float(rng.choice([-1.0, 1.0])) * np.pi / 2 + float(rng.normal(0, 0.02))
            people.append(draw_car(rng, (middle, y, float(heading)), 0.0, edge.top_m))
    for side in (-1, 1):
        drives = [lot.garage for lot in lots if lot.house.side == side]
        people += parked_row(rng, side * table.PARKED_Y_M, side, 0.3, drives)
    lane = table.LANE_Y_M
    people.append(draw_car(rng, (15.0, -lane, 0.0), ego_speed_m_s * 0.92))
    people.append(draw_car(rng, (-14.0, -lane, 0.0), ego_speed_m_s * 1.02))
    if has_fast_traffic:
        people += fast_column(plan.stream(5), lane)
    else:
        people += lane_column(rng, (lane, np.pi), (26.0, 62.0), (7.0, 10.0))
    ground = kerbside(1).top_m
    walk = table.ROAD_HALF_M + 2.5
    people.append(draw_walker(rng, (float(rng.uniform(8, 14)), -walk, 0.0), ground, 1.4))
    people.append(draw_walker(rng, (float(rng.uniform(16, 26)), walk, np.pi), ground, 1.2))
    return tuple(people)


def make_suburb_finishes(plan: StreetPlan) -> dict[str, Finish]:
    """Return all finishes by name."""
    return style_finishes(plan, table.COATINGS, table.ROAD)


# Street of detached houses with gardens.
SUBURBAN = StreetStyle(
    make_suburb_finishes,
    build_suburb,
    build_suburb_participants,
    (
        (-table.PARKED_Y_M, 0.0),
        (table.PARKED_Y_M, np.pi),
        (-table.LANE_Y_M, 0.0),
        (table.LANE_Y_M, np.pi),
    ),
)
