"""A row of houses whose far end few beams reach."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.test_buildings import GROUND, NO_CROWNS, complete_walls, inputs_of

from lightsim.core.buildings import Wall
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.far_walls import find_far_walls
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.wall_cells import gather_cells
from lightsim.render.casters.embree import EmbreeCaster

# The front of a row along x, seen from the south; the mesh has its first 20 m.
ROW = Wall(
    np.array([0.0, 8.0, 0.0]),
    np.array([0.0, -1.0, 0.0]),
    np.array([1.0, 0.0, 0.0]),
    (0.0, 20.0),
    (0.0, 6.0),
)


def test_places_on_a_wall_and_back() -> None:
    s, z = ROW.grid(0.5, (40, 12))
    back, out = ROW.place(ROW.at(s, z, 0.7))
    np.testing.assert_allclose(back, s, atol=1e-12)
    np.testing.assert_allclose(out, 0.7, atol=1e-12)
    assert (s.min(), s.max(), z.min(), z.max()) == (0.25, 19.75, 0.25, 5.75)


def _mesh() -> TriMesh:
    points = np.array([[0, 8, 0], [24, 8, 0], [24, 8, 6], [0, 8, 6]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriMesh("world", points, faces, np.zeros_like(points))


def _on_row(rng: np.random.Generator, low_m: float, high_m: float, out_m: float) -> np.ndarray:
    count = int(20 * (high_m - low_m))
    z = rng.uniform(0.2, 6.0, count)
    y = 8.0 - out_m + 0.03 * rng.normal(size=count)
    return np.stack([rng.uniform(low_m, high_m, count), y, z], axis=1)


def _returns() -> np.ndarray:
    """On the front with a gap from 38 to 44 m behind which a side wall stands, on a house set back,
    and in a tree that stands before the row's far end."""
    rng = np.random.default_rng(0)
    parts = [_on_row(rng, 0, 38, 0.0), _on_row(rng, 44, 58, -0.2)]
    parts.append(rng.normal(size=(600, 3)) * [2.0, 1.2, 1.2] + [68.0, 7.5, 4.0])
    return np.concatenate(parts).astype(np.float32)


def test_walls_go_on_where_returns_lie_on_their_plane() -> None:
    found = find_far_walls([ROW], _returns(), GROUND, EmbreeCaster([_mesh()]))
    assert len(found) == 2
    near, far = sorted(found, key=lambda w: w.span_m[0])
    # The mesh has the row to 24 m, further than the plane was known.
    assert near.span_m == pytest.approx((24.0, 38.0), abs=1.2)
    assert far.span_m == pytest.approx((44.0, 58.0), abs=1.2)
    assert near.origin_m[1] == pytest.approx(8.0, abs=0.02)
    assert far.origin_m[1] == pytest.approx(8.2, abs=0.02)
    assert all(w.height_m == pytest.approx((-0.25, 6.0), abs=0.2) for w in found)


def test_narrow_walls_are_not_followed_and_nothing_comes_of_nothing() -> None:
    narrow = Wall(ROW.origin_m, ROW.normal, ROW.along, (0.0, 6.0), (0.0, 6.0))
    caster = EmbreeCaster([_mesh()])
    assert find_far_walls([narrow], _returns(), GROUND, caster) == []
    assert find_far_walls([ROW], np.zeros((0, 3), np.float32), GROUND, caster) == []


def test_returns_stand_for_the_measured_surface_of_far_walls() -> None:
    far = Wall(ROW.origin_m, ROW.normal, ROW.along, (30.0, 36.0), (0.0, 6.0))
    points = np.repeat(_on_row(np.random.default_rng(1), 30, 36, 0.0), 4, axis=0)
    scene = Scene(_mesh(), NO_CROWNS, [ROW], far_walls=[far])
    near, other = gather_cells(inputs_of([], [_sweep(points)]), scene)
    assert not near.is_far
    assert other.is_far
    np.testing.assert_array_equal(near.is_met, near.is_covered)
    assert other.measured_top.max() == pytest.approx(23, abs=1)
    assert not other.is_covered.any()


def _sweep(points: np.ndarray) -> LidarSweep:
    zero, none = np.zeros(len(points), np.float32), np.full(len(points), -1, np.int16)
    origins = np.tile(np.array([[10.0, 0.0, 1.8]], np.float32), (len(points), 1))
    return LidarSweep("0", 0, points.astype(np.float32), origins, zero, zero, none, none)


def test_each_house_of_a_far_row_stands_where_its_returns_lie() -> None:
    """One is set back by .2 m, the next stands .15 m out: once all stood on one plane."""
    rng = np.random.default_rng(2)
    points = np.concatenate([_on_row(rng, 30, 40, -0.2), _on_row(rng, 40, 50, 0.15)])
    sweep = _sweep(points)
    made = complete_walls(_mesh(), [], [sweep], walls=[ROW]).background
    at = np.stack([np.r_[31.6:38.6, 41.6:48.6], np.zeros(14), np.full(14, 1.1)], axis=1)
    way = np.tile([0.0, 1.0, 0.0], (14, 1))
    y = EmbreeCaster([made]).intersect(at, way).distance_m
    np.testing.assert_allclose(y, np.repeat([8.2, 7.85], 7), atol=0.06)
