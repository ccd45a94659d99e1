"""Replace the measured surface of poles by cylinders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.rods import Pole
from lightsim.geometry.surface import keep_faces

# Distance from a pole's surface within which measured surface is replaced, in metres: about the
# reach of the field's samples.
_REPLACED_M = 0.3
# Height above a pole's foot below which nothing is replaced, in metres: it is ground.
_GROUND_M = 0.15
# Number of sides of a cylinder.
_SIDES = 10
# Height of its rings, in metres: each face has its own provenance and colour.
_RING_M = 0.5


def with_poles(background: TriMesh, poles: Sequence[Pole]) -> TriMesh:
    """Replace the measured surface of poles by cylinders.

    Args:
        background: static surface, frame world. Cylinders have the most frequent material of the
            faces that they replace.
        poles: fitted poles.
    """
    centres = background.vertices[background.faces].mean(axis=1).astype(np.float64)
    is_replaced = np.zeros(len(centres), dtype=bool)
    rods: list[TriMesh] = []
    for pole in poles:
        axis = pole.axis_at(centres[:, 2])
        beside = np.linalg.norm((centres - axis)[:, :2], axis=1) - pole.radius_at(centres[:, 2])
        is_own = (beside < _REPLACED_M) & (centres[:, 2] < pole.measured_m[1] + _REPLACED_M)
        is_own &= centres[:, 2] > pole.foot_m[2] + _GROUND_M
        rods.append(_cylinder(pole, background, is_own))
        is_replaced |= is_own
    return concatenate_meshes([keep_faces(background, ~is_replaced), *rods])


def _cylinder(pole: Pole, background: TriMesh, is_own: Bool[np.ndarray, " m"]) -> TriMesh:
    """Return the pole's lateral surface and its closed upper end."""
    rings = max(2, int(np.ceil((pole.top_m - pole.foot_m[2]) / _RING_M)) + 1)
    z = np.linspace(pole.foot_m[2], pole.top_m, rings)
    turn = 2 * np.pi * np.arange(_SIDES) / _SIDES
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros(_SIDES)], axis=1)
    axis, radius = pole.axis_at(z), pole.radius_at(z)
    points = axis[:, None] + radius[:, None, None] * rim
    low = (np.arange(rings - 1)[:, None] * _SIDES + np.arange(_SIDES)).reshape(-1)
    beside = (np.arange(rings - 1)[:, None] * _SIDES + (np.arange(_SIDES) + 1) % _SIDES).reshape(-1)
    sides = [[low, beside, beside + _SIDES], [low, beside + _SIDES, low + _SIDES]]
    last = (rings - 1) * _SIDES
    lid = np.stack([np.full(_SIDES - 2, last), *(last + np.arange(_SIDES - 2) + k for k in (1, 2))])
    faces = np.concatenate([np.stack(part, axis=1) for part in sides] + [lid.T])
    vertices = points.reshape(-1, 3).astype(np.float32)
    mesh = TriMesh("world", vertices, faces.astype(np.int32), np.zeros_like(vertices))
    middle = vertices[mesh.faces][..., 2].mean(axis=1)
    is_measured = (middle > pole.measured_m[0] - _RING_M) & (middle < pole.measured_m[1] + _RING_M)
    provenance = np.where(is_measured, Provenance.MEASURED, Provenance.INFERRED).astype(np.uint8)
    number = 0
    if background.face_material is not None and is_own.any():
        number = int(np.bincount(background.face_material[is_own]).argmax())
    return replace(mesh, materials=(background.materials[number],), face_provenance=provenance)
