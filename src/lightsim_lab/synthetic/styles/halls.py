"""Industrial halls: ribbed sheet walls, roller doors, loading docks and saw-tooth roofs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.facades import Corners, Facade, Plane, ring
from lightsim_lab.synthetic.shapes import Part, box, quads, rectangle, tube
from lightsim_lab.synthetic.styles import industrial_table as table
from lightsim_lab.synthetic.styles.ground import Span

# Height of the concrete plinth of walls without a dock, in metres.
_PLINTH_M = 0.9
# Depth of roller doors behind the wall, in metres.
_RECESS_M = 0.25


@dataclass(frozen=True)
class Hall:
    """Hall parallel to the street.

    Args:
        side: +1: the front faces -y; -1: the reverse.
        has_dock: the doors open onto a loading dock.
        has_teeth: saw-tooth roof instead of a flat one.
        doors: x of the middles of the roller doors.
    """

    side: int
    x: Span
    front_m: float
    height_m: float
    wall: str
    shutter: str
    has_dock: bool
    has_teeth: bool
    doors: tuple[float, ...]

    @property
    def area(self) -> Corners:
        """Low x, low y, high x and high y of the walls."""
        low, high = sorted((self.front_m, self.front_m + self.side * table.HALL_DEPTH_M))
        return (self.x[0], low, self.x[1], high)

    @property
    def dock_edge_m(self) -> float:
        """Return y of the edge of the dock, or of the front."""
        return self.front_m - self.side * (table.DOCK_M[1] if self.has_dock else 0.0)


def ribbed(
    material: str,
    plane: Plane,
    rect: Corners,
    depth_m: float,
    ribs_m: Span,
    *,
    is_upright: bool = True,
) -> Part:
    """Build trapezoidal sheet over (s0, t0, s1, t1); ribs stand out from `depth_m`.

    Args:
        ribs_m: pitch and depth of the ribs.
        is_upright: ribs run upwards; otherwise along the wall.
    """
    s0, t0, s1, t1 = rect
    low, high = (s0, s1) if is_upright else (t0, t1)
    pitch, rise = ribs_m
    count = max(1, round((high - low) / pitch))
    at = np.linspace(low, high, 4 * count + 1)
    # Each rib: up, crest, down, valley.
    out = depth_m + rise * np.array([0.0, 1.0, 1.0, 0.0])[np.arange(len(at)) % 4]
    corners = np.zeros((len(at) - 1, 4, 3))
    across, along = (0, 1) if is_upright else (1, 0)
    corners[:, [0, 3], across], corners[:, [1, 2], across] = at[:-1, None], at[1:, None]
    corners[:, [0, 3], 2], corners[:, [1, 2], 2] = out[:-1, None], out[1:, None]
    corners[:, :2, along], corners[:, 2:, along] = (t0, t1) if is_upright else (s0, s1)
    shift = float(plane.origin @ np.array([0.31, 0.17, 0.0]))
    return quads(material, plane.place(corners), corners[..., :2] + np.array([shift, 0.0]))


def build_hall(hall: Hall) -> list[Part]:
    """Build all parts of a hall, frame `street`."""
    walls = ring(hall.area, hall.side)
    parts = _front(hall, *walls[0])
    for plane, width in walls[1:]:
        rect = (0.0, _PLINTH_M, width, hall.height_m)
        parts.append(ribbed(hall.wall, plane, rect, 0.0, table.WALL_RIBS_M))
        parts.append(plane.block("plinth", (0.0, -0.02, width, _PLINTH_M), (-0.2, 0.07)))
        parts.append(
            plane.block("trim0", (0.0, hall.height_m - 0.25, width, hall.height_m), (0.0, 0.08))
        )
    parts += _teeth(hall) if hall.has_teeth else _flat_roof(hall)
    return parts + (_dock(hall) if hall.has_dock else [])


def _front(hall: Hall, plane: Plane, width: float) -> list[Part]:
    """Build the wall towards the street with doors, windows, pipes and edge trims."""
    wide, high = table.DOOR_M
    floor = table.DOCK_M[0] if hall.has_dock else 0.0
    centres = sorted(_along(hall, x) for x in hall.doors)
    edges = [0.0, *(s for c in centres for s in (c - wide / 2, c + wide / 2)), width]
    lintel = floor + high
    parts = []
    for s0, s1 in zip(edges[::2], edges[1::2], strict=True):
        parts.append(ribbed(hall.wall, plane, (s0, _PLINTH_M, s1, lintel), 0.0, table.WALL_RIBS_M))
        parts.append(plane.block("plinth", (s0, -0.02, s1, _PLINTH_M), (-0.2, 0.07)))
    top = (0.0, lintel, width, hall.height_m)
    parts.append(ribbed(hall.wall, plane, top, 0.0, table.WALL_RIBS_M))
    for centre in centres:
        parts += _roller_door(
            hall.shutter, plane, (centre - wide / 2, floor, centre + wide / 2, lintel)
        )
    low = max(lintel + 0.7, hall.height_m - 2.4)
    if hall.height_m - low > 1.6:
        for s in np.arange(1.5, width - 3.5, 3.2).tolist():
            parts.append(
                plane.block("trim0", (s - 0.08, low - 0.08, s + 2.48, low + 1.28), (0.0, 0.09))
            )
            for k in range(3):
                pane = (s + 0.82 * k, low, s + 0.82 * k + 0.76, low + 1.2)
                parts.append(plane.block("glass0", pane, (0.0, 0.1)))
    parts.append(
        plane.block("trim0", (0.0, hall.height_m - 0.25, width, hall.height_m), (0.0, 0.12))
    )
    for s in (0.0, width - 0.18):
        parts.append(plane.block("trim0", (s, _PLINTH_M, s + 0.18, hall.height_m), (0.0, 0.1)))
    return parts + _pipes(hall, plane, width, lintel)


def _roller_door(material: str, plane: Plane, rect: Corners) -> list[Part]:
    """Build a door of horizontal slats, its reveals, and a painted frame."""
    s0, t0, s1, t1 = rect
    parts = [ribbed(material, plane, rect, -_RECESS_M, table.DOOR_RIBS_M, is_upright=False)]
    r = -_RECESS_M
    corners = np.array(
        [
            [[s0, t0, r], [s0, t0, 0.07], [s0, t1, 0.07], [s0, t1, r]],
            [[s1, t0, 0.07], [s1, t0, r], [s1, t1, r], [s1, t1, 0.07]],
            [[s0, t1, r], [s0, t1, 0.07], [s1, t1, 0.07], [s1, t1, r]],
        ]
    )
    parts.append(quads("trim0", plane.place(corners), corners[..., :2]))
    for s in (s0 - 0.16, s1):
        parts.append(plane.block("frame", (s, t0, s + 0.16, t1), (0.0, 0.1)))
    parts.append(plane.block("frame", (s0 - 0.16, t1, s1 + 0.16, t1 + 0.22), (0.0, 0.14)))
    return parts


def _pipes(hall: Hall, plane: Plane, width: float, lintel: float) -> list[Part]:
    """Build downpipes and two lines of pipes on brackets above the doors."""
    parts: list[Part] = []
    for s in (0.6, width / 2, width - 0.6):
        if min(abs(s - _along(hall, x)) for x in hall.doors) > table.DOOR_M[0] / 2 + 0.3:
            ends = plane.place(np.array([[s, 0.0, 0.14], [s, hall.height_m - 0.2, 0.14]]))
            parts.append(tube("zinc", ends[0].tolist(), ends[1].tolist(), (0.07, 0.07), 8))
    for number, material in enumerate(("pipe", "pipe1")):
        t, d = lintel + 0.45 + 0.22 * number, 0.3
        ends = plane.place(np.array([[0.3, t, d], [width - 0.3, t, d]]))
        parts.append(tube(material, ends[0].tolist(), ends[1].tolist(), (0.09, 0.09), 10))
    for s in np.arange(0.8, width, 3.4).tolist():
        parts.append(plane.block("iron", (s, lintel + 0.3, s + 0.06, lintel + 0.8), (0.0, 0.42)))
    return parts


def _along(hall: Hall, x: float) -> float:
    return x - hall.x[0] if hall.side > 0 else hall.x[1] - x


def _teeth(hall: Hall) -> list[Part]:
    """Build a saw-tooth roof: sloping sheets, upright panes, and gables at front and back."""
    x0, y0, x1, y1 = hall.area
    z, rise = hall.height_m, table.TOOTH_M[1]
    count = max(2, round((x1 - x0) / table.TOOTH_M[0]))
    edges = np.linspace(x0, x1, count + 1)
    parts = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        sheet = np.array([[[a, y0, z], [b, y0, z + rise], [b, y1, z + rise], [a, y1, z]]])
        parts.append(quads("roof", sheet, sheet[..., :2]))
        for y in (y0, y1):
            gable = np.array([[[a, y, z], [b, y, z], [b, y, z + rise], [b, y, z + rise]]])
            parts.append(quads(hall.wall, gable, gable[..., [0, 2]]))
            parts.append(tube("trim0", (a, y, z), (b, y, z + rise), (0.09, 0.09), 4))
        parts.append(box("trim0", (b - 0.06, y0, z), (b, y1, z + 0.3)))
        for y in np.arange(y0 + 0.2, y1 - 1.4, 1.6).tolist():
            parts.append(
                box("glass0", (b - 0.04, y, z + 0.3), (b + 0.02, y + 1.5, z + rise - 0.12))
            )
        parts.append(box("trim0", (b - 0.06, y0, z + rise - 0.12), (b + 0.05, y1, z + rise + 0.04)))
    return parts


def _flat_roof(hall: Hall) -> list[Part]:
    """Build a roof behind a low parapet, with rooflights, vents and a duct."""
    x0, y0, x1, y1 = hall.area
    z = hall.height_m - 0.2
    parts = [rectangle("roof", (x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0))]
    for x in np.arange(x0 + 4, x1 - 4, 6.0).tolist():
        parts.append(box("glass0", (x, y0 + 6, z), (x + 1.4, y1 - 6, z + 0.7)))
        place = (x + 3.2, (y0 + y1) / 2)
        parts.append(tube("zinc", (*place, z), (*place, z + 1.1), (0.4, 0.4), 12))
        parts.append(tube("zinc", (*place, z + 1.1), (*place, z + 1.5), (0.6, 0.1), 12))
    return parts


def _dock(hall: Hall) -> list[Part]:
    """Build the loading dock with buffers, stairs, and a canopy on posts."""
    x0, x1 = hall.x
    height = table.DOCK_M[0]
    edge, side = hall.dock_edge_m, hall.side
    low, high = sorted((hall.front_m, edge))
    parts = [box("plinth", (x0 + 1.0, low, -0.02), (x1 - 1.0, high, height))]
    for x in hall.doors:
        for at in (x - 1.1, x + 0.9):
            y0, y1 = sorted((edge, edge - side * 0.12))
            parts.append(box("rubber", (at, y0, height - 0.55), (at + 0.2, y1, height - 0.05)))
    for step in range(5):
        # Stairs at the right end of the dock.
        z = height * (5 - step) / 6
        parts.append(
            box(
                "plinth", (x1 - 1.0 + 0.3 * step, low, -0.02), (x1 - 0.7 + 0.3 * step, low + 1.2, z)
            )
        )
    y = edge - side * 0.4
    low, high = sorted((hall.front_m, y))
    parts.append(box("roof", (x0 + 0.5, low, height + 4.75), (x1 - 0.5, high, height + 4.95)))
    for x in np.linspace(x0 + 1.5, x1 - 1.5, 5).tolist():
        if min(abs(x - door) for door in hall.doors) > 1.6:
            at = (x, edge + side * 0.3)
            parts.append(tube("iron", (*at, height), (*at, height + 4.75), (0.09, 0.09), 8))
    return parts


def build_office(side: int, x: Span, front_m: float) -> list[Part]:
    """Build a two-storey office block in front of a hall."""
    low, high = sorted((front_m, front_m + side * 8.0))
    area = (x[0], low, x[1], high)
    parts: list[Part] = []
    for number, (plane, width) in enumerate(ring(area, side)):
        finish = "brick" if number % 2 else "office"
        facade = Facade(plane, width, finish, "trim0", "glass0", 0.16)
        bays = max(2, round(width / 2.4))
        centres: Float[np.ndarray, " n"] = (np.arange(bays) + 0.5) * width / bays
        for z in (0.0, 3.3):
            parts += facade.storey(centres, 0.38 * width / bays, (z, z + 1.0, z + 2.6, z + 3.3))
        parts.append(plane.block("trim0", (0.0, 6.5, width, 6.85), (-0.1, 0.1)))
    plane, width = ring(area, side)[0]
    parts.append(plane.block("glass0", (width / 2 - 0.9, 0.0, width / 2 + 0.9, 2.4), (0.0, 0.06)))
    parts.append(plane.block("trim0", (width / 2 - 1.4, 2.5, width / 2 + 1.4, 2.68), (0.0, 1.4)))
    parts.append(rectangle("roof", (x[0], low, 6.5), (x[1] - x[0], 0, 0), (0, high - low, 0)))
    return parts
