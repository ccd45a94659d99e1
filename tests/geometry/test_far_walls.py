"""Walls that few beams reach: the far end of a row, and a side above a low roof, among wires and a
tree."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.test_buildings import GROUND, NO_CROWNS, WIDE, _views, complete_walls, inputs_of

from lightsim.core.buildings import Wall
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.crowns import Beams
from lightsim.geometry.completion.far_walls import find_far_walls
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.completion.wall_cells import gather_cells
from lightsim.geometry.surface import quad_mesh
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


def _from_road(ends: np.ndarray) -> Beams:
    return Beams(np.broadcast_to(np.array([10.0, 0.0, 1.8], np.float32), ends.shape).copy(), ends)


def _found_beside_row(known: list[Wall], ends: np.ndarray) -> list[Wall]:
    caster = EmbreeCaster([_mesh()])
    return find_far_walls(known, _from_road(ends), ViewEvidence([]), NO_CROWNS, GROUND, caster)


@pytest.mark.parametrize("known", [[ROW], []])
def test_walls_go_on_where_returns_lie_on_their_plane(known: list[Wall]) -> None:
    found = _found_beside_row(known, _returns())
    assert len(found) == 2
    near, far = sorted(found, key=lambda w: w.at(np.array(w.span_m), np.zeros(2))[:, 0].mean())
    for wall, ends_m, y_m in ((near, (24.0, 38.0), 8.0), (far, (44.0, 58.0), 8.2)):
        np.testing.assert_allclose(wall.normal, [0.0, -1.0, 0.0], atol=0.01)
        ends = wall.at(np.array(wall.span_m), np.zeros(2))
        # The mesh has the row to 24 m, further than the plane was known.
        assert ends[:, 0] == pytest.approx(ends_m, abs=0.8)
        # The fronts differ by 0.2 m, as much as the thickness of a plane, which may fit both.
        np.testing.assert_allclose(ends[:, 1], y_m, atol=0.1)
        assert wall.height_m == pytest.approx((-0.25, 6.0), abs=0.2)


def test_nothing_comes_of_nothing() -> None:
    assert _found_beside_row([ROW], np.zeros((0, 3), np.float32)) == []


def test_returns_stand_for_the_measured_surface_of_far_walls() -> None:
    far = Wall(ROW.origin_m, ROW.normal, ROW.along, (30.0, 36.0), (0.0, 6.0))
    points = np.repeat(_on_row(np.random.default_rng(1), 30, 36, 0.0), 4, axis=0)
    scene = Scene(_mesh(), NO_CROWNS, [ROW], far_walls=[far])
    near, other = gather_cells(inputs_of([], [_sweep(points)]), scene)
    assert not near.is_far
    assert other.is_far
    np.testing.assert_array_equal(near.is_measured, near.is_covered)
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


# x = 30, seen from the west; the street runs along x at y = 0, its front stands at y = 9.
SIDE_M, FRONT_M = 30.0, 9.0
LOW_M, HIGH_M = 4.0, 9.0


def _scene(*, with_side: bool) -> TriMesh:
    ground = [[-20, -20, 0], [60, -20, 0], [60, FRONT_M, 0], [-20, FRONT_M, 0]]
    front = [[60, FRONT_M, 0], [-20, FRONT_M, 0], [-20, FRONT_M, LOW_M], [60, FRONT_M, LOW_M]]
    side = [[SIDE_M, FRONT_M, LOW_M], [SIDE_M, 20, LOW_M], [SIDE_M, 20, HIGH_M]]
    parts = [ground, front] + ([[*side, [SIDE_M, FRONT_M, HIGH_M]]] if with_side else [])
    return concatenate_meshes([quad_mesh(np.array(p, float), np.arange(4)[None]) for p in parts])


def _beams(*, with_side: bool) -> Beams:
    """Rings of a sensor that drives 12 m, high ones 2 degrees apart; where wires hang, one beam of
    six ends on them; a tree scatters others."""
    rng = np.random.default_rng(0)
    caster = EmbreeCaster([_scene(with_side=with_side)])
    ends, origins = [], []
    for x_m in np.arange(-4.0, 10.0, 1.5):
        azimuth, elevation = np.meshgrid(
            np.radians(np.arange(0, 360, 0.8)),
            np.radians(np.r_[np.arange(-15, 3, 1.0), 4:16:2] + rng.uniform(-0.3, 0.3)),
        )
        azimuth, elevation = azimuth.ravel(), elevation.ravel()
        way = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
             np.sin(elevation)], axis=1,
        )  # fmt: skip
        origin = np.broadcast_to([x_m, 0.0, 1.8], way.shape)
        hits = caster.intersect(origin.copy(), way)
        distance = np.where(hits.is_hit, hits.distance_m, np.nan)
        # Wires over y = 5: z between 5 and 8.
        to_wires = 5.0 / np.where(way[:, 1] > 1e-3, way[:, 1], np.nan)
        z = 1.8 + to_wires * way[:, 2]
        is_wire = (z > 5) & (z < 8) & (rng.random(len(z)) < 1 / 6)
        distance = np.where(is_wire & ~(distance < to_wires), to_wires, distance)
        is_measured = np.isfinite(distance) & (distance < 80)
        ends.append((origin + distance[:, None] * way)[is_measured])
        origins.append(origin[is_measured])
    tree = rng.normal(size=(1200, 3)) * [1.2, 1.2, 1.2] + [5.0, -8.0, 5.0]
    ends.append(tree)
    origins.append(np.broadcast_to([0.0, 0.0, 1.8], tree.shape))
    noise = 0.02 * rng.standard_normal((sum(map(len, ends)), 3))
    return Beams(
        np.concatenate(origins).astype(np.float32),
        (np.concatenate(ends) + noise).astype(np.float32),
    )


def _found(*, with_side: bool, known: tuple[Wall, ...] = ()) -> list[Wall]:
    caster = EmbreeCaster([_scene(with_side=False)])
    views, beams = _views(_scene(with_side=with_side), WIDE), _beams(with_side=with_side)
    return find_far_walls(known, beams, ViewEvidence(views), NO_CROWNS, GROUND, caster)


def test_the_side_wall_is_found_and_faces_the_road() -> None:
    (wall,) = _found(with_side=True)
    np.testing.assert_allclose(wall.normal, [-1, 0, 0], atol=0.01)
    np.testing.assert_allclose(np.cross(wall.along, [0, 0, 1]), wall.normal, atol=1e-6)
    ends = wall.at(np.array(wall.span_m), np.zeros(2))
    np.testing.assert_allclose(ends[:, 0], SIDE_M, atol=0.05)
    assert sorted(ends[:, 1]) == pytest.approx([FRONT_M, 20.0], abs=0.6)
    # It does not reach the ground: the low roof before it does.
    assert wall.height_m == pytest.approx((LOW_M, HIGH_M), abs=0.7)


def test_wires_and_trees_are_no_walls_nor_what_is_known() -> None:
    assert _found(with_side=False) == []
    plane = (np.array([SIDE_M, 0.0, 0.0]), np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]))
    assert _found(with_side=True, known=(Wall(*plane, (-25.0, 0.0), (0.0, 9.0)),)) == []
