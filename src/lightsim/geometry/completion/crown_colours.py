"""Classify crowns by colour: beams scatter in leaves, but also in transformers and pipes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.foliage import GREENER, excess_green
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.silhouettes import (
    OBJECT_VIEW_M,
    ClassifiedView,
    View,
    classified_views,
)

# Tolerance of the occlusion test: surface this far before a point hides it, in metres. It is about
# the edge of a crown's voxel; not measured.
HIDDEN_M = 0.4
# Largest number of returns of a crown whose colours are read; more would cost time alone.
_MOST_RETURNS = 400


def is_green(crowns: Crowns, views: Iterable[View], caster: RayCaster) -> Bool[np.ndarray, " k"]:
    """Return whether each crown is greener than the images in which it is visible.

    The median excess green of a crown's returns decides. Crowns that no image shows count as green.

    Args:
        crowns: candidates.
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
    """Return pixels (column, row), unit directions, distances and rows of the points within a view
    and within `OBJECT_VIEW_M`."""
    frame, camera, _ = view
    way = points - frame.world_from_camera.translation_m
    distance = np.linalg.norm(way, axis=1)
    near = np.flatnonzero((distance < OBJECT_VIEW_M) & (distance > 0))
    uv, is_inside = frame.project(camera, points[near])
    row = near[is_inside]
    pixel = uv[is_inside].astype(np.int64).T
    return pixel, way[row] / distance[row][:, None], distance[row], row


def _some_of_each(number: Int64[np.ndarray, " r"]) -> Int64[np.ndarray, " s"]:
    """Return evenly spaced rows of each number, at most about `_MOST_RETURNS`."""
    rows = [np.flatnonzero(number == k) for k in np.unique(number)]
    return np.concatenate(
        [np.zeros(0, np.int64), *(own[:: -(-len(own) // _MOST_RETURNS)] for own in rows)]
    )
