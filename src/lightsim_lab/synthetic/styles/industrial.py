"""The style `industrial`: halls, loading docks, yards with containers, fences and lorries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim_lab.synthetic.finishes import PAINT_COUNT
from lightsim_lab.synthetic.greenery import build_post, build_sign
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part, merge_parts
from lightsim_lab.synthetic.styles import industrial_table as table
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M, StreetStyle
from lightsim_lab.synthetic.styles.coatings import style_finishes
from lightsim_lab.synthetic.styles.fences import fence, mesh_fence
from lightsim_lab.synthetic.styles.ground import Kerbside, Span, carriageway, flat, surroundings
from lightsim_lab.synthetic.styles.halls import Hall, build_hall, build_office
from lightsim_lab.synthetic.styles.traffic import (
    draw_car,
    draw_walker,
    fast_column,
    lane_column,
    placed,
)
from lightsim_lab.synthetic.styles.vegetation import dense_tree
from lightsim_lab.synthetic.styles.vehicles import Built, build_lorry, build_semi, build_trailer
from lightsim_lab.synthetic.styles.yard import chimney, containers, drums, pallets, tank
from lightsim_lab.synthetic.textures import Finish


@dataclass(frozen=True)
class Plot:
    """Fenced plot with a hall and a gate.

    Args:
        gate: range of x of the gate; the way from it to the hall is free.
        places: x of the middles and contents of the places in the yard along the fence.
        lorries: x of the lorries at the loading dock.
        fence: `bars` or `mesh`.
    """

    span: Span
    hall: Hall
    gate: Span
    places: tuple[tuple[float, str], ...]
    lorries: tuple[float, ...]
    fence: str
    seed: int


def draw_plots(plan: StreetPlan) -> list[Plot]:
    """Draw the plots of both sides; background and actors share them."""
    rng = plan.stream(2)
    plots = []
    for side in (-1, 1):
        x = STREET_START_M
        while x + table.PLOT_M[0] <= STREET_END_M:
            width = min(float(rng.uniform(*table.PLOT_M)), STREET_END_M - x)
            if STREET_END_M - x - width < table.PLOT_M[0]:
                width = min(STREET_END_M - x, 1.5 * table.PLOT_M[1])
            plots.append(_draw_plot(rng, side, (x, x + width)))
            x += width
    return plots


def _draw_plot(rng: np.random.Generator, side: int, span: Span) -> Plot:
    has_dock = bool(rng.random() < 0.5)
    depth = table.DOCK_YARD_M if has_dock else float(rng.uniform(*table.YARD_M))
    hall_x = (span[0] + 2.0, span[1] - float(rng.uniform(2.0, 5.0)))
    width = hall_x[1] - hall_x[0]
    doors = hall_x[0] + width * (np.arange(3) + 0.5 + rng.uniform(-0.12, 0.12, 3)) / 3
    gate_middle = float(doors[int(rng.integers(3))])
    gate = (gate_middle - table.GATE_M / 2, gate_middle + table.GATE_M / 2)
    hall = Hall(
        side=side,
        x=hall_x,
        front_m=kerbside(side).outer_y_m + side * depth,
        height_m=float(rng.uniform(*table.HALL_HEIGHT_M)),
        wall=f"wall{int(rng.integers(table.WALLS))}",
        shutter=str(rng.choice(["shutter", "shutter1"])),
        has_dock=has_dock,
        has_teeth=bool(rng.random() < 0.5),
        doors=tuple(doors.tolist()),
    )
    lorries = tuple(x for x in doors.tolist() if has_dock and rng.random() < 0.65)
    kinds = ["containers", "containers", "pallets", "drums", "tank", "car", "car", "empty"]
    places = []
    for x in np.arange(span[0] + 4.2, span[1] - 3.8, table.PLACE_M).tolist():
        is_free = not gate[0] - 3.6 < x < gate[1] + 3.6
        is_free &= all(abs(x - lorry) > 5.2 for lorry in lorries)
        if is_free:
            places.append((x, str(rng.choice(kinds))))
    border = str(rng.choice(["bars", "mesh"]))
    return Plot(span, hall, gate, tuple(places), lorries, border, int(rng.integers(2**31)))


def kerbside(side: int, plots: list[Plot] | None = None) -> Kerbside:
    """Return kerb and sidewalk of a side, lowered at the gates of the plots."""
    lowered = [plot.gate for plot in plots or [] if plot.hall.side == side]
    height = table.KERB_HEIGHT_M
    return Kerbside(side, side * table.ROAD_HALF_M, table.STRIPS, height, lowered)


def build_estate(plan: StreetPlan) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material."""
    plots = draw_plots(plan)
    rng = plan.stream(3)
    parts = [carriageway((-table.ROAD_HALF_M, table.ROAD_HALF_M)), *surroundings()]
    for side in (-1, 1):
        edge = kerbside(side, plots)
        parts += edge.build()
        street = (STREET_START_M, STREET_END_M)
        parts.append(flat("yard", street, (edge.outer_y_m, side * 80.0), edge.top_m))
        parts += _furniture(rng, edge)
    for plot in plots:
        parts += build_hall(plot.hall)
        parts += _fences(plot)
        parts += _yard(plot, np.random.default_rng(plot.seed))
    parts += _distance(rng)
    return merge_parts(parts)


