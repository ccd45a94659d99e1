"""Marching cubes of analytic distances, and what happens at the edge of the known."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.fields import TsdfGrid
from lightsim.core.mesh import concatenate_meshes
from lightsim.geometry.surface import (
    drop_floaters,
    extract_surface,
    make_mesh,
    quad_mesh,
)

RADIUS_M = 3.9


def _sphere(voxel_m: float = 0.1, known_below_z: float = np.inf) -> TsdfGrid:
    """A sphere over more than two regions of blocks, centre (0.3, 0.2, 0.1)."""
    coords = np.argwhere(np.ones((12, 12, 12), dtype=bool)).astype(np.int32) - 3
    origin = np.full(3, -voxel_m * 8 * 3.0)
    empty = np.zeros((len(coords), 8, 8, 8), dtype=np.float32)
    grid = TsdfGrid("world", origin, voxel_m, 3 * voxel_m, coords, empty, empty)
    sdf, weight = np.zeros_like(empty), np.ones_like(empty)
    for b in range(len(coords)):
        points = grid.positions(b) - np.array([0.3, 0.2, 0.1])
        sdf[b] = np.clip(np.linalg.norm(points, axis=-1) - RADIUS_M, -0.3, 0.3)
        weight[b][points[..., 2] > known_below_z] = 0.0
    return TsdfGrid("world", origin, voxel_m, 3 * voxel_m, coords, sdf, weight)


def test_a_sphere_is_closed_round_and_faces_outwards() -> None:
    mesh = extract_surface(_sphere())
    centre = np.array([0.3, 0.2, 0.1])
    radius = np.linalg.norm(mesh.vertices - centre, axis=1)
    np.testing.assert_allclose(radius, RADIUS_M, atol=2e-3)
    edges = np.sort(
        np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]),
        axis=1,
    )
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    euler = len(mesh.vertices) - len(count) + len(mesh.faces)
    assert euler == 2
    outward = (mesh.vertices - centre) / RADIUS_M
    assert (mesh.vertex_normals() * outward).sum(axis=1).min() > 0.99
    assert float(mesh.face_areas_m2().sum()) == pytest.approx(4 * np.pi * RADIUS_M**2, rel=2e-3)


def test_no_triangle_reaches_into_the_unknown() -> None:
    mesh = extract_surface(_sphere(known_below_z=1.0))
    assert mesh.vertices[:, 2].max() <= 0.1 + 1.0 + 1e-5
    assert mesh.vertices[:, 2].max() > 0.1 + 1.0 - 0.2


def test_an_unobserved_grid_gives_an_empty_mesh() -> None:
    assert len(extract_surface(_sphere(), min_weight=2.0).faces) == 0


def test_floaters_go_and_large_pieces_stay() -> None:
    big = extract_surface(_sphere())
    crumb = make_mesh("world", big.vertices[:3] + 9.0, np.array([[0, 1, 2]]))
    both = concatenate_meshes([big, crumb])
    assert len(drop_floaters(both, 0.25).faces) == len(big.faces)


def test_quads_face_where_their_corners_turn_counter_clockwise() -> None:
    """Two faces a quad, and no corner that none uses."""
    corners = np.array([[9.0, 9, 9], [0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]])
    mesh = quad_mesh(corners, np.array([[1, 2, 3, 4]]))
    np.testing.assert_array_equal(mesh.vertices, corners[1:])
    np.testing.assert_array_equal(mesh.face_normals(), [[0, 0, 1]] * 2)
    assert mesh.face_areas_m2().sum() == 6
