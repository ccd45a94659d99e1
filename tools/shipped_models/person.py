"""The person that ships: one smooth skin over limbs, in clothes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from tools.shipped_models.level_set import Field, Points, Shape, level_set
from tools.shipped_models.painted_mesh import PaintedMesh

from lightsim_lab.synthetic.shapes import Part

_VOXEL_M = 0.022
_MERGED_M = 0.035
"""Limbs flow into each other over about this distance."""
_LOW, _HIGH = (-0.45, -0.4, -0.05), (0.45, 0.4, 1.85)
# From joint to joint, with the radius at either; x ahead, y left, z from the ground, in mid-stride.
_LEGS = (
    ((0.00, -0.09, 0.90), (0.16, -0.10, 0.50), 0.088, 0.060),
    ((0.16, -0.10, 0.50), (0.26, -0.10, 0.09), 0.060, 0.042),
    ((0.24, -0.10, 0.045), (0.39, -0.11, 0.035), 0.045, 0.035),
    ((0.00, 0.09, 0.90), (0.03, 0.10, 0.48), 0.088, 0.060),
    ((0.03, 0.10, 0.48), (-0.25, 0.10, 0.14), 0.060, 0.042),
    ((-0.27, 0.10, 0.10), (-0.14, 0.11, 0.035), 0.045, 0.035),
)
_TRUNK = (
    ((0.00, -0.06, 0.95), (0.00, 0.06, 0.95), 0.100, 0.100),
    ((0.00, 0.00, 1.02), (0.01, 0.00, 1.33), 0.105, 0.125),
    ((0.00, -0.06, 1.05), (0.00, -0.11, 1.34), 0.085, 0.085),
    ((0.00, 0.06, 1.05), (0.00, 0.11, 1.34), 0.085, 0.085),
    ((0.00, -0.02, 1.47), (0.00, -0.17, 1.405), 0.055, 0.055),
    ((0.00, 0.02, 1.47), (0.00, 0.17, 1.405), 0.055, 0.055),
)
_HEAD = (
    ((0.00, 0.00, 1.44), (0.02, 0.00, 1.56), 0.055, 0.050),
    ((0.03, 0.00, 1.61), (0.02, 0.00, 1.67), 0.072, 0.085),
    ((0.06, 0.00, 1.58), (0.07, 0.00, 1.62), 0.045, 0.045),
)
_ARMS = (
    ((0.00, 0.20, 1.41), (0.05, 0.26, 1.14), 0.052, 0.042),
    ((0.05, 0.26, 1.14), (0.21, 0.24, 0.97), 0.042, 0.030),
    ((0.00, -0.20, 1.41), (-0.12, -0.26, 1.16), 0.052, 0.042),
    ((-0.12, -0.26, 1.16), (-0.14, -0.25, 0.92), 0.042, 0.030),
)
_HANDS = (
    ((0.22, 0.24, 0.96), (0.28, 0.23, 0.91), 0.036, 0.028),
    ((-0.14, -0.25, 0.91), (-0.13, -0.24, 0.83), 0.036, 0.028),
)
_Limbs = tuple[tuple[tuple[float, float, float], tuple[float, float, float], float, float], ...]


def person_parts() -> list[Part]:
    """One part a look: x ahead, y left, z from the ground; looks are those of `built_in_assets`."""
    limbs = (*_LEGS, *_TRUNK, *_HEAD, *_ARMS, *_HANDS)
    surface = level_set(lambda p: _merged(limbs, p), _LOW, _HIGH, _VOXEL_M)
    mesh = PaintedMesh.plain("cloth", *surface)
    clothes: tuple[tuple[str, Shape], ...] = (
        ("trousers", lambda p: np.maximum(p[:, 2] - 0.97, _beside(_LEGS, _ARMS + _HANDS, p))),
        ("rubber", lambda p: _beside((_LEGS[2], _LEGS[5]), (_LEGS[1], _LEGS[4]), p)),
        (
            "skin",
            lambda p: np.minimum(_beside(_HEAD, _TRUNK, p), _beside(_HANDS, _ARMS + _LEGS, p)),
        ),
        # From the forehead down to the neck.
        ("hair", lambda p: 1.63 + 0.9 * (p[:, 0] - 0.03) - p[:, 2]),
    )
    for look, shape in clothes:
        mesh = mesh.painted(look, shape)
    return mesh.parts()


def _merged(limbs: _Limbs, points: Points) -> Field:
    """Signed distance to limbs that flow into each other (smooth minimum)."""
    distance = np.stack([_limb_m(limb, points) for limb in limbs])
    least = distance.min(axis=0)
    return least - _MERGED_M * np.log(np.exp((least - distance) / _MERGED_M).sum(axis=0)) / 2


def _beside(limbs: _Limbs, others: _Limbs, points: Points) -> Field:
    """Negative where the first are nearer than the others."""
    own, other = (
        np.min([_limb_m(one, points) for one in some], axis=0) for some in (limbs, others)
    )
    return own - other


def _limb_m(
    limb: tuple[tuple[float, float, float], tuple[float, float, float], float, float],
    points: Points,
) -> Field:
    """Signed distance to a tapering limb with round ends."""
    start: Float64[np.ndarray, "3"] = np.array(limb[0])
    axis = np.array(limb[1]) - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
    away = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
    return away - (limb[2] + along * (limb[3] - limb[2]))
