"""Depth edges of LiDAR sweeps, and edge strength of images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from scipy.ndimage import gaussian_filter, sobel
from scipy.spatial import KDTree

from lightsim.core.actors import ActorTrack
from lightsim.core.lidar_returns import is_static
from lightsim.core.resample import resize_area
from lightsim.core.sensors import LidarSweep

# Sensitivity of the alignment to these constants is not measured.

# Neighbours of a return that are examined, nearest in angle.
_NEIGHBOURS = 8
# Largest angle between neighbours, 0.7 degrees.
_NEIGHBOUR_RAD = 0.012
# Least depth jump of an edge: this constant in metres
_LEAST_JUMP_M = 0.5
# plus this fraction of the distance.
_LEAST_JUMP = 0.05
# Least ratio of the jump behind a return to the largest step in front of it. On a slanted surface,
# neighbours are as far in front of a return as others are behind it (ratio 1).
_LEAST_CONTRAST = 4.0
# Largest distance between the sensor origins of two neighbours on one silhouette.
_SENSOR_M = 0.3
# Nearest and farthest distance of a depth edge.
_RANGE_M = (3.0, 60.0)
# Returns of one sweep that are examined; bounds the time.
_QUERIES = 40_000


def depth_edges(
    sweep: LidarSweep, actors: tuple[ActorTrack, ...], rng: np.random.Generator
) -> Float64[np.ndarray, "n 3"]:
    """Return points on silhouettes of static surfaces, frame `world` (Levinson and Thrun 2013,
    doi:10.15607/RSS.2013.IX.029).

    Each point is at the distance of the near return, midway between the directions of the near and
    the far return: on average, a silhouette passes midway between two beams. Points on moving
    actors are excluded.
    """
    rays = sweep.points_world.astype(np.float64) - sweep.origins_world
    distance = np.linalg.norm(rays, axis=1)
    in_range = np.flatnonzero((distance > _RANGE_M[0]) & (distance < 2 * _RANGE_M[1]))
    if len(in_range) <= _NEIGHBOURS:
        return np.empty((0, 3))
    rays, distance = rays[in_range], distance[in_range]
    directions = rays / distance[:, None]
    # Twice the range above: the far side of an edge may lie beyond the farthest edge.
    queried = np.flatnonzero(distance < _RANGE_M[1])
    queried = rng.permutation(queried)[:_QUERIES]
    apart, near = KDTree(directions).query(directions[queried], k=_NEIGHBOURS + 1, workers=2)
    origins = sweep.origins_world[in_range].astype(np.float64)
    same_sensor = np.linalg.norm(origins[near] - origins[queried][:, None], axis=2) < _SENSOR_M
    own = distance[queried][:, None]
    beside = np.where(same_sensor & (apart < _NEIGHBOUR_RAD), distance[near], own) - own
    is_behind = beside > np.maximum(
        _LEAST_JUMP * own + _LEAST_JUMP_M, -_LEAST_CONTRAST * beside.min(axis=1, keepdims=True)
    )
    is_edge = is_behind.any(axis=1)
    rows = queried[is_edge]
    first = is_behind[is_edge].argmax(axis=1)
    other = np.take_along_axis(np.asarray(near)[is_edge], first[:, None], axis=1)[:, 0]
    middle = directions[rows] + directions[other]
    middle *= (distance[rows] / np.linalg.norm(middle, axis=1))[:, None]
    points = origins[rows] + middle
    return points[is_static(sweep, actors)[in_range][rows]]


def reduced_grey(
    srgb8: UInt8[np.ndarray, "h w 3"], height_px: int, width_px: int
) -> Float32[np.ndarray, "h2 w2"]:
    """Return the green channel, from 0 to 255, at another size."""
    grey = srgb8[..., 1:2].astype(np.float32)
    if grey.shape[:2] == (height_px, width_px):
        return grey[..., 0]
    return resize_area(grey, height_px, width_px)[..., 0].astype(np.float32)


def edge_strength(grey: Float32[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Return the gradient g of log intensity, compressed to g / (g + scale) between 0 and 1.

    The scale depends on the image's mean and its strongest gradient, so that compression does not
    flatten the maximum in the middle of an edge.
    """
    # The offset of 8 grey levels limits the noise of dark pixels.
    smooth = gaussian_filter(np.log(grey + 8.0), sigma_px)
    gradient = np.hypot(sobel(smooth, 0), sobel(smooth, 1))
    strongest = float(np.percentile(gradient[::2, ::2], 99.5))
    scale = max(3.0 * float(gradient.mean()), 0.5 * strongest, 1e-6)
    return (gradient / (gradient + scale)).astype(np.float32)


def sample(
    image: Float32[np.ndarray, "h w"], uv: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Return bilinear values at (u, v); the border's value outside the image, 0 at NaN."""
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
