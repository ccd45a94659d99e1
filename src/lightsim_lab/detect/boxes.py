"""Boxes in bird's-eye view: overlap, and average precision.

A box is a row (x, y, z, length, width, height, yaw) in a level frame, in metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

IOU_THRESHOLDS = (0.1, 0.3, 0.5)
"""Overlaps of a true detection, as in the paper."""
Detections = tuple[Float[np.ndarray, "n 7"], Float[np.ndarray, " n"]]
"""Boxes and scores of a picture, best first."""
# Distance around an ignored box within which cells and detections are ignored, in metres: a
# detection of its vehicle may be displaced by half a car. Sensitivity not measured.
_IGNORED_MARGIN_M = 1.0
# Tolerance of corners on an edge of the other box, relative to the coordinates.
_EDGE = 1e-9


def corners(boxes: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 4 2"]:
    """Return the corners in bird's-eye view, counter-clockwise."""
    signs = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    local = signs * boxes[:, None, 3:5]
    cosine, sine = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    turn = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], 1)
    return local @ turn + boxes[:, None, :2]


def overlaps(
    first: Float[np.ndarray, "n 7"], second: Float[np.ndarray, "m 7"]
) -> Float[np.ndarray, "n m"]:
    """Return the intersection over union of all pairs in bird's-eye view."""
    result = np.zeros((len(first), len(second)))
    gap = np.linalg.norm(first[:, None, :2] - second[None, :, :2], axis=-1)
    reach = (np.hypot(*first[:, 3:5].T)[:, None] + np.hypot(*second[:, 3:5].T)) / 2
    i, j = np.nonzero(gap < reach)
    if len(i):
        shared = _intersections(corners(first[i]), corners(second[j]))
        areas = first[i, 3] * first[i, 4] + second[j, 3] * second[j, 4]
        result[i, j] = shared / (areas - shared)
    return result


def _intersections(
    a: Float[np.ndarray, "k 4 2"], b: Float[np.ndarray, "k 4 2"]
) -> Float[np.ndarray, " k"]:
    """Return the areas of the intersections of pairs of convex quadrilaterals.

    Its corners are those of one polygon inside the other, and the crossings of edges; sorted by
    angle around their mean they form the intersection.
    """
    from_a, from_b = (np.roll(p, -1, axis=1) - p for p in (a, b))
    cross = _cross(from_a[:, :, None], from_b[:, None])
    apart = b[:, None] - a[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = _cross(apart, from_b[:, None]) / cross
        t = _cross(apart, from_a[:, :, None]) / cross
    is_crossing = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    crossings = a[:, :, None] + np.where(is_crossing, s, 0)[..., None] * from_a[:, :, None]
    points = np.concatenate([a, b, crossings.reshape(len(a), 16, 2)], axis=1)
    is_part = np.concatenate(
        [_inside(a, b), _inside(b, a), is_crossing.reshape(len(a), 16)], axis=1
    )
    count = np.maximum(is_part.sum(axis=1), 1)
    centre = (points * is_part[..., None]).sum(axis=1) / count[:, None]
    relative = points - centre[:, None]
    # Points that are no corners repeat the first corner, which adds no area.
    angle = np.where(is_part, np.arctan2(relative[..., 1], relative[..., 0]), np.inf)
    order = np.argsort(angle, axis=1)
    ring = np.take_along_axis(relative, order[..., None], axis=1)
    is_used = np.arange(24) < count[:, None]
    ring = np.where(is_used[..., None], ring, ring[:, :1])
    area = _cross(ring, np.roll(ring, -1, axis=1)).sum(axis=1) / 2
    return np.where(is_part.sum(axis=1) > 2, np.maximum(area, 0.0), 0.0)


def _cross(a: Float[np.ndarray, "*n 2"], b: Float[np.ndarray, "*m 2"]) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _inside(
    points: Float[np.ndarray, "k 4 2"], polygon: Float[np.ndarray, "k 4 2"]
) -> Bool[np.ndarray, "k 4"]:
    """Return whether each point lies in its counter-clockwise polygon, edges included."""
    edge = np.roll(polygon, -1, axis=1) - polygon
    side = _cross(edge[:, None], points[:, :, None] - polygon[:, None])
    return (side >= -_EDGE * (1 + np.abs(points).max())).all(axis=-1)


def is_ignored(
    places: Float[np.ndarray, "n 2"], boxes: Float[np.ndarray, "m 7"]
) -> Bool[np.ndarray, " n"]:
    """Return whether each point (x, y) lies within 1 m of an ignored box. Training ignores these
    cells, and tests ignore detections there that match no box."""
    relative = places[:, None] - boxes[None, :, :2]
    cosine, sine = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    along = np.abs(relative[..., 0] * cosine + relative[..., 1] * sine)
    across = np.abs(relative[..., 1] * cosine - relative[..., 0] * sine)
    half = boxes[:, 3:5] / 2 + _IGNORED_MARGIN_M
    return np.asarray(((along <= half[:, 0]) & (across <= half[:, 1])).any(axis=1))


@dataclass(frozen=True, eq=False)
class Matches:
    """Detections of a picture compared with the labelled boxes.

    Args:
        boxes, scores: detections, best score first.
        is_true: whether each matches a box, for each of `IOU_THRESHOLDS`.
        distance_m: to the matched box, else to the detection itself, likewise.
        is_counted: False for unmatched detections on ignored boxes, likewise.
        truth_distance_m: distance of every labelled box that counts.
    """

    boxes: Float[np.ndarray, "n 7"]
    scores: Float[np.ndarray, " n"]
    is_true: Bool[np.ndarray, "n t"]
    distance_m: Float[np.ndarray, "n t"]
    is_counted: Bool[np.ndarray, "n t"]
    truth_distance_m: Float[np.ndarray, " m"]


def match(
    found: Detections, truth: Float[np.ndarray, "m 7"], ignored: Float[np.ndarray, "k 7"]
) -> Matches:
    """Match the detections of one picture, best score first, each to the unmatched box of largest
    overlap."""
    detections, scores = found
    iou = overlaps(detections, truth)
    distance = np.hypot(*truth[:, :2].T)
    shape = (len(detections), len(IOU_THRESHOLDS))
    is_true, own = np.zeros(shape, bool), np.hypot(*detections[:, :2].T)
    distances = np.repeat(own[:, None], shape[1], axis=1)
    for k, threshold in enumerate(IOU_THRESHOLDS):
        is_free = np.ones(len(truth), bool)
        for i in range(len(detections) if len(truth) else 0):
            j = int(np.argmax(np.where(is_free, iou[i], -1.0)))
            if is_free[j] and iou[i, j] >= threshold:
                is_free[j] = False
                is_true[i, k], distances[i, k] = True, distance[j]
    is_counted = is_true | ~is_ignored(detections[:, :2], ignored)[:, None]
    return Matches(detections, scores, is_true, distances, is_counted, distance)


def average_precision(
    scores: Float[np.ndarray, " n"], is_true: Bool[np.ndarray, " n"], truth_count: int
) -> float:
    """Return the area under the precision envelope over all points of recall; NaN without truth."""
    if truth_count == 0:
        return float("nan")
    hits = is_true[np.argsort(-scores, kind="stable")]
    true = np.cumsum(hits)
    precision = true / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float((envelope * hits).sum() / truth_count)
