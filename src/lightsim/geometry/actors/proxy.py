"""Default shapes of actors without a body, fitted to their boxes: the prior of unobserved parts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorKind

# Ground clearance of trailers and machines, typical; at most a fifth of half the height.
_CLEARANCE_M = 0.18
_UPRIGHT = (ActorKind.CONE, ActorKind.SIGN, ActorKind.ANIMAL)


def proxy_distance_m(
    kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"], points_actor: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n"]:
    """Return the signed distance from a kind's default shape, approximate away from the surface.

    Persons, cones, signs and animals are upright capsules, trailers and machines rounded boxes
    above the ground, all other actors rounded boxes. Vehicles with a cabin have a body instead
    (`fit_body`).
    """
    half = np.asarray(size_lwh_m, dtype=np.float64) / 2
    if kind.is_person or kind in _UPRIGHT:
        return _capsule(points_actor, half)
    if not kind.is_vehicle:
        return _rounded_box(points_actor, half, 0.1 * float(half.min()))
    clearance = min(_CLEARANCE_M, 0.2 * float(half[2]))
    raised = points_actor - np.array([0.0, 0.0, clearance / 2])
    trimmed = half - np.array([0.0, 0.0, clearance / 2])
    return _rounded_box(raised, trimmed, 0.15 * float(half[1]))


def _rounded_box(
    points: Float64[np.ndarray, "*n 3"], half: Float64[np.ndarray, "3"], radius_m: float
) -> Float64[np.ndarray, "*n"]:
    q = np.abs(points) - (half - radius_m)
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=-1)
    return outside + np.minimum(q.max(axis=-1), 0.0) - radius_m


def _capsule(
    points: Float64[np.ndarray, "*n 3"], half: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "*n"]:
    """Return the signed distance from an upright capsule, elliptic in plan, that fills the box."""
    narrow = float(half[:2].min())
    stretch = np.array([narrow / half[0], narrow / half[1], 1.0])
    scaled = points * stretch
    rod = max(float(half[2]) - narrow, 0.0)
    along = np.clip(scaled[..., 2], -rod, rod)
    axis = np.stack([np.zeros_like(along), np.zeros_like(along), along], axis=-1)
    return np.linalg.norm(scaled - axis, axis=-1) - narrow
