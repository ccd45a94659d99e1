"""Facades with recessed windows, doors, sills and cornices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.shapes import Part, box, merge_parts, quads, rectangle

# Depth of windows behind the facade, in metres; chosen by eye, as are the two heights below.
_RECESS_M = 0.18
# Height of the ground floor, in metres; it may have shops.
_GROUND_FLOOR_M = 3.8
# Height of each upper floor, in metres.
_FLOOR_M = 3.1


@dataclass(frozen=True)
class Building:
    """Dimensions and materials of a box-shaped building.

    Args:
        start_m: smaller x of the building, frame `street`.
        side: +1: the building is at positive y and its front faces -y; -1: the reverse.
        front_m: distance of the front from the centre line of the street.
        wall, trim, glass: names of finishes.
        bay_m: approximate distance of window axes.
    """

    start_m: float
    width_m: float
    depth_m: float
    floors: int
    side: int
    front_m: float
    wall: str
    trim: str
    glass: str
    bay_m: float
    seed: int

    @property
    def height_m(self) -> float:
        """Height of the upper edge of the front, above the cornice."""
        return _GROUND_FLOOR_M + _FLOOR_M * (self.floors - 1) + 0.6


@dataclass(frozen=True, eq=False)
class _Plane:
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


def build_house(house: Building) -> tuple[Part, ...]:
    """Build all parts of a building, frame `street`."""
    # Each building has its own random stream: a change of one does not change the others.
    rng = np.random.default_rng(house.seed)
    x0, x1 = house.start_m, house.start_m + house.width_m
    front, back = house.side * house.front_m, house.side * (house.front_m + house.depth_m)
    # The left end of the front for a viewer on the street.
    left = np.array([x0 if house.side > 0 else x1, front, 0.0])
    along = np.array([float(house.side), 0.0, 0.0])
    plane = _Plane(left, along, np.array([0.0, -float(house.side), 0.0]))
    parts = _front(house, plane, rng)
    height = house.height_m
    up = (0.0, 0.0, height)
    deep = back - front
    parts.append(rectangle(house.wall, (x0, front, 0), (0, deep, 0), up, (x0, 0.0)))
    parts.append(rectangle(house.wall, (x1, front, 0), (0, deep, 0), up, (x1, 0.0)))
    parts.append(rectangle(house.wall, (x0, back, 0), (house.width_m, 0, 0), up))
    roof_z = height - 0.45
    parts.append(rectangle("roof", (x0, front, roof_z), (house.width_m, 0, 0), (0, deep, 0)))
    return merge_parts(parts)


def _front(house: Building, plane: _Plane, rng: np.random.Generator) -> list[Part]:
    width = house.width_m
    bays = max(1, int((width - 0.8) / house.bay_m))
    bay = width / bays
    centres = (np.arange(bays) + 0.5) * bay
    # Dimensions relative to the bay, so that windows fit buildings of any width.
    parts: list[Part] = []
    window_half = float(rng.uniform(0.21, 0.29)) * bay
    has_shop = rng.random() < 0.6
    shop_half = 0.42 * bay if has_shop else window_half
    low = 0.45 if has_shop else 0.95
    parts += _storey(house, plane, centres, shop_half, (0.0, low, 2.9, _GROUND_FLOOR_M))
    for floor in range(1, house.floors):
        z = _GROUND_FLOOR_M + _FLOOR_M * (floor - 1)
        parts += _storey(house, plane, centres, window_half, (z, z + 0.9, z + 2.5, z + _FLOOR_M))
        parts += _balconies(plane, centres, window_half, z, rng)
    top = _GROUND_FLOOR_M + _FLOOR_M * (house.floors - 1)
    parts.append(plane.patch(house.wall, np.array([[0.0, top, width, house.height_m]]), 0.0))
    parts.append(plane.block(house.trim, (0.0, top - 0.05, width, top + 0.22), (0.0, 0.35)))
    band = (0.0, _GROUND_FLOOR_M - 0.3, width, _GROUND_FLOOR_M - 0.05)
    parts.append(plane.block(house.trim, band, (0.0, 0.12)))
    parts += _door(house, plane, rng, bay)
    return parts


def _storey(
    house: Building,
    plane: _Plane,
    centres: Float[np.ndarray, " n"],
    half_m: float,
    levels_m: tuple[float, float, float, float],
) -> list[Part]:
    """Build one floor: wall around the windows, reveals, panes, frames and sills.

    Args:
        centres: window axes along the plane.
        half_m: half width of a window.
        levels_m: heights of floor, sill, lintel and next floor.
    """
    z0, sill, head, z1 = levels_m
    s0, s1 = centres - half_m, centres + half_m
    # Piers are the full-height parts of the wall between the windows.
    edges = np.concatenate([[0.0], np.stack([s0, s1], axis=1).ravel(), [house.width_m]])
    piers = np.stack([edges[::2], edges[1::2]], axis=1)
    full = np.ones(len(piers))
    wall = [np.stack([piers[:, 0], full * z0, piers[:, 1], full * z1], axis=1)]
    one = np.ones(len(centres))
    wall.append(np.stack([s0, one * z0, s1, one * sill], axis=1))
    wall.append(np.stack([s0, one * head, s1, one * z1], axis=1))
    panes = np.stack([s0, one * sill, s1, one * head], axis=1)
    parts = [plane.patch(house.wall, np.concatenate(wall), 0.0)]
    parts.append(plane.patch(house.glass, panes, -_RECESS_M))
    for left, right in zip(s0.tolist(), s1.tolist(), strict=True):
        parts += _reveal(house.trim, plane, (left, sill, right, head))
    return parts


def _reveal(trim: str, plane: _Plane, pane: tuple[float, float, float, float]) -> list[Part]:
    """Build the four sides of a window's recess, its frame, mullion and sill."""
    s0, t0, s1, t1 = pane
    r = -_RECESS_M
    corners = np.array(
        [
            [[s0, t0, r], [s0, t0, 0], [s0, t1, 0], [s0, t1, r]],
            [[s1, t0, 0], [s1, t0, r], [s1, t1, r], [s1, t1, 0]],
            [[s0, t0, 0], [s0, t0, r], [s1, t0, r], [s1, t0, 0]],
            [[s0, t1, r], [s0, t1, 0], [s1, t1, 0], [s1, t1, r]],
        ]
    )
    parts = [quads(trim, plane.place(corners), corners[..., [0, 1]] + corners[..., [2, 2]])]
    # Frame and mullion are 5 cm wide and 2 cm in front of the pane.
    middle, w = (s0 + s1) / 2, 0.05
    bars = [
        [s0, t0, s0 + w, t1],
        [s1 - w, t0, s1, t1],
        [s0, t1 - w, s1, t1],
        [s0, t0, s1, t0 + w],
        [middle - w / 2, t0, middle + w / 2, t1],
    ]
    parts.append(plane.patch(trim, np.array(bars), r + 0.02))
    parts.append(plane.block(trim, (s0 - 0.08, t0 - 0.1, s1 + 0.08, t0), (r, 0.1)))
    return parts


