"""Polygons as triangles: convex, concave, tilted, and hostile ones in bounded time."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightsim.store.polygons import triangulate


def comb(teeth: int) -> list[tuple[float, float]]:
    """A strip with narrow teeth: no corner sees all others."""
    top = [(x + 0.3 * (n % 2), 3.0 if n % 4 in (1, 2) else 1.0) for n, x in
           enumerate(np.linspace(10, 0, 4 * teeth))]  # fmt: skip
    return [(0.0, 0.0), (10.3, 0.0), *top]


SHAPES = {
    "triangle": [(0, 0), (2, 0), (0, 1)],
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "arrow": [(0, 0), (2, 1), (0, 2), (1, 1)],
    "arrow, first corner convex": [(2, 1), (0, 2), (1, 1), (0, 0)],
    "L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)],
    "S": [(0, 0), (3, 0), (3, 2), (1, 2), (1, 3), (3, 3), (3, 4), (0, 4), (0, 1),
          (2, 1), (2, 0.5), (0, 0.5)],
    "comb": comb(12),
    "ring with a bridge": [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2),
                           (2, 1), (1, 1)],
    "with corners on an edge": [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (0, 1)],
}  # fmt: skip


def area(corners: np.ndarray) -> float:
    """The area with sign, and half the sum of cross products is it for any polygon."""
    x, y = corners.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


@pytest.mark.parametrize("turned_over", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_triangles_cover_a_polygon_once_and_keep_its_side(name: str, turned_over: bool) -> None:
    flat = np.array(SHAPES[name], np.float64)
    if turned_over:
        flat = flat[::-1]
    turn = Rotation.from_rotvec([0.4, -1.1, 0.8]).as_matrix()
    points = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1) @ turn.T + 5.0
    triangles, polygon, n_approximated = triangulate(points, np.array([len(flat)]))
    assert len(triangles) == len(flat) - 2
    assert n_approximated == 0
    assert (polygon == 0).all()
    areas = np.array([area(flat[corners]) for corners in triangles])
    # Of one sign and together the whole: nothing is covered twice, nothing is left out.
    assert (areas * np.sign(area(flat)) >= -1e-9).all()
    assert areas.sum() == pytest.approx(area(flat))


def test_polygons_of_a_file_keep_their_numbers() -> None:
    shapes = [np.array(SHAPES[name], np.float64) for name in ("L", "triangle", "arrow", "comb")]
    points = np.concatenate([np.pad(shape, ((0, 0), (0, 1))) for shape in shapes])
    counts = np.array([len(shapes[0]), 3, 2, 4, len(shapes[3])])
    points = np.insert(points, 9, [[7.0, 7, 7], [8, 8, 8]], axis=0)
    triangles, polygon, _ = triangulate(points, counts)
    for number, shape in zip((0, 1, 3, 4), shapes, strict=True):
        corners = triangles[polygon == number]
        total = sum(area(points[c, :2]) for c in corners)
        assert total == pytest.approx(area(shape))
    assert not (polygon == 2).any()


@pytest.mark.parametrize("n_corners", [50, 3000])
def test_polygons_that_cross_themselves_end_in_bounded_time(
    n_corners: int, rng: np.random.Generator
) -> None:
    points = rng.normal(size=(n_corners, 3))
    start = time.perf_counter()
    triangles, _, n_approximated = triangulate(points, np.array([n_corners]))
    assert time.perf_counter() - start < 20
    assert len(triangles) == n_corners - 2
    assert n_approximated == 1
