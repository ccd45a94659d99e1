"""Wheels: tyres with round shoulders, and in them dark dishes, spokes and rims."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lightsim_lab.synthetic.shapes import Part, quads

_TYRE_WIDTH_M = 0.21
# Outlines of what turns: part of the wheel's radius, metres outwards from its face.
_TYRE = (
    (0.66, 0.0), (0.72, 0.008), (0.9, 0.008), (0.97, -0.012), (1.0, -0.04),
    (1.0, 0.04 - _TYRE_WIDTH_M), (0.97, 0.012 - _TYRE_WIDTH_M), (0.66, -_TYRE_WIDTH_M),
    (0.0, -_TYRE_WIDTH_M),
)  # fmt: skip
_DISH = ((0.0, -0.055), (0.6, -0.05), (0.64, 0.0))
_RIM = ((0.585, -0.03), (0.6, 0.0), (0.655, 0.004), (0.67, 0.0))
_HUB = ((0.0, 0.0), (0.1, 0.0), (0.15, -0.02))


@dataclass(frozen=True)
class _Wheel:
    """Where a wheel is: x of its axle, 1 left or -1 right, y of its face without sign."""

    x: float
    side: float
    face: float
    radius_m: float

    def point(self, ahead: np.ndarray, out: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Parts of the radius from the axle, metres outwards from the face."""
        y = np.broadcast_to(self.side * (self.face + out), ahead.shape)
        return np.stack(
            [self.x + self.radius_m * ahead, y, self.radius_m * (1 + up)],
            axis=-1,
        )


def wheel_parts(axles: Iterable[tuple[float, float]], face_m: float) -> list[Part]:
    """A wheel on either side of each axle.

    Args:
        axles: x, and the wheels' radius.
        face_m: from the middle to the outer side of the wheels.
    """
    parts = []
    for x, radius in axles:
        for side in (-1.0, 1.0):
            wheel = _Wheel(x, side, face_m, radius)
            parts += [_turned("rubber", _TYRE, wheel), _turned("black", _DISH, wheel)]
            parts += [_turned("steel", outline, wheel) for outline in (_RIM, _HUB)]
            parts.append(_spokes(wheel))
    return parts


def _turned(look: str, outline: Sequence[tuple[float, float]], wheel: _Wheel) -> Part:
    """An outline turned about the axle."""
    radial, out = np.array(outline).T[:, :, None]
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = wheel.point(radial * np.cos(angle), out, radial * np.sin(angle))
    after = np.roll(ring, -1, axis=1)
    corners = np.stack([ring[:-1], ring[1:], after[1:], after[:-1]], axis=2).reshape(-1, 4, 3)
    return _facing_out(look, corners, wheel)


def _spokes(wheel: _Wheel) -> Part:
    """Five, from the hub out, wider at the hub."""
    angle = np.arange(5)[:, None] * 2 * np.pi / 5 + 0.3
    along, across = np.array([(0.08, -0.09), (0.62, -0.06), (0.62, 0.06), (0.08, 0.09)]).T
    out = np.where(along < 0.3, -0.012, 0.0)
    ahead = along * np.cos(angle) - across * np.sin(angle)
    up = along * np.sin(angle) + across * np.cos(angle)
    return _facing_out("steel", wheel.point(ahead, out, up)[:, ::-1], wheel)


def _facing_out(look: str, corners: np.ndarray, wheel: _Wheel) -> Part:
    """Quadrilaterals given counter-clockwise for the left side."""
    if wheel.side < 0:
        corners = corners[:, ::-1]
    return quads(look, corners, corners[..., [0, 2]])
