"""Facades of five to eight floors with strong relief: cornices, balconies, awnings, mansards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.facades import Corners, Facade, Plane, ring
from lightsim_lab.synthetic.shapes import Part, box, quads, rectangle, tube
from lightsim_lab.synthetic.styles import boulevard_table as table
from lightsim_lab.synthetic.styles.fences import fence
from lightsim_lab.synthetic.styles.roofs import slope

Axes = Float[np.ndarray, " n"]


@dataclass(frozen=True)
class TallBuilding:
    """Building of a terrace.

    Args:
        kind: `stone` (mansard roof, balconies), `brick` (fire escape) or `tile` (wide panes).
        side: +1: the front faces -y; -1: the reverse.
    """

    kind: str
    side: int
    x: tuple[float, float]
    front_m: float
    floors: int
    wall: str
    trim: str
    glass: str
    roof: str
    seed: int

    @property
    def area(self) -> Corners:
        """Low x, low y, high x and high y of the walls."""
        low, high = sorted((self.front_m, self.front_m + self.side * table.DEPTH_M))
        return (self.x[0], low, self.x[1], high)

    @property
    def height_m(self) -> float:
        """Height of the walls below the main cornice."""
        return table.GROUND_FLOOR_M + table.FLOOR_M * (self.floors - 1) + 0.5


def build_tall(building: TallBuilding) -> list[Part]:
    """Build all parts of a building, frame `street`."""
    rng = np.random.default_rng(building.seed)
    walls = ring(building.area, building.side)
    height = building.height_m
    parts: list[Part] = []
    for plane, width in walls[1:]:
        parts.append(plane.patch(building.wall, np.array([[0.0, 0.0, width, height]]), 0.0))
    plane, width = walls[0]
    pitch = 3.6 if building.kind == "tile" else 2.9
    axes = (np.arange(round(width / pitch)) + 0.5) * width / round(width / pitch)
    parts += _ground_floor(building, plane, width, axes, rng)
    parts += _floors(building, plane, width, axes)
    parts += _cornices(building, plane, width)
    if building.kind == "stone":
        parts += _balconies(building, plane, width, axes) + _mansard(building, axes)
    else:
        parts += _flat_roof(building)
    if building.kind == "brick":
        parts += _fire_escape(building, plane, float(axes[len(axes) // 2]))
    pipe = (building.x[0] + 0.3, building.front_m - building.side * 0.1)
    parts.append(tube("zinc", (*pipe, 0.1), (*pipe, height), (0.06, 0.06), 8))
    return parts


def _ground_floor(
    building: TallBuilding, plane: Plane, width: float, axes: Axes, rng: np.random.Generator
) -> list[Part]:
    """Build shops with pilasters, sign boards, awnings and signs across the sidewalk."""
    half = 0.4 * width / len(axes)
    facade = Facade(plane, width, building.wall, "shop", building.glass, 0.42)
    parts = facade.storey(axes, half, (0.0, 0.55, 3.3, table.GROUND_FLOOR_M))
    edges = np.concatenate([[0.35], (axes[:-1] + axes[1:]) / 2, [width - 0.35]])
    for s in edges.tolist():
        # Pilasters with base and capital.
        parts.append(plane.block(building.trim, (s - 0.24, 0.0, s + 0.24, 3.75), (0.0, 0.14)))
        parts.append(plane.block(building.trim, (s - 0.32, 0.0, s + 0.32, 0.5), (0.0, 0.2)))
        parts.append(plane.block(building.trim, (s - 0.32, 3.55, s + 0.32, 3.75), (0.0, 0.24)))
    parts.append(plane.block("shop", (0.1, 3.75, width - 0.1, 4.25), (0.0, 0.2)))
    door = int(rng.integers(len(axes)))
    for number, s in enumerate(axes.tolist()):
        if number == door:
            parts.append(plane.block("shop", (s - 0.55, 0.0, s + 0.55, 2.5), (-0.42, -0.3)))
        if rng.random() < 0.4:
            parts += _awning(
                plane, (s - half - 0.1, s + half + 0.1), int(rng.integers(table.AWNINGS))
            )
        if rng.random() < 0.3:
            sign, at = f"sign{int(rng.integers(table.SIGNS))}", s + half + 0.25
            parts.append(plane.block(sign, (at - 0.05, 4.35, at + 0.05, 5.35), (0.25, 0.95)))
            parts.append(plane.block("iron", (at - 0.02, 4.8, at + 0.02, 4.84), (0.0, 0.25)))
    sign = f"sign{int(rng.integers(table.SIGNS))}"
    middle = float(axes[door])
    parts.append(plane.block(sign, (middle - 1.1, 3.82, middle + 1.1, 4.18), (0.2, 0.26)))
    return parts


def _awning(plane: Plane, span: tuple[float, float], number: int) -> list[Part]:
    """Build a sloping cloth with a valance, on two arms."""
    s0, s1 = span
    cloth = np.array(
        [
            [[s0, 2.75, 1.35], [s1, 2.75, 1.35], [s1, 3.5, 0.14], [s0, 3.5, 0.14]],
            [[s0, 2.5, 1.35], [s1, 2.5, 1.35], [s1, 2.75, 1.35], [s0, 2.75, 1.35]],
        ]
    )
    parts = [quads(f"awning{number}", plane.place(cloth), cloth[..., :2])]
    for s in (s0 + 0.05, s1 - 0.05):
        arm = plane.place(np.array([[s, 2.9, 0.1], [s, 2.74, 1.34]]))
        parts.append(tube("iron", arm[0].tolist(), arm[1].tolist(), (0.02, 0.02), 6))
    return parts


def _floors(building: TallBuilding, plane: Plane, width: float, axes: Axes) -> list[Part]:
    """Build the upper floors with casings and hoods, and the wall up to the cornice."""
    share = {"stone": 0.2, "brick": 0.2, "tile": 0.4}[building.kind]
    half = share * width / len(axes)
    recess = table.RECESS_M[building.kind]
    facade = Facade(plane, width, building.wall, building.trim, building.glass, recess)
    sill, head = (0.45, 2.75) if building.kind == "stone" else (0.95, 2.7)
    parts: list[Part] = []
    for floor in range(1, building.floors):
        z = table.GROUND_FLOOR_M + table.FLOOR_M * (floor - 1)
        parts += facade.storey(axes, half, (z, z + sill, z + head, z + table.FLOOR_M))
        if building.kind == "tile":
            continue
        for s in axes.tolist():
            low, high = z + sill, z + head
            for edge in (s - half - 0.16, s + half):
                parts.append(
                    plane.block(building.trim, (edge, low, edge + 0.16, high), (0.0, 0.07))
                )
            hood = (s - half - 0.3, high + 0.12, s + half + 0.3, high + 0.28)
            lintel = (s - half - 0.16, high, s + half + 0.16, high + 0.12)
            parts.append(plane.block(building.trim, lintel, (0.0, 0.07)))
            parts.append(plane.block(building.trim, hood, (0.0, 0.24 if floor < 3 else 0.12)))
    top = table.GROUND_FLOOR_M + table.FLOOR_M * (building.floors - 1)
    parts.append(plane.patch(building.wall, np.array([[0.0, top, width, building.height_m]]), 0.0))
    return parts


def _cornices(building: TallBuilding, plane: Plane, width: float) -> list[Part]:
    """Build the bands above the ground floor and the third floor, and the main cornice."""
    parts = []
    low = table.GROUND_FLOOR_M
    levels = [(low - 0.35, 0.22), (low - 0.15, 0.38)]
    if building.kind != "tile":
        levels += [(low + 2 * table.FLOOR_M - 0.2, 0.2)]
    for z, out in levels:
        parts.append(plane.block(building.trim, (0.0, z, width, z + 0.2), (0.0, out)))
    top = building.height_m
    steps = [(0.5, 0.15), (0.3, 0.38), (0.12, 0.62)] if building.kind != "tile" else [(0.25, 0.12)]
    for below, out in steps:
        parts.append(
            plane.block(building.trim, (0.0, top - below, width, top - below + 0.2), (0.0, out))
        )
    if building.kind == "stone":
        for s in np.arange(0.3, width - 0.2, 0.7).tolist():
            # Dentils below the main cornice.
            parts.append(
                plane.block(building.trim, (s, top - 0.52, s + 0.28, top - 0.3), (0.0, 0.34))
            )
    return parts


def _balconies(building: TallBuilding, plane: Plane, width: float, axes: Axes) -> list[Part]:
    """Build continuous balconies on the second and the last floor, single ones between."""
    parts: list[Part] = []
    half = 0.2 * width / len(axes) + 0.35
    for floor in range(1, building.floors):
        z = table.GROUND_FLOOR_M + table.FLOOR_M * (floor - 1)
        if floor in (1, building.floors - 1):
            spans = [(0.4, width - 0.4)]
        else:
            spans = [(s - half, s + half) for s in axes.tolist()[floor % 2 :: 2]]
        for s0, s1 in spans:
            parts.append(plane.block(building.trim, (s0, z + 0.02, s1, z + 0.18), (0.0, 0.85)))
            for s in np.arange(s0 + 0.2, s1 - 0.1, 1.45).tolist():
                parts.append(
                    plane.block(building.trim, (s, z - 0.3, s + 0.14, z + 0.02), (0.0, 0.5))
                )
            ends = plane.place(np.array([[s0 + 0.05, z + 0.18, 0.78], [s1 - 0.05, z + 0.18, 0.78]]))
            parts += fence(ends[0].tolist(), ends[1].tolist(), table.RAILING)
    return parts


def _mansard(building: TallBuilding, axes: Axes) -> list[Part]:
    """Build a steep roof storey with dormers, its flat top and chimneys."""
    x0, y0, x1, y1 = building.area
    z0, z1, inset = building.height_m + 0.1, building.height_m + 3.3, 1.1
    front, side = building.front_m, building.side
    back = front + side * table.DEPTH_M
    parts = []
    for y, step in ((front, side), (back, -side)):
        eave, top = (
            ((x0, y, z0), (x1, y, z0)),
            ((x0, y + step * inset, z1), (x1, y + step * inset, z1)),
        )
        parts.append(slope(building.roof, eave, top, 0.3))
    low, high = y0 + inset, y1 - inset
    parts.append(rectangle("zinc", (x0, low, z1), (x1 - x0, 0, 0), (0, high - low, 0)))
    for x in (x0, x1):
        wall = np.array([[[x, y0, z0 - 0.1], [x, y1, z0 - 0.1], [x, high, z1], [x, low, z1]]])
        parts.append(quads(building.wall, wall, wall[..., 1:]))
        parts.append(box("wall3", (x - 0.35, low + 2.0, z0), (x + 0.35, low + 4.2, z1 + 1.6)))
    plane, _ = ring(building.area, side)[0]
    for s in axes.tolist():
        parts.append(plane.block(building.trim, (s - 0.75, z0, s + 0.75, z0 + 2.2), (-1.0, -0.12)))
        parts.append(
            plane.block(building.glass, (s - 0.5, z0 + 0.45, s + 0.5, z0 + 1.95), (-0.2, -0.1))
        )
        parts.append(plane.block("zinc", (s - 0.9, z0 + 2.2, s + 0.9, z0 + 2.35), (-1.1, 0.05)))
    return parts


def _flat_roof(building: TallBuilding) -> list[Part]:
    """Build a roof behind a parapet, with a lift house and ducts."""
    x0, y0, x1, y1 = building.area
    z = building.height_m
    middle = (x0 + x1) / 2
    return [
        rectangle("zinc", (x0, y0, z - 0.3), (x1 - x0, 0, 0), (0, y1 - y0, 0)),
        box(building.wall, (middle - 2.0, y0 + 4.0, z - 0.3), (middle + 2.0, y0 + 9.0, z + 2.6)),
        box("zinc", (middle + 3.0, y0 + 4.0, z - 0.3), (middle + 4.2, y0 + 8.0, z + 0.9)),
    ]


def _fire_escape(building: TallBuilding, plane: Plane, middle: float) -> list[Part]:
    """Build iron platforms at the upper floors, with railings and stairs between them."""
    parts: list[Part] = []
    s0, s1 = middle - 2.2, middle + 2.2
    for floor in range(1, building.floors):
        z = table.GROUND_FLOOR_M + table.FLOOR_M * (floor - 1) + 0.5
        for d in np.arange(0.05, 1.15, 0.18).tolist():
            # Gratings are strips with gaps, so that they let some light through.
            parts.append(plane.block("iron", (s0, z, s1, z + 0.04), (d, d + 0.1)))
        for s in (s0 + 0.1, s1 - 0.1):
            bracket = plane.place(np.array([[s, z - 0.7, 0.0], [s, z, 1.05]]))
            parts.append(tube("iron", bracket[0].tolist(), bracket[1].tolist(), (0.03, 0.03), 6))
        ends = plane.place(np.array([[s0, z + 0.04, 1.12], [s1, z + 0.04, 1.12]]))
        parts += fence(ends[0].tolist(), ends[1].tolist(), table.RAILING)
        if floor + 1 < building.floors:
            parts += _stairs(
                plane, (s0 + 0.4, s1 - 0.8), (z + 0.04, z + table.FLOOR_M), floor % 2 == 0
            )
    return parts


def _stairs(
    plane: Plane, along: tuple[float, float], levels: tuple[float, float], is_mirrored: bool
) -> list[Part]:
    """Build a flight of stairs: two stringers and treads."""
    start, end = along[::-1] if is_mirrored else along
    parts = []
    for d in (0.35, 0.95):
        stringer = plane.place(np.array([[start, levels[0], d], [end, levels[1], d]]))
        parts.append(tube("iron", stringer[0].tolist(), stringer[1].tolist(), (0.05, 0.05), 4))
    for fraction in np.linspace(0.08, 0.95, 11).tolist():
        s = start + fraction * (end - start)
        t = levels[0] + fraction * (levels[1] - levels[0])
        parts.append(plane.block("iron", (s - 0.1, t, s + 0.1, t + 0.03), (0.35, 0.95)))
    return parts


def distant_block(rng: np.random.Generator, area: Corners, height_m: float) -> list[Part]:
    """Build a building with few triangles, for the ends of the street."""
    wall = f"wall{int(rng.integers(5))}"
    parts: list[Part] = []
    for plane, width in ring(area, 1):
        parts.append(plane.patch(wall, np.array([[0.0, -0.05, width, height_m]]), 0.0))
        for z in np.arange(1.3, height_m - 2.2, table.FLOOR_M).tolist():
            starts = np.arange(1.0, width - 1.6, 2.9)
            one = np.ones(len(starts))
            rects = np.stack([starts, z * one, starts + 1.3, (z + 1.9) * one], axis=1)
            grown = rects + np.array([-0.15, -0.15, 0.15, 0.15])
            parts += [plane.patch("trim1", grown, 0.02), plane.patch("glass0", rects, 0.05)]
    x0, y0, x1, y1 = area
    parts.append(rectangle("zinc", (x0, y0, height_m), (x1 - x0, 0, 0), (0, y1 - y0, 0)))
    return parts