def _balconies(
    plane: _Plane,
    centres: Float[np.ndarray, " n"],
    half_m: float,
    floor_z_m: float,
    rng: np.random.Generator,
) -> list[Part]:
    parts = []
    for centre in centres.tolist():
        if rng.random() > 0.12:
            continue
        s0, s1 = centre - half_m - 0.3, centre + half_m + 0.3
        parts.append(plane.block("slab", (s0, floor_z_m, s1, floor_z_m + 0.15), (0.0, 1.0)))
        parts.append(
            plane.block("steel", (s0, floor_z_m + 1.05, s1, floor_z_m + 1.12), (0.93, 1.0))
        )
        for s in np.linspace(s0, s1 - 0.04, 9).tolist():
            bar = (s, floor_z_m + 0.15, s + 0.04, floor_z_m + 1.05)
            parts.append(plane.block("steel", bar, (0.94, 0.98)))
    return parts


def _door(house: Building, plane: _Plane, rng: np.random.Generator, bay_m: float) -> list[Part]:
    """Build a door with a canopy, in front of the pier between two bays."""
    s = float(rng.integers(1, max(2, int(house.width_m / bay_m)))) * bay_m
    if s + 0.6 > house.width_m:
        s = house.width_m - 0.7
    return [
        plane.block("door", (s - 0.5, 0.0, s + 0.5, 2.25), (0.0, 0.06)),
        plane.block(house.trim, (s - 0.75, 2.4, s + 0.75, 2.52), (0.0, 0.8)),
    ]
