"""The truck that ships: a cab, a box, and what carries them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from tools.shipped_models.car_body import filleted
from tools.shipped_models.level_set import Field, Points, Shape, grown, level_set
from tools.shipped_models.painted_mesh import PaintedMesh
from tools.shipped_models.wheels import wheel_parts

from lightsim.geometry.actors.body import rounded_intersection
from lightsim.geometry.actors.profile_kernels import polygon_distance
from lightsim_lab.synthetic.shapes import Part, box, merge_parts, tube

_CAB_VOXEL_M, _LOAD_VOXEL_M = 0.07, 0.12
# (x, z) of the cab's side, its half width, and how round its edges are.
_CAB_FRACTION = np.array(
    [(1.75, 0.5), (3.68, 0.5), (3.72, 1.3), (3.66, 1.4), (3.38, 2.55), (1.75, 2.62)]
)
_CAB_M, _ROUNDING_M = 1.1, 0.1
_FILLETS_M = (0.05, 0.1, 0.1, 0.15, 0.3, 0.1)
_LOAD = np.array([(-3.75, 1.0), (1.6, 1.0), (1.6, 3.4), (-3.75, 3.4)])
_LOAD_M = 1.2
_AXLES = ((2.75, 0.45), (-2.4, 0.45))
_WHEEL_FACE_M = 1.1
_RAIL_M, _SEAL_M = 0.1, 0.025


def truck_parts() -> list[Part]:
    """One part a look of a box truck of 7.5 m: x ahead, y left, z from the ground; looks are those
    of `built_in_assets`."""
    parts = [*_cab().parts(), *_load().parts(), *wheel_parts(_AXLES, _WHEEL_FACE_M)]
    parts += [
        box("black", (-3.7, -0.45, 0.6), (2.3, 0.45, 1.0)),
        box("plastic", (-3.75, -1.1, 0.5), (-3.68, 1.1, 0.6)),
        box("plate", (3.68, -0.26, 0.62), (3.74, 0.26, 0.74)),
    ]
    for side in (-1.0, 1.0):
        # Mirrors on arms, lamps below the box, boards against spray behind the wheels.
        y, inner, outer = (side * at for at in (1.32, 0.75, 1.05))
        low, high = sorted((y - 0.09, y + 0.09))
        parts.append(box("plastic", (3.42, low, 1.65), (3.5, high, 2.1)))
        parts.append(tube("plastic", (3.4, side * 1.0, 2.2), (3.46, y, 2.1), (0.02, 0.02), 8))
        low, high = sorted((inner, outer))
        parts.append(box("tail", (-3.79, low, 0.78), (-3.7, high, 0.94)))
        parts.append(box("black", (-3.0, low, 0.25), (-2.97, high, 0.95)))
    return list(merge_parts(parts))


def _cab() -> PaintedMesh:
    profile = filleted(_CAB_FRACTION, _FILLETS_M)
    mesh = _solid("grey", profile, _CAB_M, _ROUNDING_M, _CAB_VOXEL_M)

    def side_m(v: Points) -> Field:
        return polygon_distance(v[:, 0], v[:, 2], profile)

    def door_pane(v: Points) -> Field:
        x, _, z = v.T
        return np.max([1.5 - z, z - 2.4, 2.35 - x, side_m(v) + 0.13], axis=0)

    def windscreen(v: Points) -> Field:
        _, y, z = v.T
        return np.max(
            [1.5 - z, z - 2.42, np.abs(y) - 0.95, 3.0 - v[:, 0], -0.06 - side_m(v)], axis=0
        )

    def front(v: Points, low: float, high: float, inner: float, outer: float) -> Field:
        _, y, z = np.abs(v).T
        return np.max([low - z, z - high, inner - y, y - outer, 3.4 - v[:, 0]], axis=0)

    looks: list[tuple[str, Shape]] = [
        ("plastic", lambda v: v[:, 2] - 0.62),
        ("plastic", lambda v: front(v, 0.9, 1.2, -1.0, 0.85)),
        ("lamp", lambda v: front(v, 0.66, 0.84, 0.68, 1.0)),
    ]
    for pane in (door_pane, windscreen):
        looks += [("plastic", grown(pane, _SEAL_M)), ("car_glass", pane)]
    for at in (2.3, 3.52):
        mesh = mesh.lined(
            "black",
            lambda v, at=at: v[:, 0] - at,
            lambda v: np.maximum(side_m(v) + 0.08, 0.7 - v[:, 2]),
            0.015,
        )
    for look, shape in looks:
        mesh = mesh.painted(look, shape)
    return mesh


def _load() -> PaintedMesh:
    """A white box in rails."""
    mesh = _solid("white", _LOAD, _LOAD_M, 0.06, _LOAD_VOXEL_M)
    x, z = (_LOAD[:, k] for k in (0, 1))

    def rails(v: Points) -> Field:
        """Within a rail's width of two of the six sides: along the edges."""
        ends = [v[:, 0] - x.min(), x.max() - v[:, 0], v[:, 2] - z.min(), z.max() - v[:, 2]]
        sides = np.stack([*ends, _LOAD_M - np.abs(v[:, 1])])
        return np.partition(sides, 1, axis=0)[1] - _RAIL_M

    return mesh.painted("steel", rails)


def _solid(
    look: str,
    profile: Float64[np.ndarray, "k 2"],
    half_width_m: float,
    rounding_m: float,
    voxel_m: float,
) -> PaintedMesh:
    """A side profile as wide everywhere, with round edges."""

    def distance_m(v: Points) -> Field:
        x, y, z = v.T
        side = polygon_distance(x, z, profile)
        return rounded_intersection(side, np.abs(y) - half_width_m, rounding_m)

    (x0, z0), (x1, z1) = profile.min(axis=0) - 0.1, profile.max(axis=0) + 0.1
    wide = half_width_m + 0.1
    surface = level_set(distance_m, (x0, -wide, z0), (x1, wide, z1), voxel_m)
    return PaintedMesh.plain(look, *surface)
