"""A side wall above a low roof, which few beams meet, among wires and a tree."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.test_buildings import GROUND, NO_CROWNS, WIDE, _views

from lightsim.core.buildings import Wall
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.geometry.completion.crowns import Beams
from lightsim.geometry.completion.sparse_walls import find_sparse_walls
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.surface import quad_mesh
from lightsim.render.casters.embree import EmbreeCaster

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
        is_met = np.isfinite(distance) & (distance < 80)
        ends.append((origin + distance[:, None] * way)[is_met])
        origins.append(origin[is_met])
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
    return find_sparse_walls(known, beams, ViewEvidence(views), NO_CROWNS, GROUND, caster)


def test_the_side_wall_is_found_and_faces_the_road() -> None:
    (wall,) = _found(with_side=True)
    np.testing.assert_allclose(wall.normal, [-1, 0, 0], atol=0.01)
    np.testing.assert_allclose(np.cross(wall.along, [0, 0, 1]), wall.normal, atol=1e-6)
    ends = wall.at(np.array(wall.span_m), np.zeros(2))
    np.testing.assert_allclose(ends[:, 0], SIDE_M, atol=0.1)
    assert sorted(ends[:, 1]) == pytest.approx([FRONT_M, 20.0], abs=1.2)
    # It does not reach the ground: the low roof before it does.
    assert wall.height_m == pytest.approx((LOW_M, HIGH_M), abs=0.7)


def test_a_wall_goes_on_to_the_corner() -> None:
    """The front that is known ends half a metre beside it."""
    axes = (np.array([0, -1.0, 0]), np.array([1.0, 0, 0]))
    front = Wall(np.array([0.0, FRONT_M, 0.0]), *axes, (SIDE_M + 0.5, 60.0), (0.0, LOW_M))
    (wall,) = _found(with_side=True, known=(front,))
    ends = wall.at(np.array(wall.span_m), np.zeros(2))
    assert ends[:, 1].min() == pytest.approx(FRONT_M, abs=0.02)


def test_wires_and_trees_are_no_walls_nor_what_is_known() -> None:
    assert _found(with_side=False) == []
    plane = (np.array([SIDE_M, 0.0, 0.0]), np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]))
    assert _found(with_side=True, known=(Wall(*plane, (-25.0, 0.0), (0.0, 9.0)),)) == []
    nothing = Beams(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    caster = EmbreeCaster([_scene(with_side=False)])
    assert find_sparse_walls([], nothing, ViewEvidence([]), NO_CROWNS, GROUND, caster) == []
