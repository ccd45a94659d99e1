"""Vertical planes, and facades with recessed windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.shapes import Part, box, quads

# Low x, low y, high x and high y of a rectangle, in metres.
Corners = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Plane:
    """Vertical plane with coordinates s (along it), t (upwards) and d (outwards), in metres."""

    origin: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    outward: Float[np.ndarray, "3"]

    def place(self, std: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Convert points (s, t, d) to frame `street`."""
        basis = np.stack([self.along, np.array([0.0, 0.0, 1.0]), self.outward])
        return self.origin + std @ basis

    def patch(self, material: str, rects: Float[np.ndarray, "n 4"], depth_m: float) -> Part:
        """Build rectangles (s0, t0, s1, t1) at a distance in front of the plane."""
        s0, t0, s1, t1 = rects.T
        s, t = np.stack([s0, s1, s1, s0], axis=1), np.stack([t0, t0, t1, t1], axis=1)
        corners = self.place(np.stack([s, t, np.full_like(s, depth_m)], axis=-1))
        # Offsets the texture by position, so that neighbouring buildings do not repeat it.
        shift = float(self.origin @ np.array([0.31, 0.17, 0.0]))
        return quads(material, corners, np.stack([s + shift, t], axis=-1))

    def block(
        self, material: str, rect: tuple[float, float, float, float], depth_m: tuple[float, float]
    ) -> Part:
        """Build a cuboid over (s0, t0, s1, t1) between two distances from the plane."""
        s0, t0, s1, t1 = rect
        shape = box(material, (s0, t0, depth_m[0]), (s1, t1, depth_m[1]))
        placed = self.place(shape.vertices.astype(np.float64)).astype(np.float32)
        return Part(material, placed, shape.faces, shape.uv_m)


def ring(area: Corners, side: int) -> list[tuple[Plane, float]]:
    """Return the four walls of a rectangle with their widths: front, right, back and left."""
    x0, y0, x1, y1 = area
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    ways = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    widths = [x1 - x0, y1 - y0, x1 - x0, y1 - y0]
    walls = []
    for (x, y), (u, v), width in zip(corners, ways, widths, strict=True):
        along, outward = np.array([u, v, 0.0]), np.array([v, -u, 0.0])
        walls.append((Plane(np.array([x, y, 0.0]), along, outward), width))
    return walls if side > 0 else walls[2:] + walls[:2]


@dataclass(frozen=True, eq=False)
class Facade:
    """Wall of a building, with the names of its finishes.

    Args:
        recess_m: depth of the panes behind the wall; the city's 0.18 m is chosen by eye.
    """

    plane: Plane
    width_m: float
    wall: str
    trim: str
    glass: str
    recess_m: float = 0.18

    def storey(
        self,
        centres: Float[np.ndarray, " n"],
        half_m: float | Float[np.ndarray, " n"],
        levels_m: tuple[float, float, float, float],
    ) -> list[Part]:
        """Build one floor: wall around the windows, reveals, panes, frames and sills.

        Args:
            centres: window axes along the plane.
            half_m: half width of a window; one, or one per window.
            levels_m: heights of floor, sill, lintel and next floor.
        """
        z0, sill, head, z1 = levels_m
        s0, s1 = centres - half_m, centres + half_m
        # Piers are the full-height parts of the wall between the windows.
        edges = np.concatenate([[0.0], np.stack([s0, s1], axis=1).ravel(), [self.width_m]])
        piers = np.stack([edges[::2], edges[1::2]], axis=1)
        full = np.ones(len(piers))
        wall = [np.stack([piers[:, 0], full * z0, piers[:, 1], full * z1], axis=1)]
        one = np.ones(len(centres))
        wall.append(np.stack([s0, one * z0, s1, one * sill], axis=1))
        wall.append(np.stack([s0, one * head, s1, one * z1], axis=1))
        panes = np.stack([s0, one * sill, s1, one * head], axis=1)
        parts = [self.plane.patch(self.wall, np.concatenate(wall), 0.0)]
        parts.append(self.plane.patch(self.glass, panes, -self.recess_m))
        for left, right in zip(s0.tolist(), s1.tolist(), strict=True):
            parts += self._reveal((left, sill, right, head))
        return parts

    def _reveal(self, pane: tuple[float, float, float, float]) -> list[Part]:
        """Build the four sides of a window's recess, its frame, mullion and sill."""
        s0, t0, s1, t1 = pane
        r = -self.recess_m
        corners = np.array(
            [
                [[s0, t0, r], [s0, t0, 0], [s0, t1, 0], [s0, t1, r]],
                [[s1, t0, 0], [s1, t0, r], [s1, t1, r], [s1, t1, 0]],
                [[s0, t0, 0], [s0, t0, r], [s1, t0, r], [s1, t0, 0]],
                [[s0, t1, r], [s0, t1, 0], [s1, t1, 0], [s1, t1, r]],
            ]
        )
        parts = [
            quads(self.trim, self.plane.place(corners), corners[..., [0, 1]] + corners[..., [2, 2]])
        ]
        # Frame and mullion are 5 cm wide and 2 cm in front of the pane.
        middle, w = (s0 + s1) / 2, 0.05
        bars = [
            [s0, t0, s0 + w, t1],
            [s1 - w, t0, s1, t1],
            [s0, t1 - w, s1, t1],
            [s0, t0, s1, t0 + w],
            [middle - w / 2, t0, middle + w / 2, t1],
        ]
        parts.append(self.plane.patch(self.trim, np.array(bars), r + 0.02))
        parts.append(self.plane.block(self.trim, (s0 - 0.08, t0 - 0.1, s1 + 0.08, t0), (r, 0.1)))
        return parts
