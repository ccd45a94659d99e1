"""Whether crowns are green: beams scatter alike in leaves, in transformers on a mast, in pipes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.foliage import GREENER, excess_green
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views

# Views from further away do not count.
_MAX_VIEW_M = 60.0
HIDDEN_M = 0.4
"""What stands this far before a place hides it."""
# Returns of a crown that are looked at, at most.
_MOST_RETURNS = 400


def is_green(crowns: Crowns, views: Iterable[View], caster: RayCaster) -> Bool[np.ndarray, " k"]:
    """Which crowns are greener than the pictures that they are in, by the median of what their
    returns look like; those that no picture shows are, too. What a build leaves out its notes tell.

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
        own = excess_green(frame.load_srgb8())[pixel[1], pixel[0]]
        for k in np.unique(number[row[is_seen]]):
            found[k].append(own[is_seen & (number[row] == k)])
    medians = [np.median(np.concatenate(own)) if own else np.inf for own in found]
    return np.array(medians, np.float64) > GREENER


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
