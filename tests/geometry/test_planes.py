"""Walls of known plane, span and height among pieces of surface."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.geometry.completion.planes import Pieces, walls_among

# A wall through (3, 4) that faces 30 degrees left of -y, from s = 0 to 12 m and up to 5 m.
NORMAL = np.array([-np.sin(np.radians(30.0)), -np.cos(np.radians(30.0))])
ALONG, ORIGIN = np.array([-NORMAL[1], NORMAL[0]]), np.array([3.0, 4.0])


def _returns(spans_m: list[tuple[float, float]], per_m2: float = 8.0) -> Pieces:
    """Returns on parts of the wall with 2 cm of noise and normals that err by 5 degrees."""
    rng = np.random.default_rng(0)
    length = sum(high - low for low, high in spans_m)
    s = np.concatenate(
        [rng.uniform(low, high, int(5.0 * per_m2 * (high - low))) for low, high in spans_m]
    )
    out, angle = 0.02 * rng.normal(size=len(s)), np.radians(30.0 + 5.0 * rng.normal(size=len(s)))
    xy = ORIGIN + s[:, None] * ALONG + out[:, None] * NORMAL
    points = np.column_stack([xy, rng.uniform(0.0, 5.0, len(s))])
    area = np.full(len(s), 5.0 * length / len(s))
    return Pieces(points[:, None], np.stack([-np.sin(angle), -np.cos(angle)], axis=1), area)


def _clutter() -> Pieces:
    """Leaves of a crown beside the wall, with as much surface."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(600, 3)) * [2.0, 2.0, 1.5] + [-4.0, -6.0, 4.0]
    angle = rng.uniform(0.0, 2 * np.pi, 600)
    return Pieces(
        points[:, None], np.stack([np.cos(angle), np.sin(angle)], axis=1), np.full(600, 0.1)
    )


def test_a_wall_is_found_to_centimetres_beside_foliage() -> None:
    parts = _returns([(0.0, 12.0)]), _clutter()
    columns = [(p.corners, p.normal, p.area_m2) for p in parts]
    (wall,) = walls_among(Pieces(*(np.concatenate(c) for c in zip(*columns, strict=True))))
    assert wall.normal[:2] == pytest.approx(NORMAL, abs=0.005)
    ends = wall.at(np.array(wall.span_m), np.zeros(2))[:, :2]
    np.testing.assert_allclose(ends, [ORIGIN, ORIGIN + 12.0 * ALONG], atol=0.1)
    np.testing.assert_allclose((ends - ORIGIN) @ NORMAL, 0.0, atol=0.02)
    assert wall.height_m == pytest.approx((0.0, 5.0), abs=0.1)


@pytest.mark.parametrize(("gap_m", "count"), [(2.5, 1), (3.5, 2)])
def test_wide_gaps_separate_the_walls_of_one_plane(gap_m: float, count: int) -> None:
    walls = list(walls_among(_returns([(0.0, 8.0), (8.0 + gap_m, 16.0)])))
    assert len(walls) == count
    ends = np.concatenate([wall.at(np.array(wall.span_m), np.zeros(2)) for wall in walls])
    s = np.sort((ends[:, :2] - ORIGIN) @ ALONG)
    np.testing.assert_allclose(s[[0, -1]], [0.0, 16.0], atol=0.1)


@pytest.mark.parametrize("span_m", [(0.0, 1.5), (0.0, 0.9)])
def test_narrow_surfaces_are_no_walls(span_m: tuple[float, float]) -> None:
    assert list(walls_among(_returns([span_m]))) == []


def test_surface_with_holes_everywhere_is_no_wall() -> None:
    whole = _returns([(0.0, 12.0)])
    assert list(walls_among(Pieces(whole.corners, whole.normal, 0.2 * whole.area_m2))) == []
    assert list(walls_among(_clutter())) == []
