"""Whether crowns are green: beams scatter alike in leaves, in transformers on a mast, in pipes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.colour import linear_from_srgb8
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views

# Views from further away do not count.
_MAX_VIEW_M = 60.0
HIDDEN_M = 0.4
"""What stands this far before a place hides it."""
# Octaves by which leaves are greener than their pictures. Chosen while looking at log 002, where it
# parts trees from all else; what a build leaves out is in its notes.
_LEAST_GREEN = 0.15
_DARKEST = 1e-3
# Pixels of a picture between those that tell how green it is; returns of a crown, at most.
_STEP_PX, _MOST_RETURNS = 7, 400


def is_green(crowns: Crowns, views: Iterable[View], caster: RayCaster) -> Bool[np.ndarray, " k"]:
    """Which crowns are greener than the pictures that they are in, by the median of what their
    returns look like; those that no picture shows are, too.

    Green is told by log2(green / sqrt(red blue)), the excess green of Woebbecke et al. 1995
    (doi:10.13031/2013.27838) free of exposure.

    Args:
        views: frames with their camera (of the matte's size) and sky matte.
        caster: over the measured background.

    Raises:
        InputError: a matte does not fit its camera.
    """
    number = np.repeat(crowns.crown, np.diff(crowns.first_return))
    rows = _some_of_each(number)
    points, number = crowns.returns_m[rows], number[rows]
    found: list[list[np.ndarray]] = [[] for _ in range(len(crowns))]
    for view in classified_views(views) if len(rows) else ():
        frame, eye = view[0], view[0].world_from_camera.translation_m
        pixel, way, distance, row = towards_points(view, points)
        if not len(row):
            continue
        hits = caster.intersect(np.broadcast_to(eye, way.shape).copy(), way)
        is_seen = hits.distance_m > distance - HIDDEN_M
        green = _greenness(frame.load_srgb8())
        usual = np.median(green[::_STEP_PX, ::_STEP_PX])
        own = green[pixel[1], pixel[0]] - usual
        for k in np.unique(number[row[is_seen]]):
            found[k].append(own[is_seen & (number[row] == k)])
    medians = [np.median(np.concatenate(own)) if own else np.inf for own in found]
    return np.array(medians, np.float64) > _LEAST_GREEN


def towards_points(
    view: ClassifiedView, points: Float64[np.ndarray, "n 3"]
) -> tuple[
    Int64[np.ndarray, "2 m"],
    Float64[np.ndarray, "m 3"],
    Float64[np.ndarray, " m"],
    Int64[np.ndarray, " m"],
]:
    """Column and row of the points within a view and near, their directions and distances, and
    which they are."""
    frame, camera, _ = view
    way = points - frame.world_from_camera.translation_m
    distance = np.linalg.norm(way, axis=1)
    near = np.flatnonzero((distance < _MAX_VIEW_M) & (distance > 0))
    uv, is_inside = frame.project(camera, points[near])
    row = near[is_inside]
    pixel = uv[is_inside].astype(np.int64).T
    return pixel, way[row] / distance[row][:, None], distance[row], row


def _some_of_each(number: Int64[np.ndarray, " r"]) -> Int64[np.ndarray, " s"]:
    """Evenly spread rows of each number."""
    rows = [np.flatnonzero(number == k) for k in np.unique(number)]
    return np.concatenate(
        [np.zeros(0, np.int64), *(own[:: -(-len(own) // _MOST_RETURNS)] for own in rows)]
    )


def _greenness(srgb8: np.ndarray) -> Float64[np.ndarray, "h w"]:
    light = np.log2(linear_from_srgb8(srgb8).astype(np.float64) + _DARKEST)
    return light[..., 1] - 0.5 * (light[..., 0] + light[..., 2])