def _fences(plot: Plot) -> list[Part]:
    """Build the fence along the sidewalk with an open sliding gate, and that to the neighbour."""
    side, edge = plot.hall.side, kerbside(plot.hall.side)
    y, z = edge.outer_y_m + side * table.FENCE_M, edge.top_m
    parts: list[Part] = []
    for x0, x1 in ((plot.span[0], plot.gate[0]), (plot.gate[1], plot.span[1])):
        if x1 - x0 > 0.5:
            parts += _fence(plot.fence, (x0, y, z), (x1, y, z))
    # The gate leaf stands behind the fence; its side is the one with more room.
    room = plot.gate[0] - plot.span[0] > plot.span[1] - plot.gate[1]
    x0 = max(plot.span[0], plot.gate[0] - table.GATE_M) if room else plot.gate[1]
    x1 = plot.gate[0] if room else min(plot.span[1], plot.gate[1] + table.GATE_M)
    inside = y + side * 0.25
    parts += fence((x0, inside, z), (x1, inside, z), table.BARS)
    low, high = sorted((y + side * 0.1, plot.hall.dock_edge_m - side * 0.3))
    return parts + _fence("mesh", (plot.span[0], low, z), (plot.span[0], high, z))


def _fence(kind: str, start: tuple[float, ...], end: tuple[float, ...]) -> list[Part]:
    if kind == "bars":
        return fence(start, end, table.BARS)
    return mesh_fence(start, end, table.MESH_HEIGHT_M, table.MESH_M)


def _yard(plot: Plot, rng: np.random.Generator) -> list[Part]:
    """Build the contents of the places, an office, and a chimney behind the hall."""
    hall, edge = plot.hall, kerbside(plot.hall.side)
    side, z = hall.side, edge.top_m
    y = edge.outer_y_m + side * 3.2
    parts: list[Part] = []
    build = {"containers": containers, "pallets": pallets, "drums": drums, "tank": tank}
    for x, kind in plot.places:
        if kind in build:
            parts += build[kind](rng, (x, y, z))
    if not hall.has_dock and plot.span[1] - plot.gate[1] > 16.0:
        parts += build_office(side, (hall.x[1] - 9.0, hall.x[1]), hall.front_m - side * 4.0)
    if rng.random() < 0.35:
        at = ((hall.x[0] + hall.x[1]) / 2, hall.front_m + side * (table.HALL_DEPTH_M + 6.0))
        parts += chimney(rng, (*at, z - 0.1))
    return parts


def _furniture(rng: np.random.Generator, edge: Kerbside) -> list[Part]:
    """Build lamps, signs and a few poplars along the sidewalk, away from the gates."""
    parts: list[Part] = []
    z = edge.top_m
    y = edge.kerb_y_m + edge.side * 0.55
    start = STREET_START_M + float(rng.uniform(4, 14))
    for number, x in enumerate(np.arange(start, STREET_END_M - 3, 14.0).tolist()):
        if any(x0 - 1.5 < x < x1 + 1.5 for x0, x1 in edge.lowered):
            continue
        if number % 2 == 0:
            parts += build_post((x, y, z), -edge.side, 8.0)
        elif rng.random() < 0.35:
            parts += dense_tree(rng, (x, y + edge.side * 0.5, z - 0.05), table.POPLAR)
        elif rng.random() < 0.5:
            parts += build_sign((x, y, z), f"sign{int(rng.integers(3))}")
    return parts


def _distance(rng: np.random.Generator) -> list[Part]:
    """Build halls across both ends of the street, and trees beside them."""
    parts: list[Part] = []
    for x in (STREET_START_M - 60.0, STREET_END_M + 25.0):
        for side in (-1, 1):
            hall = Hall(
                side=side,
                x=(x, x + 34.0),
                front_m=side * 3.0,
                height_m=float(rng.uniform(8.0, 11.0)),
                wall=f"wall{int(rng.integers(table.WALLS))}",
                shutter="shutter",
                has_dock=False,
                has_teeth=side > 0,
                doors=(x + 17.0,),
            )
            parts += build_hall(hall)
            for y in (38.0, 47.0, 58.0):
                place = (x + float(rng.uniform(8, 26)), side * y, -0.05)
                parts += dense_tree(rng, place, table.POPLAR)
    return parts


