"""Depth edges: returns beside which the next surface lies farther, and edges of pictures."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from scipy.ndimage import gaussian_filter, sobel
from scipy.spatial import KDTree

from lightsim.core.actors import ActorTrack
from lightsim.core.resample import resize_area
from lightsim.core.sensors import SWEEP_HOLD_S, LidarSweep

_NEIGHBOURS = 8
_NEIGHBOUR_RAD = 0.012
_LEAST_JUMP_M, _LEAST_JUMP = 0.5, 0.05
_LEAST_CONTRAST = 4.0
"""On a slanted surface neighbours lie before a return as far as others behind it."""
_SENSOR_M = 0.3
"""Returns whose sensors stood farther apart are not neighbours on one silhouette."""
_RANGE_M = (3.0, 60.0)
_QUERIES = 40_000
_MARGIN_M = 0.4
"""Around boxes, which fit loosely; not measured."""
_STRONG = 3.0


def depth_edges(
    sweep: LidarSweep, actors: tuple[ActorTrack, ...], rng: np.random.Generator
) -> Float64[np.ndarray, "n 3"]:
    """Points between the near and the far side of jumps in distance, frame `world`; none of
    moving actors.

    Seen from the LiDAR they lie on silhouettes, and nearly so from the cameras beside it
    (Levinson and Thrun 2013, doi:10.15607/RSS.2013.IX.029). A silhouette passes, on average,
    midway between two beams: the last return itself would lie inside it.
    """
    rays = sweep.points_world.astype(np.float64) - sweep.origins_world
    distance = np.linalg.norm(rays, axis=1)
    in_range = np.flatnonzero((distance > _RANGE_M[0]) & (distance < 2 * _RANGE_M[1]))
    if len(in_range) <= _NEIGHBOURS:
        return np.empty((0, 3))
    rays, distance = rays[in_range], distance[in_range]
    directions = rays / distance[:, None]
    asked = np.flatnonzero(distance < _RANGE_M[1])
    asked = rng.permutation(asked)[:_QUERIES]
    apart, near = KDTree(directions).query(directions[asked], k=_NEIGHBOURS + 1, workers=2)
    origins = sweep.origins_world[in_range].astype(np.float64)
    same_sensor = np.linalg.norm(origins[near] - origins[asked][:, None], axis=2) < _SENSOR_M
    own = distance[asked][:, None]
    beside = np.where(same_sensor & (apart < _NEIGHBOUR_RAD), distance[near], own) - own
    is_behind = beside > np.maximum(
        _LEAST_JUMP * own + _LEAST_JUMP_M, -_LEAST_CONTRAST * beside.min(axis=1, keepdims=True)
    )
    is_edge = is_behind.any(axis=1)
    rows = asked[is_edge]
    first = is_behind[is_edge].argmax(axis=1)
    other = np.take_along_axis(np.asarray(near)[is_edge], first[:, None], axis=1)[:, 0]
    middle = directions[rows] + directions[other]
    middle *= (distance[rows] / np.linalg.norm(middle, axis=1))[:, None]
    points = origins[rows] + middle
    return points[~is_on_moving_actor(points, actors, sweep.time_ns)]


def is_on_moving_actor(
    points_world: Float64[np.ndarray, "n 3"],
    actors: tuple[ActorTrack, ...],
    time_ns: int,
) -> Bool[np.ndarray, " n"]:
    """Which points lie in the grown box of an actor that moves."""
    found = np.zeros(len(points_world), dtype=bool)
    for actor in actors:
        if actor.is_moving and actor.is_present(time_ns, SWEEP_HOLD_S):
            actor_from_world = actor.world_from_actor(time_ns, SWEEP_HOLD_S).inverse()
            local = np.abs(actor_from_world.apply(points_world))
            found |= (local <= actor.size_lwh_m / 2 + _MARGIN_M).all(axis=1)
    return found


def reduced_grey(
    srgb8: UInt8[np.ndarray, "h w 3"], height_px: int, width_px: int
) -> Float32[np.ndarray, "h2 w2"]:
    """The green channel at another size."""
    grey = srgb8[..., 1:2].astype(np.float32)
    if grey.shape[:2] == (height_px, width_px):
        return grey[..., 0]
    return resize_area(grey, height_px, width_px)[..., 0].astype(np.float32)


def edge_strength(grey: Float32[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Gradient of log intensity, from 0 to 1: half where it is several times the picture's mean
    and a good part of its strongest, so that the middle of an edge stays its maximum."""
    smooth = gaussian_filter(np.log(grey + 8.0), sigma_px)
    gradient = np.hypot(sobel(smooth, 0), sobel(smooth, 1))
    strongest = float(np.percentile(gradient[::2, ::2], 99.5))
    scale = max(_STRONG * float(gradient.mean()), 0.5 * strongest, 1e-6)
    return (gradient / (gradient + scale)).astype(np.float32)


def sample(
    image: Float32[np.ndarray, "h w"], uv: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Bilinear values at (u, v); the border's value outside, 0 at NaN."""
    height, width = image.shape
    is_known = np.isfinite(uv).all(axis=1)
    x = np.clip(np.where(is_known, uv[:, 0], 0.5) - 0.5, 0.0, width - 1.001)
    y = np.clip(np.where(is_known, uv[:, 1], 0.5) - 0.5, 0.0, height - 1.001)
    j, i = x.astype(np.int64), y.astype(np.int64)
    a, b = x - j, y - i
    flat = image.ravel()
    k = i * width + j
    top = (1 - a) * flat[k] + a * flat[k + 1]
    low = (1 - a) * flat[k + width] + a * flat[k + width + 1]
    return np.where(is_known, (1 - b) * top + b * low, 0.0)
