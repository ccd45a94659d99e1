"""Parametric vehicle body: a side profile, a plan and a cross section with twenty proportions.

The profile follows hood, windshield, roof, rear window and tail. The body narrows in plan towards
its ends, and above the belt line towards the roof. Rounded edges, four wheels and symmetry are
common to all vehicles and are not parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.geometry.actors.profile_kernels import polygon_distance

# Shape that all bodies have in common. Typical of passenger cars, chosen by hand; the sensitivity
# to each value is not measured.

# Fraction of the length over which the plan narrows, at either end.
_TAPER_FRACTION = 0.18
# Setback of the ends above and below the bumpers, as a fraction of the length.
_NOSE = 0.02
# Width of a tyre.
_WHEEL_WIDTH_M = 0.22
# Width of the painted frame around a pane.
_PILLAR_M = 0.08


class Proportions(NamedTuple):
    """Proportions of a body relative to its box; the defaults are those of a saloon car.

    Lengths are measured from the front and divided by the box's length, heights from the ground and
    divided by its height, widths divided by its width.
    """

    front: float = 0.005
    rear: float = 0.995
    hood_height: float = 0.47
    cowl: float = 0.26
    cowl_height: float = 0.64
    roof_front: float = 0.42
    roof_rear: float = 0.70
    deck: float = 0.86
    deck_height: float = 0.68
    tail_height: float = 0.64
    belt_height: float = 0.62
    roof_height: float = 0.985
    clearance: float = 0.14
    width: float = 0.98
    roof_width: float = 0.76
    front_width: float = 0.85
    rear_width: float = 0.88
    front_wheel: float = 0.195
    rear_wheel: float = 0.79
    wheel_radius: float = 0.22


# Typical proportions of each type, chosen by hand. `fit` estimates those of each vehicle from
# measurements, with these as the mean of the prior.

# Passenger car with a trunk.
SEDAN = Proportions()
# Passenger car whose rear window ends at the tail.
HATCHBACK = SEDAN._replace(
    cowl=0.24, roof_front=0.40, roof_rear=0.88, deck=0.965, deck_height=0.62, tail_height=0.55
)
# Minivan or delivery van with a short hood.
VAN = HATCHBACK._replace(
    cowl=0.14, cowl_height=0.58, roof_front=0.30, roof_rear=0.94, deck=0.98, roof_width=0.84
)
# Cabin in front, open cargo bed behind.
PICKUP = SEDAN._replace(
    cowl_height=0.62, roof_front=0.38, roof_rear=0.58, deck=0.63, deck_height=0.58,
    tail_height=0.57, belt_height=0.6,
)  # fmt: skip
# Lorry or bus: upright front and no hood.
BOX = VAN._replace(
    hood_height=0.36, cowl=0.02, cowl_height=0.42, roof_front=0.06, roof_rear=0.98, deck=0.99,
    deck_height=0.45, tail_height=0.35, belt_height=0.42, roof_width=0.97, front_width=0.96,
    rear_width=0.98, clearance=0.12, wheel_radius=0.15,
)  # fmt: skip
# Standard deviation of vehicles from the proportions of their type, chosen by hand.
DEVIATION = Proportions(
    front=0.01, rear=0.01, hood_height=0.06, cowl=0.05, cowl_height=0.05, roof_front=0.05,
    roof_rear=0.07, deck=0.05, deck_height=0.06, tail_height=0.07, belt_height=0.03,
    roof_height=0.015, clearance=0.03, width=0.03, roof_width=0.06, front_width=0.06,
    rear_width=0.06, front_wheel=0.02, rear_wheel=0.02, wheel_radius=0.02,
)  # fmt: skip


def rounded_intersection(
    first: Float64[np.ndarray, "*n"], second: Float64[np.ndarray, "*n"], rounding_m: float
) -> Float64[np.ndarray, "*n"]:
    """Return the signed distance to the intersection of two shapes, with a rounded edge."""
    beyond = np.hypot(np.maximum(first + rounding_m, 0), np.maximum(second + rounding_m, 0))
    return np.minimum(np.maximum(first, second), -rounding_m) + beyond


@dataclass(frozen=True, eq=False)
class Body:
    """Body of one vehicle in frame `actor`: x forward, y left, z up, origin at the box centre.

    Args:
        proportions: its proportions relative to the box.
        size_lwh_m: length, width and height of the box.
        glazed_fraction: fraction of the length, from the front, that has side windows.
    """

    proportions: Proportions
    size_lwh_m: Float[np.ndarray, "3"]
    glazed_fraction: float = 1.0

    def distance_m(self, points_actor: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
        """Return the signed distance, negative inside; approximate away from the surface."""
        x, y, z = np.moveaxis(points_actor, -1, 0)
        side = self._profile_distance_m(x, z)
        across = np.abs(y) - self._half_width_m(x, z)
        hull = rounded_intersection(side, across, 0.07)  # radius of the edges, in metres
        return np.minimum(hull, self._wheel_distance_m(x, y, z))

    def is_tyre(self, points_actor: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return True for points of the surface that belong to a wheel."""
        # Measured details move the surface of a tyre by up to 4 cm.
        return self._wheel_distance_m(*points_actor.T) < 0.04

    def is_pane(
        self, points_actor: Float64[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return True for points of the surface that are glass: the cabin without roof and pillars.

        Args:
            points_actor: points on or near the surface.
            normals: unit normals of the surface there; sideways normals select side windows.
        """
        p, (x, y, z) = self.proportions, points_actor.T
        _, _, hood_end, cowl, roof_front, _, roof_rear, deck = self._profile()[:8]
        is_above_hood = (x < cowl[0]) & (x > deck[0]) & (x > self._ahead_m(self.glazed_fraction))
        # Side windows begin at 0.6 of the height, or at a higher belt line.
        is_side = is_above_hood & (z > self._height_m(max(p.belt_height, 0.6)))
        is_side &= self._profile_distance_m(x, z) < -_PILLAR_M
        # The windshield is the slope from the cowl to the roof, the rear window that to the deck.
        is_screen = (z > cowl[1]) & (x > roof_front[0]) & (x < hood_end[0])
        if self.glazed_fraction >= p.deck:
            is_screen |= (z > deck[1]) & (x < roof_rear[0]) & (x > deck[0] - _PILLAR_M)
        is_screen &= np.abs(y) < self._half_width_m(x, z) - _PILLAR_M
        is_screen &= z < self._height_m(p.roof_height) - _PILLAR_M
        return np.where(np.abs(normals[:, 1]) > 0.7, is_side, is_screen)

    def _ahead_m(self, fraction: float) -> float:
        return (0.5 - fraction) * float(self.size_lwh_m[0])

    def _height_m(self, fraction: float) -> float:
        return (fraction - 0.5) * float(self.size_lwh_m[2])

    def _profile(self) -> Float64[np.ndarray, "k 2"]:
        """Return the corners (x, z) from the lower front over the roof to the lower rear end."""
        p = self.proportions
        # The limits keep the corners in order for any proportions of the fit.
        ends = (p.front, p.rear)
        hood, tail = p.front + _NOSE, p.rear - 0.5 * _NOSE
        roof_edge = p.roof_height - 0.03
        corners = (
            (ends[0] + _NOSE, p.clearance),
            (ends[0], 0.6 * p.hood_height),
            (hood, p.hood_height),
            (max(p.cowl, hood + 0.005), p.cowl_height),
            (max(p.roof_front, p.cowl + 0.02), roof_edge),
            (0.5 * (p.roof_front + p.roof_rear), p.roof_height),
            (p.roof_rear, roof_edge),
            (min(max(p.deck, p.roof_rear + 0.005), tail - 0.003), p.deck_height),
            (tail, min(p.tail_height, p.deck_height)),
            (ends[1], 0.6 * min(p.tail_height, p.deck_height)),
            (ends[1] - _NOSE, p.clearance),
        )
        fraction = np.array(corners)
        length, height = float(self.size_lwh_m[0]), float(self.size_lwh_m[2])
        return np.stack([(0.5 - fraction[:, 0]) * length, (fraction[:, 1] - 0.5) * height], axis=1)

    def _profile_distance_m(
        self, x: Float64[np.ndarray, "*n"], z: Float64[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n"]:
        """Return the signed distance to the closed profile, negative inside."""
        distance = polygon_distance(np.ravel(x), np.ravel(z), self._profile())
        return distance.reshape(x.shape)

    def _half_width_m(
        self, x: Float64[np.ndarray, "*n"], z: Float64[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n"]:
        """Return half of the body's width: its plan times its cross section."""
        p = self.proportions
        u = 0.5 - x / self.size_lwh_m[0]
        v = 0.5 + z / self.size_lwh_m[2]
        ahead = np.clip(1 - (u - p.front) / _TAPER_FRACTION, 0, 1) ** 2
        behind = np.clip(1 - (p.rear - u) / _TAPER_FRACTION, 0, 1) ** 2
        plan = 1 - (1 - p.front_width) * ahead - (1 - p.rear_width) * behind
        rise = np.clip((v - p.belt_height) / max(p.roof_height - p.belt_height, 0.05), 0, 1.2)
        drop = np.clip((p.belt_height - v) / p.belt_height, 0, 1)
        # The bottom is 5 % narrower than the belt line.
        section = 1 - (1 - p.roof_width) * rise - 0.05 * drop**2
        return 0.5 * self.size_lwh_m[1] * p.width * plan * section

    def _wheel_distance_m(
        self,
        x: Float64[np.ndarray, "*n"],
        y: Float64[np.ndarray, "*n"],
        z: Float64[np.ndarray, "*n"],
    ) -> Float64[np.ndarray, "*n"]:
        p = self.proportions
        width, height = float(self.size_lwh_m[1]), float(self.size_lwh_m[2])
        radius = p.wheel_radius * height
        middle = 0.5 * width * p.width - 0.5 * _WHEEL_WIDTH_M
        across = np.abs(np.abs(y) - middle) - 0.5 * _WHEEL_WIDTH_M
        axles = [self._ahead_m(u) for u in (p.front_wheel, p.rear_wheel)]
        z_axle = -0.5 * height + radius
        radial = np.minimum(*(np.hypot(x - a, z - z_axle) for a in axles)) - radius
        return np.maximum(radial, across)
