"""Car windows: beams pass through them, so fused cabins are hollow; they are closed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial import ConvexHull, QhullError

from lightsim.core.actors import ActorKind

_OPEN = (ActorKind.PICKUP, ActorKind.TRAILER, ActorKind.CONSTRUCTION_VEHICLE)
"""Their cross sections are hollow in truth."""
_CABIN_FROM = 0.55
"""Windows begin above this fraction of the height."""
_BODY_BAND_M = 0.35
"""Height of the part of the body below the belt line that tells its width."""
_MIN_CELLS = 8


def close_cabin(
    kind: ActorKind,
    sdf_m: Float32[np.ndarray, "x y z"],
    low_m: Float[np.ndarray, "3"],
    voxel_m: float,
    size_lwh_m: Float[np.ndarray, "3"],
) -> Float32[np.ndarray, "x y z"]:
    """The field with cabins made solid: level cross sections of cars are close to convex.

    Every level slice above the belt line is united with the convex hull of what is solid in it,
    side mirrors left out. Pickups, trailers and machines stay as they are.
    """
    if not kind.is_vehicle or kind in _OPEN:
        return sdf_m
    closed = sdf_m.copy()
    heights = low_m[2] + voxel_m * np.arange(sdf_m.shape[2])
    belt = -size_lwh_m[2] / 2 + _CABIN_FROM * size_lwh_m[2]
    x = low_m[0] + voxel_m * np.arange(sdf_m.shape[0])
    y = low_m[1] + voxel_m * np.arange(sdf_m.shape[1])
    plan = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    half = size_lwh_m[:2] / 2
    in_box = np.all(np.abs(plan) <= half, axis=-1)
    widest = _body_reach_m((sdf_m < 0) & in_box[:, :, None], y, heights, float(belt))
    in_box &= np.abs(plan[..., 1]) <= widest + 0.5 * voxel_m
    for k in np.flatnonzero(heights > belt):
        points = plan[(sdf_m[:, :, k] < 0) & in_box]
        if len(points) < _MIN_CELLS:
            continue
        try:
            planes = ConvexHull(points).equations
        except QhullError:  # all solid cells in one line
            continue
        distance = (plan @ planes[:, :2].T + planes[:, 2]).max(axis=-1)
        closed[:, :, k] = np.minimum(closed[:, :, k], distance)
    return closed


def _body_reach_m(
    solid: Bool[np.ndarray, "x y z"],
    y: Float[np.ndarray, " y"],
    heights: Float[np.ndarray, " z"],
    belt_m: float,
) -> float:
    """How far the body reaches sideways just below the belt line: only mirrors reach further."""
    below = (heights < belt_m) & (heights > belt_m - _BODY_BAND_M)
    reach = np.where(solid[:, :, below], np.abs(y)[None, :, None], 0.0).max(axis=1)
    reach = reach[reach > 0]
    return float(np.percentile(reach, 90)) if len(reach) else float(np.abs(y).max())
