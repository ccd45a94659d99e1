"""Detached houses: storeys with windows, pitched roofs, porches, bay windows and garages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightsim_lab.synthetic.facades import Corners, Facade, Plane, ring
from lightsim_lab.synthetic.shapes import Part, box
from lightsim_lab.synthetic.styles import suburban_table as table
from lightsim_lab.synthetic.styles.ground import Span
from lightsim_lab.synthetic.styles.roofs import board, gabled, gutter, hipped, slope

# Distance of the front of the garage behind that of the house, in metres.
_GARAGE_BACK_M = 0.6
# Projection of the porch from the front, in metres.
_PORCH_M = 1.5
# Projection of a bay window from the front, in metres.
_BAY_M = 0.75


@dataclass(frozen=True)
class House:
    """Detached house.

    Args:
        side: +1: the house is at positive y and its front faces -y; -1: the reverse.
        front_m: y of the front, frame `street`.
        walls: finishes of the ground floor and of the floors above.
        pitch: rise of the roof over its run.
        roof_form: `gable` (ridge along the street), `front gable` or `hip`.
        has_bay: has a bay window on the ground floor.
    """

    side: int
    x: Span
    front_m: float
    depth_m: float
    storeys: int
    walls: tuple[str, str]
    roof: str
    trim: str
    door: str
    glass: str
    pitch: float
    roof_form: str
    has_bay: bool

    @property
    def bays(self) -> int:
        """Number of window axes of the front."""
        return max(3, int((self.x[1] - self.x[0]) / 2.9))

    @property
    def door_x_m(self) -> float:
        """Return x of the front door: in the second axis from the left."""
        return self._x_of(1)

    @property
    def bay_x_m(self) -> float:
        """Return x of the bay window: in the last axis."""
        return self._x_of(self.bays - 1)

    def covers_bay(self, x_m: float) -> bool:
        """Return whether the bay window occupies the front at x."""
        return self.has_bay and abs(x_m - self.bay_x_m) < 1.8

    @property
    def eaves_m(self) -> float:
        """Height of the walls."""
        return table.STOREYS[self.storeys - 1][3]

    @property
    def area(self) -> Corners:
        """Low x, low y, high x and high y of the walls."""
        low, high = sorted((self.front_m, self.front_m + self.side * self.depth_m))
        return (self.x[0], low, self.x[1], high)

    def _x_of(self, axis: int) -> float:
        along = (axis + 0.5) * (self.x[1] - self.x[0]) / self.bays
        return self.x[0] + along if self.side > 0 else self.x[1] - along


def build_house(house: House, rng: np.random.Generator) -> list[Part]:
    """Build all parts of a house, frame `street`."""
    x0, y0, x1, y1 = house.area
    parts = [box("slab", (x0 - 0.03, y0 - 0.03, -0.02), (x1 + 0.03, y1 + 0.03, 0.42))]
    has_shutters = rng.random() < 0.4
    for number, (plane, width) in enumerate(ring(house.area, house.side)):
        for storey in range(house.storeys):
            parts += _storey(house, (plane, width), number, storey, has_shutters)
        if house.walls[-1] in ("wall0", "wall1", "wall2"):
            parts.append(plane.block(house.trim, (0.0, 0.4, 0.13, house.eaves_m), (0.0, 0.025)))
            edge = (width - 0.13, 0.4, width, house.eaves_m)
            parts.append(plane.block(house.trim, edge, (0.0, 0.025)))
    parts += _roof(house)
    parts += _porch(house)
    if house.has_bay:
        parts += _bay_window(house)
    return parts


def _storey(
    house: House, wall: tuple[Plane, float], number: int, storey: int, has_shutters: bool
) -> list[Part]:
    """Build one storey of one wall; number 0 is the front."""
    plane, width = wall
    levels = table.STOREYS[storey]
    finish = house.walls[min(storey, 1)]
    facade = Facade(plane, width, finish, house.trim, house.glass, table.RECESS_M)
    if number == 0:
        axes = [i for i in range(house.bays) if storey or not _is_taken(house, i)]
        centres = (np.array(axes, dtype=np.float64) + 0.5) * width / house.bays
        half = 0.62
    else:
        centres = np.array([0.3, 0.72] if storey or number == 2 else [0.72]) * width
        half = 0.5
    parts = facade.storey(centres, half, levels)
    # Casings around the windows, and shutters beside those of the front.
    for s in centres.tolist():
        low, high = levels[1], levels[2]
        parts.append(
            plane.block(
                house.trim, (s - half - 0.1, high, s + half + 0.1, high + 0.13), (0.0, 0.05)
            )
        )
        for edge in (s - half - 0.1, s + half):
            parts.append(plane.block(house.trim, (edge, low, edge + 0.1, high), (0.0, 0.03)))
        if has_shutters and number == 0:
            for edge in (s - half - 0.52, s + half + 0.12):
                parts.append(
                    plane.block(
                        house.door, (edge, low - 0.05, edge + 0.4, high + 0.05), (0.0, 0.05)
                    )
                )
    return parts


def _is_taken(house: House, axis: int) -> bool:
    return axis == 1 or (house.has_bay and axis == house.bays - 1)


def _roof(house: House) -> list[Part]:
    """Build the roof with gutters, downpipe and chimney."""
    x0, y0, x1, y1 = house.area
    is_along_x = house.roof_form != "front gable"
    half = (y1 - y0 if is_along_x else x1 - x0) / 2
    ridge = house.eaves_m + house.pitch * half
    levels = (house.eaves_m, ridge)
    if house.roof_form == "hip":
        parts = hipped(house.roof, house.trim, house.area, levels, is_along_x)
    else:
        wall = house.walls[-1]
        parts = gabled(house.roof, wall, house.trim, house.area, levels, is_along_x)
    if house.roof_form == "front gable":
        plane, width = ring(house.area, house.side)[0]
        z = house.eaves_m
        pane = (width / 2 - 0.45, z + 0.5, width / 2 + 0.45, z + 1.6)
        parts.append(
            plane.block(
                house.trim,
                (pane[0] - 0.1, pane[1] - 0.1, pane[2] + 0.1, pane[3] + 0.1),
                (0.0, 0.04),
            )
        )
        parts.append(plane.block(house.glass, pane, (0.0, 0.05)))
    else:
        drop = 0.45 * house.pitch
        y = house.front_m - house.side * 0.5
        z = house.eaves_m - drop
        parts += gutter("zinc", (x0 - 0.1, y, z), (x1 + 0.1, y, z), 0.05)
    x, y = x0 + 0.22 * (x1 - x0), (y0 + y1) / 2 + house.side * 0.8
    parts.append(
        box("wall4", (x - 0.4, y - 0.3, house.eaves_m - 0.5), (x + 0.4, y + 0.3, ridge + 0.9))
    )
    parts.append(box("slab", (x - 0.48, y - 0.38, ridge + 0.9), (x + 0.48, y + 0.38, ridge + 1.0)))
    return parts


def _porch(house: House) -> list[Part]:
    """Build the door, its steps, and a roof on two posts."""
    side, front, x = house.side, house.front_m, house.door_x_m
    plane, _ = ring(house.area, side)[0]
    s = x - house.x[0] if side > 0 else house.x[1] - x
    parts = [
        plane.block(house.trim, (s - 0.62, 0.42, s + 0.62, 2.62), (0.0, 0.05)),
        plane.block(house.door, (s - 0.48, 0.42, s + 0.48, 2.5), (0.0, 0.08)),
        plane.block(house.glass, (s - 0.3, 1.75, s + 0.3, 2.3), (0.0, 0.09)),
        plane.block("steel", (s + 0.36, 1.35, s + 0.42, 1.5), (0.0, 0.14)),
    ]
    out = front - side * _PORCH_M
    for reach, top in ((_PORCH_M, 0.4), (_PORCH_M + 0.35, 0.25)):
        low, high = sorted((front, front - side * reach))
        parts.append(box("slab", (x - 1.3, low, 0.0), (x + 1.3, high, top)))
    for post in (x - 1.2, x + 1.2):
        low, high = sorted((out + side * 0.06, out + side * 0.2))
        parts.append(box(house.trim, (post - 0.07, low, 0.4), (post + 0.07, high, 2.72)))
    eave = ((x - 1.45, out - side * 0.15, 2.7), (x + 1.45, out - side * 0.15, 2.7))
    top = ((x - 1.45, front, 3.25), (x + 1.45, front, 3.25))
    parts += [slope(house.roof, eave, top), board(house.trim, *eave)]
    parts += [board(house.trim, e, t) for e, t in zip(eave, top, strict=True)]
    return parts


def _bay_window(house: House) -> list[Part]:
    """Build a bay window with panes on three sides and a lean-to roof."""
    x, side, front = house.bay_x_m, house.side, house.front_m
    out = front - side * _BAY_M
    low, high = sorted((front, out))
    walls = ring((x - 1.15, low, x + 1.15, high), side)
    parts = []
    for number in (0, 1, 3):
        plane, width = walls[number]
        facade = Facade(plane, width, house.walls[0], house.trim, house.glass, 0.06)
        half = 0.95 if number == 0 else 0.25
        parts += facade.storey(np.array([width / 2]), half, (0.0, 0.95, 2.4, 2.7))
    eave = ((x - 1.3, out - side * 0.15, 2.66), (x + 1.3, out - side * 0.15, 2.66))
    top = ((x - 1.3, front, 3.05), (x + 1.3, front, 3.05))
    parts += [slope(house.roof, eave, top), board(house.trim, *eave)]
    return [*parts, *(board(house.trim, e, t) for e, t in zip(eave, top, strict=True))]


def build_garage(house: House, drive: Span) -> list[Part]:
    """Build a garage at the end of a drive, with a sectional door."""
    side = house.side
    front = house.front_m + side * _GARAGE_BACK_M
    low, high = sorted((front, front + side * 6.2))
    area = (drive[0] - 0.25, low, drive[1] + 0.25, high)
    parts = []
    for plane, width in ring(area, side):
        parts.append(plane.patch(house.walls[0], np.array([[0.0, 0.0, width, 2.75]]), 0.0))
    plane, width = ring(area, side)[0]
    door = (0.35, 0.0, width - 0.35, 2.3)
    parts.append(plane.block(house.trim, (door[0] - 0.12, 0.0, door[2] + 0.12, 2.42), (0.0, 0.04)))
    for row in range(4):
        z = 0.12 + 0.545 * row
        # Sections are 2 cm apart, and each has a row of raised panels.
        parts.append(plane.block("garage", (door[0], z, door[2], z + 0.525), (0.0, 0.07)))
        edges = np.linspace(door[0] + 0.08, door[2] + 0.02, 1 + round((door[2] - door[0]) / 0.6))
        for s0, s1 in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            panel = (s0, z + 0.1, s1 - 0.1, z + 0.43)
            parts.append(plane.block("garage", panel, (0.07, 0.085)))
    ridge = 2.75 + 0.5 * (area[2] - area[0]) / 2
    parts += gabled(house.roof, house.walls[0], house.trim, area, (2.75, ridge), False)
    low, high = sorted((house.front_m, front))
    parts.append(box("drive", (drive[0], low, 0.0), (drive[1], high, table.KERB_HEIGHT_M - 0.005)))
    return parts


def distant_house(rng: np.random.Generator, middle_m: Span) -> list[Part]:
    """Build a house with few triangles: walls, hipped roof and panes on its four sides."""
    x, y = middle_m
    half = np.array([float(rng.uniform(4.5, 6.5)), float(rng.uniform(4.0, 5.0))])
    area = (x - half[0], y - half[1], x + half[0], y + half[1])
    eaves = table.STOREYS[int(rng.integers(2))][3]
    wall, roof = f"wall{int(rng.integers(table.WALLS))}", f"roof{int(rng.integers(table.ROOFS))}"
    parts: list[Part] = []
    for plane, width in ring(area, 1):
        parts.append(plane.patch(wall, np.array([[0.0, -0.05, width, eaves]]), 0.0))
        for z in np.arange(1.2, eaves - 1.2, 2.8).tolist():
            starts = np.arange(1.2, width - 1.5, 2.6)
            one = np.ones(len(starts))
            rects = np.stack([starts, z * one, starts + 1.1, (z + 1.35) * one], axis=1)
            grown = rects + np.array([-0.12, -0.12, 0.12, 0.12])
            parts += [plane.patch("trim0", grown, 0.02), plane.patch("glass0", rects, 0.04)]
    return parts + hipped(roof, "trim0", area, (eaves, eaves + 0.75 * float(half.min())), True)
