"""The body of a car that ships: a signed distance of few proportions, and its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from tools.shipped_models.level_set import Field, Points, level_set

from lightsim.geometry.actors.body import HATCHBACK, SEDAN, VAN, Proportions, rounded_intersection
from lightsim.geometry.actors.profile_kernels import polygon_distance

_VOXEL_M = 0.055
_ROUNDING_M = 0.09
"""Of the edges between the sides and the top."""
_FILLETS_M = (0.1, 0.12, 0.25, 0.35, 0.6, 2.0, 0.6, 0.25, 0.12, 0.15, 0.1)
"""Of the profile's corners: how much of the edges beside a corner is rounded."""
_CROWN, _BOW = 0.055, 0.045
"""Towards the sides tops sink (over the half width) and ends lie back (over their distance from
the middle)."""
_TAPER, _TUCK = 0.2, 0.07
"""Part of the length over which the plan narrows; by which part sills are narrower than doors."""
SHOULDER_M = 0.02
"""By which the body stands out below the belt line."""
ARCH_M, ARCH_DEPTH_M = 0.05, 0.3
"""Room around a wheel, and towards the middle."""


@dataclass(frozen=True)
class Design:
    """One car.

    Args:
        proportions: those that logs' vehicles are fitted with.
        pillars: between side panes and doors: fractions of the length from the front.
        panes_to: behind this fraction the sides have no panes.
    """

    proportions: Proportions
    length_m: float
    width_m: float
    height_m: float
    pillars: tuple[float, ...]
    panes_to: float = 1.0


DESIGNS = {
    "sedan": Design(
        SEDAN._replace(hood_height=0.46, cowl_height=0.66, cowl=0.27),
        4.62, 1.82, 1.45, (0.51, 0.70),
    ),
    "hatchback": Design(
        HATCHBACK._replace(hood_height=0.47, cowl_height=0.65, roof_front=0.42, tail_height=0.58),
        4.10, 1.77, 1.48, (0.52, 0.74),
    ),
    "suv": Design(
        HATCHBACK._replace(
            hood_height=0.53, cowl_height=0.66, belt_height=0.64, clearance=0.15, roof_width=0.8,
            wheel_radius=0.215, deck=0.95, deck_height=0.64, tail_height=0.6,
        ),
        4.68, 1.90, 1.70, (0.5, 0.72),
    ),
    "van": Design(
        VAN._replace(
            hood_height=0.44, cowl=0.2, cowl_height=0.56, roof_front=0.36, belt_height=0.55,
            wheel_radius=0.175, roof_width=0.86, tail_height=0.5, deck_height=0.55, clearance=0.12,
        ),
        5.20, 1.96, 1.98, (0.42,), 0.44,
    ),
}  # fmt: skip


class CarBody:
    """The body of a design: x ahead, y left, z up from the ground, the origin in the middle of the
    length and the width.

    A side profile with rounded corners, a plan and a cross section; rounded where they meet.
    """

    def __init__(self, design: Design) -> None:
        self.design = design
        self.corners = self._corners()
        self.profile = filleted(self.corners, _FILLETS_M)

    def distance_m(self, points: Points) -> Field:
        """Signed distance, negative inside; approximate away from the surface."""
        x, y, z = points.T
        across = np.abs(y) - self.half_width_m(x, z)
        return rounded_intersection(self.side_m(points), across, _ROUNDING_M)

    def side_m(self, points: Points) -> Field:
        """Signed distance to the side profile, which bows towards the sides."""
        x, y, z = points.T
        across = np.square(np.clip(2 * y / self.design.width_m, -1.2, 1.2))
        rise = z + _CROWN * across * np.clip(2 * z / self.design.height_m - 0.6, 0, 1)
        return polygon_distance(x * (1 + _BOW * across), rise, self.profile)

    def half_width_m(self, x: Field, z: Field) -> Field:
        """Narrower in plan towards the ends, leaning in above the belt line."""
        design, p = self.design, self.design.proportions
        u, v = 0.5 - x / design.length_m, z / design.height_m
        ahead = np.clip(1 - (u - p.front) / _TAPER, 0, 1) ** 2.5
        behind = np.clip(1 - (p.rear - u) / _TAPER, 0, 1) ** 2.5
        plan = 1 - (1 - p.front_width) * ahead - (1 - p.rear_width) * behind
        rise = np.clip((v - p.belt_height) / (p.roof_height - p.belt_height), 0, 1.2)
        drop = np.clip((0.45 * p.belt_height - v) / (0.45 * p.belt_height), 0, 1)
        section = 1 - (1 - p.roof_width) * rise**1.2 - _TUCK * drop**2
        shoulder = SHOULDER_M * np.exp(-np.square((v - p.belt_height + 0.04) / 0.06))
        return 0.5 * design.width_m * p.width * plan * section + shoulder - SHOULDER_M

    def axles(self) -> list[tuple[float, float]]:
        """x, and the wheels' radius, of either axle."""
        p = self.design.proportions
        radius = p.wheel_radius * self.design.height_m
        return [(self.ahead_m(u), radius) for u in (p.front_wheel, p.rear_wheel)]

    def wheel_face_m(self) -> float:
        """From the middle to the outer side of the wheels."""
        design = self.design
        return 0.5 * design.width_m * design.proportions.width - SHOULDER_M - 0.012

    def arch_m(self, points: Points) -> Field:
        """Signed distance to what is cut out around the wheels."""
        x, y, z = points.T
        radial = np.min(
            [np.hypot(x - at, z - radius) - radius - ARCH_M for at, radius in self.axles()], axis=0
        )
        return np.maximum(radial, 0.5 * self.design.width_m - ARCH_DEPTH_M - np.abs(y))

    def ahead_m(self, fraction: float) -> float:
        """x at a fraction of the length from the front."""
        return (0.5 - fraction) * self.design.length_m

    def _corners(self) -> Float64[np.ndarray, "k 2"]:
        """(x, z) from the chin over the roof to the rear end's bottom."""
        p = self.design.proportions
        corners = np.array([
            (p.front + 0.03, p.clearance), (p.front, 0.55 * p.hood_height),
            (p.front + 0.03, p.hood_height), (p.cowl, p.cowl_height),
            (p.roof_front, p.roof_height - 0.03), (0.53, p.roof_height),
            (p.roof_rear, p.roof_height - 0.045), (p.deck, p.deck_height),
            (p.rear - 0.01, p.tail_height), (p.rear, 0.5 * p.tail_height),
            (p.rear - 0.03, p.clearance + 0.02),
        ])  # fmt: skip
        scale = [self.design.length_m, self.design.height_m]
        return (np.array([0.5, 0.0]) + np.array([-1.0, 1.0]) * corners) * scale


def body_surface(body: CarBody) -> tuple[Points, Int64[np.ndarray, "m 3"]]:
    """The surface without arches."""
    design = body.design
    high = np.array([design.length_m / 2, design.width_m / 2, design.height_m]) + 2 * _VOXEL_M
    return level_set(body.distance_m, high * [-1, -1, 0], high, _VOXEL_M)


def filleted(
    corners: Float64[np.ndarray, "k 2"], cuts_m: Sequence[float]
) -> Float64[np.ndarray, "n 2"]:
    """A closed polygon whose corners are quadratic curves."""
    t = np.linspace(0, 1, 9)[:, None]
    curves = []
    for k, corner in enumerate(corners):
        before, after = corners[k - 1] - corner, corners[(k + 1) % len(corners)] - corner
        start, end = (
            corner + edge * min(0.48, cuts_m[k] / np.hypot(*edge)) for edge in (before, after)
        )
        curves.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(curves)
