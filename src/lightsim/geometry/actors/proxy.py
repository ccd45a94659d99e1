"""Default shapes of actors, fitted to their boxes: the prior where no ray has been."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorKind

_CLEARANCE_M = 0.18
_CAR_SHAPED = (ActorKind.CAR, ActorKind.PICKUP, ActorKind.OTHER_VEHICLE)
_UPRIGHT = (ActorKind.CONE, ActorKind.SIGN, ActorKind.ANIMAL)


def proxy_distance_m(
    kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"], points_actor: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n"]:
    """Signed distance (approximate away from the surface) from the default shape of a kind.

    Cars and pickups are a rounded body with a cabin, larger vehicles a rounded box, persons and
    cones an upright capsule, everything else a rounded box.
    """
    half = np.asarray(size_lwh_m, dtype=np.float64) / 2
    if kind.is_person or kind in _UPRIGHT:
        return _capsule(points_actor, half)
    if not kind.is_vehicle:
        return _rounded_box(points_actor, half, 0.1 * float(half.min()))
    clearance = min(_CLEARANCE_M, 0.2 * float(half[2]))
    raised = points_actor - np.array([0.0, 0.0, clearance / 2])
    trimmed = half - np.array([0.0, 0.0, clearance / 2])
    if kind in _CAR_SHAPED:
        return _car(raised, trimmed)
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
    """An upright capsule, elliptic in plan, that touches the box."""
    narrow = float(half[:2].min())
    stretch = np.array([narrow / half[0], narrow / half[1], 1.0])
    scaled = points * stretch
    rod = max(float(half[2]) - narrow, 0.0)
    along = np.clip(scaled[..., 2], -rod, rod)
    axis = np.stack([np.zeros_like(along), np.zeros_like(along), along], axis=-1)
    return np.linalg.norm(scaled - axis, axis=-1) - narrow


def _car(
    points: Float64[np.ndarray, "*n 3"], half: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "*n"]:
    """A body of 58 % of the height and a cabin that leans in towards the roof."""
    body_half = half * np.array([1.0, 1.0, 0.58])
    body_centre = np.array([0.0, 0.0, -half[2] + body_half[2]])
    body = _rounded_box(points - body_centre, body_half, 0.25 * float(half[1]))
    cabin_half = half * np.array([0.56, 0.9, 0.6])
    cabin_centre = np.array([-0.06 * half[0], 0.0, half[2] - cabin_half[2]])
    local = points - cabin_centre
    rise = np.clip(local[..., 2] / (2 * cabin_half[2]) + 0.5, 0.0, 1.0)
    lean = 1.0 - 0.22 * rise
    leaning = np.stack([local[..., 0] / lean, local[..., 1] / (1 - 0.15 * rise), local[..., 2]], -1)
    cabin = _rounded_box(leaning, cabin_half, 0.2 * float(half[1]))
    return np.minimum(body, cabin)
