"""Facades with recessed windows, doors, sills and cornices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.facades import Facade, Plane
from lightsim_lab.synthetic.shapes import Part, merge_parts, rectangle

# Height of the ground floor, in metres; it may have shops. Chosen by eye, as is the next.
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


def build_house(house: Building) -> tuple[Part, ...]:
    """Build all parts of a building, frame `street`."""
    # Each building has its own random stream: a change of one does not change the others.
    rng = np.random.default_rng(house.seed)
    x0, x1 = house.start_m, house.start_m + house.width_m
    front, back = house.side * house.front_m, house.side * (house.front_m + house.depth_m)
    # The left end of the front for a viewer on the street.
    left = np.array([x0 if house.side > 0 else x1, front, 0.0])
    along = np.array([float(house.side), 0.0, 0.0])
    plane = Plane(left, along, np.array([0.0, -float(house.side), 0.0]))
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


def _front(house: Building, plane: Plane, rng: np.random.Generator) -> list[Part]:
    width = house.width_m
    facade = Facade(plane, width, house.wall, house.trim, house.glass)
    bays = max(1, int((width - 0.8) / house.bay_m))
    bay = width / bays
    centres = (np.arange(bays) + 0.5) * bay
    # Dimensions relative to the bay, so that windows fit buildings of any width.
    parts: list[Part] = []
    window_half = float(rng.uniform(0.21, 0.29)) * bay
    has_shop = rng.random() < 0.6
    shop_half = 0.42 * bay if has_shop else window_half
    low = 0.45 if has_shop else 0.95
    parts += facade.storey(centres, shop_half, (0.0, low, 2.9, _GROUND_FLOOR_M))
    for floor in range(1, house.floors):
        z = _GROUND_FLOOR_M + _FLOOR_M * (floor - 1)
        parts += facade.storey(centres, window_half, (z, z + 0.9, z + 2.5, z + _FLOOR_M))
        parts += _balconies(plane, centres, window_half, z, rng)
    top = _GROUND_FLOOR_M + _FLOOR_M * (house.floors - 1)
    parts.append(plane.patch(house.wall, np.array([[0.0, top, width, house.height_m]]), 0.0))
    parts.append(plane.block(house.trim, (0.0, top - 0.05, width, top + 0.22), (0.0, 0.35)))
    band = (0.0, _GROUND_FLOOR_M - 0.3, width, _GROUND_FLOOR_M - 0.05)
    parts.append(plane.block(house.trim, band, (0.0, 0.12)))
    parts += _door(house, plane, rng, bay)
    return parts


def _balconies(
    plane: Plane,
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


def _door(house: Building, plane: Plane, rng: np.random.Generator, bay_m: float) -> list[Part]:
    """Build a door with a canopy, in front of the pier between two bays."""
    s = float(rng.integers(1, max(2, int(house.width_m / bay_m)))) * bay_m
    if s + 0.6 > house.width_m:
        s = house.width_m - 0.7
    return [
        plane.block("door", (s - 0.5, 0.0, s + 0.5, 2.25), (0.0, 0.06)),
        plane.block(house.trim, (s - 0.75, 2.4, s + 0.75, 2.52), (0.0, 0.8)),
    ]