def build_estate_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool
) -> tuple[Participant, ...]:
    """Draw lorries at docks and kerbs, cars in yards, moving lorries and cars, and workers."""
    rng = plan.stream(4)
    plots = draw_plots(plan)
    people: list[Participant] = []
    for plot in plots:
        people += _in_yard(rng, plot)
    for side in (-1, 1):
        people += _parked(rng, kerbside(side, plots))
    lane = table.LANE_Y_M
    lorry = _draw_lorry(rng, 6.2)
    truck = ActorKind.TRUCK
    people.append(placed(rng, truck, lorry, (21.0, -lane, 0.0), ego_speed_m_s * 0.92))
    people.append(draw_car(rng, (-14.0, -lane, 0.0), ego_speed_m_s * 1.02))
    if has_fast_traffic:
        people += fast_column(plan.stream(5), lane)
    else:
        people += _oncoming(rng)
    ground = kerbside(1).top_m
    for side, heading in ((-1, 0.0), (1, np.pi)):
        y = side * (table.ROAD_HALF_M + 1.35)
        place = (float(rng.uniform(8, 26)), y, float(heading))
        people.append(draw_walker(rng, place, ground, 1.3))
    return tuple(people)


def _draw_lorry(rng: np.random.Generator, load_m: float) -> Built:
    paint = f"paint{int(rng.integers(PAINT_COUNT))}"
    return build_lorry(paint, f"box{int(rng.integers(table.LORRIES))}", load_m)


def _draw_semi(rng: np.random.Generator) -> Built:
    paint = f"paint{int(rng.integers(PAINT_COUNT))}"
    return build_semi(paint, f"box{int(rng.integers(table.LORRIES))}")


def _in_yard(rng: np.random.Generator, plot: Plot) -> list[Participant]:
    """Draw the lorries at the dock, backed up to it, and the cars on their places."""
    side, edge = plot.hall.side, kerbside(plot.hall.side)
    towards_street = -side * np.pi / 2
    found: list[Participant] = []
    for x in plot.lorries:
        lorry = _draw_lorry(rng, 5.6)
        y = plot.hall.dock_edge_m - side * (lorry[1][0] / 2 + 0.25)
        place = (x, y, float(towards_street))
        found.append(placed(rng, ActorKind.TRUCK, lorry, place, 0.0, edge.top_m))
    for x, kind in plot.places:
        if kind == "car":
            heading = float(rng.choice([-1.0, 1.0]) * np.pi / 2)
            place = (x, edge.outer_y_m + side * 3.6, heading)
            found.append(draw_car(rng, place, 0.0, edge.top_m))
    return found


def _parked(rng: np.random.Generator, edge: Kerbside) -> list[Participant]:
    """Draw lorries, semi-trailers and cars at the kerb, between the gates."""
    found: list[Participant] = []
    heading = 0.0 if edge.side < 0 else float(np.pi)
    y = edge.side * table.PARKED_Y_M
    x = STREET_START_M + 3.0
    while x < STREET_END_M - 18.0:
        kind = str(rng.choice(["car", "lorry", "semi", "trailer", "none", "none"]))
        length = {"car": 5.3, "lorry": 9.0, "semi": 16.0, "trailer": 8.6}.get(kind, 9.0)
        middle = x + length / 2
        x += length + float(rng.uniform(1.5, 4.0))
        if kind == "none" or any(
            x0 - 2.0 - length / 2 < middle < x1 + 2.0 + length / 2 for x0, x1 in edge.lowered
        ):
            continue
        place = (middle, y, heading)
        if kind == "car":
            found.append(draw_car(rng, place, 0.0))
        elif kind == "trailer":
            built = build_trailer(f"box{int(rng.integers(table.LORRIES))}", 6.6)
            found.append(placed(rng, ActorKind.TRAILER, built, place))
        else:
            built = _draw_semi(rng) if kind == "semi" else _draw_lorry(rng, 6.2)
            found.append(placed(rng, ActorKind.TRUCK, built, place))
    return found


def _oncoming(rng: np.random.Generator) -> list[Participant]:
    """Draw a semi-trailer, a lorry with a trailer and a car in the other lane, at one speed."""
    y, heading, speed = table.LANE_Y_M, float(np.pi), float(rng.uniform(8.0, 11.0))
    x = float(rng.uniform(26.0, 32.0))
    lorry, trailer = _draw_lorry(rng, 7.2), build_trailer("box0", 6.6)
    found = [placed(rng, ActorKind.TRUCK, _draw_semi(rng), (x, y, heading), speed)]
    x += 32.0
    found.append(placed(rng, ActorKind.TRUCK, lorry, (x, y, heading), speed))
    # The trailer's drawbar ends 10 cm behind the lorry.
    x += (lorry[1][0] + trailer[1][0]) / 2 + 0.1
    found.append(placed(rng, ActorKind.TRAILER, trailer, (x, y, heading), speed))
    return found + lane_column(rng, (y, heading), (x + 30.0,), (speed, speed))


def make_estate_finishes(plan: StreetPlan) -> dict[str, Finish]:
    """Return all finishes by name."""
    return style_finishes(plan, table.COATINGS, table.ROAD)


# Street of halls, fences and lorries.
INDUSTRIAL = StreetStyle(
    make_estate_finishes,
    build_estate,
    build_estate_participants,
    (
        (-table.PARKED_Y_M, 0.0),
        (table.PARKED_Y_M, np.pi),
        (-table.LANE_Y_M, 0.0),
        (table.LANE_Y_M, np.pi),
    ),
)
