"""Cars and pedestrians of the synthetic street, in frame `actor` (origin at the box centre)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lightsim.core.actors import ActorKind
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.shapes import (
    Part,
    box,
    ellipsoid,
    loft,
    merge_parts,
    quads,
    tube,
)


@dataclass(frozen=True, eq=False)
class Participant:
    """Actor at rest, or at constant velocity along its heading.

    Args:
        parts: geometry in frame `actor`.
        size_lwh_m: extent of the parts, and size of the labelled box.
        start_m: position (x, y, z) of the box's lower centre at time 0, frame `street`.
        heading_rad: direction of travel, frame `street`.
    """

    actor_id: str
    kind: ActorKind
    parts: tuple[Part, ...]
    size_lwh_m: tuple[float, float, float]
    start_m: tuple[float, float, float]
    heading_rad: float
    speed_m_s: float

    def street_from_actor(self, time_s: float) -> RigidTransform:
        """Return the pose of the box centre at a time in seconds; it may be negative."""
        distance = self.speed_m_s * time_s
        x, y, z = self.start_m
        centre = np.array(
            [
                x + distance * np.cos(self.heading_rad),
                y + distance * np.sin(self.heading_rad),
                z + self.size_lwh_m[2] / 2,
            ]
        )
        return RigidTransform.from_yaw("street", "actor", self.heading_rad, centre)


@dataclass(frozen=True)
class CarShape:
    """Dimensions of a car, in metres."""

    length_m: float
    width_m: float
    height_m: float
    bonnet_m: float
    boot_m: float
    slope_m: float
    waist_m: float | None = None
    """Height of the lower body; by default in proportion to the height."""

    @property
    def top_m(self) -> float:
        """Height of the lower body."""
        if self.waist_m is not None:
            return self.waist_m
        return 0.56 * self.height_m if self.height_m < 1.9 else 1.05

    @property
    def window_m(self) -> float:
        """Height of the lower edge of the windows."""
        if self.waist_m is not None:
            return self.waist_m - 0.05
        return 0.54 * self.height_m if self.height_m < 1.9 else 1.0


# A saloon, a hatchback, an SUV and a van; typical dimensions, chosen by eye.
CAR_SHAPES = (
    CarShape(4.55, 1.80, 1.46, 1.20, 0.75, 0.55),
    CarShape(4.05, 1.74, 1.50, 1.00, 0.15, 0.40),
    CarShape(4.70, 1.88, 1.72, 1.10, 0.12, 0.35),
    CarShape(5.10, 1.95, 2.05, 0.75, 0.05, 0.25),
)


def build_car(shape: CarShape, paint: str) -> tuple[tuple[Part, ...], tuple[float, float, float]]:
    """Build a car; return its parts in frame `actor` and its size (length, width, height) in m."""
    parts = [_body(shape, paint), *_cabin(shape, paint), *_wheels(shape), *_lights(shape)]
    return centred(parts)


def build_walker(cloth: str, trousers: str) -> tuple[tuple[Part, ...], tuple[float, float, float]]:
    """Build a pedestrian in mid-stride, about 1.75 m tall; return parts and size as `build_car`."""
    parts = [
        tube(trousers, (0.28, -0.1, 0.06), (0.02, -0.09, 0.85), (0.06, 0.09)),
        tube(trousers, (-0.26, 0.1, 0.06), (-0.02, 0.09, 0.85), (0.06, 0.09)),
        box("rubber", (0.2, -0.15, 0.0), (0.46, -0.05, 0.09)),
        box("rubber", (-0.36, 0.05, 0.0), (-0.1, 0.15, 0.09)),
        ellipsoid(cloth, (0.0, 0.0, 1.13), (0.14, 0.21, 0.36)),
        tube(cloth, (0.02, 0.22, 1.38), (0.17, 0.27, 0.9), (0.055, 0.045)),
        tube(cloth, (0.02, -0.22, 1.38), (-0.18, -0.27, 0.92), (0.055, 0.045)),
        ellipsoid("skin", (0.03, 0.0, 1.63), (0.1, 0.085, 0.13)),
        ellipsoid("rubber", (0.01, 0.0, 1.67), (0.105, 0.092, 0.115)),
    ]
    return centred(parts)


def _body(shape: CarShape, paint: str) -> Part:
    """Build the lower body from rounded cross-sections along its length."""
    half, top = shape.length_m / 2, shape.top_m
    x = half * np.array([-1, -0.985, -0.95, -0.85, -0.6, -0.2, 0.2, 0.5, 0.75, 0.9, 0.97, 1.0])
    width = (
        shape.width_m
        / 2
        * np.array([0.8, 0.88, 0.93, 0.97, 0.99, 1.0, 1.0, 0.99, 0.96, 0.9, 0.84, 0.75])
    )
    low = np.array([0.42, 0.36, 0.3, 0.26, 0.22, 0.22, 0.22, 0.22, 0.24, 0.28, 0.32, 0.4])
    # The boot of a saloon is slightly lower than its waist.
    rise = 0.93 if shape.boot_m > 0.4 else 1.0
    high = top * np.array([0.85, 0.93, 0.97, rise, 1, 1, 1, 0.97, 0.9, 0.83, 0.76, 0.62])
    # Superellipse of exponent 2 / 0.42: a rounded rectangle.
    angle = np.linspace(0, 2 * np.pi, 28, endpoint=False) + np.pi / 28
    c, s = np.cos(angle), np.sin(angle)
    y = np.sign(c) * np.abs(c) ** 0.42
    z = np.sign(s) * np.abs(s) ** 0.42
    sections = np.stack(
        [
            np.broadcast_to(x[:, None], (len(x), len(angle))),
            width[:, None] * y,
            (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * z,
        ],
        axis=-1,
    )
    return loft(paint, sections)


def _cabin(shape: CarShape, paint: str) -> list[Part]:
    """Build the cabin: windows on all sides, painted pillars and roof."""
    # The cabin narrows towards the roof; windows span the whole trapezoid, pillars cover its edges.
    half, z0 = shape.length_m / 2, shape.window_m
    z1 = shape.height_m - 0.05
    rear, front = -half + shape.boot_m + 0.1, half - shape.bonnet_m
    w0, w1 = 0.47 * shape.width_m, 0.38 * shape.width_m
    rear_top, front_top = rear + 0.75 * shape.slope_m, front - 1.25 * shape.slope_m
    bottom = np.array([[rear, -w0], [front, -w0], [front, w0], [rear, w0]])
    top = np.array([[rear_top, -w1], [front_top, -w1], [front_top, w1], [rear_top, w1]])
    low = np.concatenate([bottom, np.full((4, 1), z0)], axis=1)
    high = np.concatenate([top, np.full((4, 1), z1)], axis=1)
    nxt = np.roll(np.arange(4), -1)
    sides = np.stack([low, low[nxt], high[nxt], high], axis=1)
    parts = [quads("car_glass", sides, sides[..., [0, 2]] + sides[..., [1, 1]])]
    for i in range(4):
        parts.append(tube(paint, low[i].tolist(), high[i].tolist(), (0.055, 0.045), 8))
    for fraction in (0.4, 0.62):
        for row in (0, 2):
            a = low[row] + fraction * (low[row + 1] - low[row])
            b = high[row] + fraction * (high[row + 1] - high[row])
            parts.append(tube(paint, a.tolist(), b.tolist(), (0.04, 0.035), 6))
    # Heights of the roof above its edge, from the rear to the front.
    swell = np.array([-0.03, 0.0, 0.05, 0.05, 0.0, -0.03])
    xs = np.linspace(rear_top - 0.06, front_top + 0.06, len(swell))
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    y = w1 * 1.05 * np.sign(c) * np.abs(c) ** 0.35
    skin = [
        np.stack([np.full_like(y, x), y, z1 - 0.015 + (0.015 + max(h, 0.0)) * s], axis=-1)
        for x, h in zip(xs.tolist(), swell.tolist(), strict=True)
    ]
    parts.append(loft(paint, np.stack(skin)))
    return parts


def _wheels(shape: CarShape) -> list[Part]:
    parts = []
    y = shape.width_m / 2
    # Positions of the axles relative to the length.
    for x in (-0.31 * shape.length_m, 0.30 * shape.length_m):
        for side in (-1.0, 1.0):
            inner, outer = (x, side * (y - 0.24), 0.33), (x, side * (y - 0.005), 0.33)
            parts.append(tube("rubber", inner, outer, (0.33, 0.33), 20))
            hub = (x, side * (y + 0.008), 0.33)
            parts.append(tube("steel", outer, hub, (0.2, 0.17), 14))
    return parts


def _lights(shape: CarShape) -> list[Part]:
    half, y, z = shape.length_m / 2, shape.width_m / 2, 0.40 * shape.height_m
    parts = []
    for side in (-1.0, 1.0):
        a, b = sorted((side * 0.5 * y, side * 0.8 * y))
        parts.append(box("lamp", (half - 0.12, a, z), (half - 0.03, b, z + 0.13)))
        parts.append(box("tail", (-half - 0.005, a, z + 0.05), (-half + 0.1, b, z + 0.2)))
    parts.append(box("plate", (-half - 0.015, -0.26, 0.5), (-half + 0.05, 0.26, 0.61)))
    return parts


def centred(
    parts: list[Part],
) -> tuple[tuple[Part, ...], tuple[float, float, float]]:
    """Merge parts by material and move the centre of their bounding box to the origin."""
    merged = merge_parts(parts)
    points = np.concatenate([part.vertices for part in merged])
    low: Float[np.ndarray, "3"] = points.min(axis=0).astype(np.float64)
    high = points.max(axis=0).astype(np.float64)
    centre = (low + high) / 2
    moved = tuple(
        replace(part, vertices=(part.vertices - centre).astype(np.float32)) for part in merged
    )
    length, width, height = (high - low).tolist()
    return moved, (length, width, height)
