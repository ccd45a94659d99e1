"""What is put on and into a car's body: arches, wheels, mirrors, handles, plates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightsim.simulation.shipped_models.car_body import ARCH_DEPTH_M, SHOULDER_M, CarBody
from lightsim.simulation.shipped_models.painted_mesh import PaintedMesh
from lightsim.synthetic.shapes import Part, box, ellipsoid, quads

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


def with_arches(mesh: PaintedMesh, body: CarBody) -> tuple[PaintedMesh, Part]:
    """The surface without what lies around the wheels, and the arches' inside."""
    mesh, is_inside = mesh.cut(body.arch_m(mesh.vertices))
    kept, removed = mesh.faces[~is_inside], mesh.faces[is_inside]
    # Rims: edges of what goes that what stays has the other way round.
    edges = removed[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    left = kept[:, [1, 0, 2, 1, 0, 2]].reshape(-1, 2)
    keys = np.array([len(mesh.vertices), 1])
    rim = edges[np.isin(edges @ keys, left @ keys)]
    a, b = mesh.vertices[rim[:, 0]], mesh.vertices[rim[:, 1]]
    axles = body.axles()
    nearest = np.argmin([np.abs(a[:, 0] - x) for x, _ in axles], axis=0)
    middle = np.array([[x, 0.0, radius] for x, radius in axles])[nearest]
    inner = np.sign(a[:, 1]) * (0.5 * body.design.width_m - ARCH_DEPTH_M)
    deep_a, deep_b, middle = (np.stack([p[:, 0], inner, p[:, 2]], axis=1) for p in (a, b, middle))
    around, wall = (a, b, deep_b, deep_a), (deep_a, deep_b, middle, middle)
    corners = np.concatenate([np.stack(quad, axis=1) for quad in (around, wall)])
    mesh = replace(mesh, faces=kept, look=mesh.look[~is_inside])
    return mesh, quads("black", corners, corners[..., [0, 2]])


def attached_parts(body: CarBody, paint: str) -> list[Part]:
    """Mirrors, handles, plates."""
    design, p = body.design, body.design.proportions
    cowl, tail = body.corners[3], body.corners[8]
    belt = p.belt_height * design.height_m
    parts = []
    for side in (-1.0, 1.0):
        x = float(cowl[0]) - 0.42
        y = side * (float(body.half_width_m(np.array([x]), np.array([belt]))[0]) + 0.09)
        parts.append(ellipsoid(paint, (x, y, belt + 0.09), (0.085, 0.115, 0.075)))
        for u in (*design.pillars, 0.76)[:2]:
            x, z = body.ahead_m(u) + 0.14, belt - 0.1
            y = side * float(body.half_width_m(np.array([x]), np.array([z]))[0])
            a, b = sorted((y - side * 0.02, y + side * 0.025))
            parts.append(box(paint, (x - 0.09, a, z - 0.014), (x + 0.09, b, z + 0.014)))
    for sign, z in ((1.0, 0.42), (-1.0, min(0.78 * float(tail[1]), 0.8))):
        ends = np.array([[s, 0.0, z] for s in np.linspace(0.35, 0.55, 400) * design.length_m])
        x = sign * float(ends[np.argmax(body.distance_m(ends * [sign, 1, 1]) > 0), 0])
        a, b = sorted((x - sign * 0.05, x + sign * 0.012))
        parts.append(box("plate", (a, -0.26, z - 0.055), (b, 0.26, z + 0.055)))
    return parts


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


def wheel_parts(body: CarBody) -> list[Part]:
    """Tyres with round shoulders, and in them dark dishes, spokes and rims."""
    face = 0.5 * body.design.width_m * body.design.proportions.width - SHOULDER_M - 0.012
    parts = []
    for x, radius in body.axles():
        for side in (-1.0, 1.0):
            wheel = _Wheel(x, side, face, radius)
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
