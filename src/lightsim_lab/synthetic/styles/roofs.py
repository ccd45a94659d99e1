"""Pitched roofs with courses of tiles, boards along their edges, gutters and downpipes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lightsim_lab.synthetic.facades import Corners
from lightsim_lab.synthetic.shapes import Part, quads, tube

# Thickness of the lower edge of a course above the one below it, in metres.
_LAP_M = 0.035
# Height of the boards along the edges of a roof, in metres.
_BOARD_M = 0.2

Point = Sequence[float | int]


def slope(
    material: str, eave: tuple[Point, Point], top: tuple[Point, Point], course_m: float = 0.34
) -> Part:
    """Build one slope of a roof from overlapping courses, which face up.

    Args:
        eave: ends of the lower edge.
        top: ends of the upper edge, in the same order; equal ends make a triangle.
        course_m: length of a course along the slope.
    """
    a, b, c, d = (np.asarray(p, dtype=np.float64) for p in (*eave, *top))
    normal = np.cross(b - a, (c + d) / 2 - a)
    if normal[2] < 0:
        a, b, c, d, normal = b, a, d, c, -normal
    normal /= np.linalg.norm(normal)
    count = max(1, round(float(np.linalg.norm((c + d - a - b) / 2)) / course_m))
    f0 = (np.arange(count) / count)[:, None]
    f1 = f0 + 1 / count
    lift = _LAP_M * normal
    low_a, low_b = a + f0 * (c - a), b + f0 * (d - b)
    high_a, high_b = a + f1 * (c - a), b + f1 * (d - b)
    face = np.stack([low_a + lift, low_b + lift, high_b, high_a], axis=1)
    riser = np.stack([low_a, low_b, low_b + lift, low_a + lift], axis=1)
    soffit = np.stack([a, c, d, b])[None] - 0.01 * normal
    along = (b - a) / np.linalg.norm(b - a)
    corners = np.concatenate([face, riser, soffit])
    up = np.cross(normal, along)
    return quads(material, corners, np.stack([corners @ along, corners @ up], axis=-1))


def board(material: str, a: Point, b: Point, height_m: float = _BOARD_M) -> Part:
    """Build an upright board that hangs from the line between two points."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    drop = np.array([0.0, 0.0, height_m])
    length = float(np.linalg.norm(q - p))
    uv = np.array([[[0, 0], [length, 0], [length, height_m], [0, height_m]]])
    return quads(material, np.stack([p - drop, q - drop, q, p])[None], uv)


def gutter(material: str, a: Point, b: Point, ground_m: float) -> list[Part]:
    """Build a gutter between two points, and a downpipe at the first."""
    x, y, z = (float(v) for v in a)
    return [
        tube(material, a, b, (0.065, 0.065), 8),
        tube(material, (x, y, ground_m), (x, y, z), (0.045, 0.045), 8),
    ]


def gabled(
    tiles: str, wall: str, trim: str, area: Corners, levels_m: tuple[float, float], is_along_x: bool
) -> list[Part]:
    """Build a gabled roof with its two gable walls and boards.

    Args:
        area: low x, low y, high x and high y of the walls below.
        levels_m: heights of eaves and ridge.
        is_along_x: direction of the ridge.
    """
    place, (p0, q0, p1, q1) = _frame(area, is_along_x)
    eaves, ridge = levels_m
    middle, over = (q0 + q1) / 2, 0.45
    drop = over * (ridge - eaves) / (middle - q0)
    r0, r1 = place(p0 - over, middle, ridge), place(p1 + over, middle, ridge)
    parts = []
    for q, out in ((q0, -over), (q1, over)):
        e0, e1 = place(p0 - over, q + out, eaves - drop), place(p1 + over, q + out, eaves - drop)
        parts += [slope(tiles, (e0, e1), (r0, r1)), board(trim, e0, e1)]
        parts += [board(trim, e0, r0), board(trim, e1, r1)]
    for p in (p0, p1):
        gable = np.array([[place(p, q0, eaves), place(p, q1, eaves), place(p, middle, ridge)]])
        corners = gable[:, [0, 1, 2, 2]]
        along = corners[..., 0] + corners[..., 1]
        parts.append(quads(wall, corners, np.stack([along, corners[..., 2]], axis=-1)))
    return parts


def hipped(
    tiles: str, trim: str, area: Corners, levels_m: tuple[float, float], is_along_x: bool
) -> list[Part]:
    """Build a hipped roof; the arguments are those of `gabled`."""
    place, (p0, q0, p1, q1) = _frame(area, is_along_x)
    eaves, ridge = levels_m
    half, over = (q1 - q0) / 2, 0.4
    low = eaves - over * (ridge - eaves) / half
    inset = min(half, (p1 - p0) / 2 - 0.05)
    middle = (q0 + q1) / 2
    r0, r1 = place(p0 + inset, middle, ridge), place(p1 - inset, middle, ridge)
    a, b = place(p0 - over, q0 - over, low), place(p1 + over, q0 - over, low)
    c, d = place(p1 + over, q1 + over, low), place(p0 - over, q1 + over, low)
    parts = []
    for eave, top in (
        ((a, b), (r0, r1)),
        ((b, c), (r1, r1)),
        ((c, d), (r1, r0)),
        ((d, a), (r0, r0)),
    ):
        parts += [slope(tiles, eave, top), board(trim, *eave)]
    return parts


def _frame(
    area: Corners, is_along_x: bool
) -> tuple[Callable[[float, float, float], tuple[float, float, float]], Corners]:
    """Return the map from (along the ridge, across, up) to the street, and the area in it."""
    x0, y0, x1, y1 = area

    def place(p: float, q: float, z: float) -> tuple[float, float, float]:
        return (p, q, z) if is_along_x else (q, p, z)

    return place, (x0, y0, x1, y1) if is_along_x else (y0, x0, y1, x1)
