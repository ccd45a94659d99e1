"""Overlaps and average precision against hand-made cases."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim_lab.detect.boxes import (
    IOU_THRESHOLDS,
    average_precision,
    corners,
    is_ignored,
    match,
    overlaps,
)


def box(x: float, y: float, length: float = 4.0, width: float = 2.0, yaw: float = 0.0) -> list:
    return [x, y, 0.0, length, width, 1.5, yaw]


def boxes(*rows: list) -> np.ndarray:
    return np.array(rows, dtype=float).reshape(-1, 7)


NONE = boxes()
RANGES = ((-1, 1, 3), (1, 4, 3), (-4, 4, 1))


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # Two squares at 45 degrees share a regular octagon.
        (box(9, 3, 2, 2), box(9, 3, 2, 2, np.pi / 4), 1 / np.sqrt(2)),
        (box(9, 3, 2, 2, 0.3), box(9, 3, 2, 2, 0.3 + np.pi / 4), 1 / np.sqrt(2)),
        (box(0, 0), box(2, 0), 1 / 3),
        (box(0, 0), box(0, 0, 2, 4, np.pi / 2), 1.0),
        (box(0, 0), box(0, 0), 1.0),
        (box(0, 0), box(0, 0, 1, 1, 1.0), 1 / 8),
        (box(0, 0), box(4, 0), 0.0),
        (box(0, 0), box(50, 0), 0.0),
    ],
)
def test_overlaps_of_known_boxes(first: list, second: list, expected: float) -> None:
    both = boxes(first, second)
    assert overlaps(both[:1], both[1:]) == pytest.approx(expected, abs=1e-9)
    assert overlaps(both[1:], both[:1]) == pytest.approx(expected, abs=1e-9)


def test_overlaps_agree_with_counted_points(rng: np.random.Generator) -> None:
    first, second = (
        np.column_stack([rng.uniform(low, high, (40, n)) for low, high, n in RANGES])
        for _ in range(2)
    )
    points = rng.uniform(-4, 4, (100_000, 2))

    def contains(one: np.ndarray) -> np.ndarray:
        cosine, sine = np.cos(one[6]), np.sin(one[6])
        local = (points - one[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
        return np.asarray((np.abs(local) <= one[3:5] / 2).all(axis=1))

    found = np.diag(overlaps(first, second))
    for one, other, value in zip(first, second, found, strict=True):
        a, b = contains(one), contains(other)
        assert value == pytest.approx((a & b).sum() / (a | b).sum(), abs=0.03)
    assert found.max() > 0.3


def test_corners_turn_counter_clockwise() -> None:
    (found,) = corners(boxes(box(10, 0, 4, 2, np.pi / 2)))
    assert found == pytest.approx(np.array([[9, 2], [9, -2], [11, -2], [11, 2]]))


def test_a_hit_a_duplicate_and_a_miss() -> None:
    truth = boxes(box(10, 0), box(30, 5))
    detections = boxes(box(10, 0), box(10.2, 0), box(50, 0), box(30, 5))
    found = match((detections, np.array([0.9, 0.8, 0.7, 0.6])), truth, NONE)
    assert found.is_true[:, 1].tolist() == [True, False, False, True]
    assert found.distance_m[3, 0] == pytest.approx(np.hypot(30, 5))
    assert found.distance_m[2, 0] == 50
    # Precision is 1 at the first box, and 2 of 4 at the second.
    assert average_precision(found.scores, found.is_true[:, 1], 2) == pytest.approx((1 + 0.5) / 2)
    # A box that is never found has precision 0.
    assert average_precision(found.scores, found.is_true[:, 1], 4) == pytest.approx((1 + 0.5) / 4)
    assert np.isnan(average_precision(found.scores, found.is_true[:, 1], 0))


def test_precision_is_the_envelope_over_larger_recall() -> None:
    is_true = np.array([False, True, True])
    scores = np.array([0.9, 0.8, 0.7])
    assert average_precision(scores, is_true, 2) == pytest.approx(2 / 3)


def test_thresholds_decide_by_overlap() -> None:
    # Shifted by 2 of 4 metres: overlap 1/3.
    found = match((boxes(box(12, 0)), np.array([0.5])), boxes(box(10, 0)), NONE)
    assert found.is_true.tolist() == [[t <= 1 / 3 for t in IOU_THRESHOLDS]]


def test_the_best_overlap_wins_not_the_first_box() -> None:
    truth = boxes(box(11, 0), box(10, 0))
    found = match((boxes(box(10, 0), box(11, 0)), np.array([0.9, 0.8])), truth, NONE)
    assert found.is_true.all()


def test_detections_on_ignored_boxes_do_not_count_unless_they_match() -> None:
    ignored = boxes(box(20, 0))
    detections = boxes(box(20, 0), box(20, 1.9), box(20, 2.1), box(10, 0))
    found = match((detections, np.array([0.9, 0.8, 0.7, 0.6])), boxes(box(10, 0)), ignored)
    assert found.is_counted[:, 0].tolist() == [False, False, True, True]
    # A box that has to be detected may stand on an ignored one.
    found = match((boxes(box(20, 0)), np.array([0.9])), ignored, ignored)
    assert found.is_counted.all()
    assert found.is_true.all()


def test_the_margin_of_ignored_boxes_turns_with_them() -> None:
    places = np.array([[10.0, 2.9], [10.0, 3.1], [11.9, 0.0], [12.1, 0.0]])
    turned = boxes(box(10, 0, 4, 2, np.pi / 2))
    assert is_ignored(places, turned).tolist() == [True, False, True, False]
    assert not is_ignored(places, NONE).any()
