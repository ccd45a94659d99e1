"""Fewer faces and calmer normals, on surfaces whose shape is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.fields import TsdfGrid
from lightsim.core.mesh import Material, Provenance, TriMesh
from lightsim.geometry.simplify import denoise, simplify
from lightsim.geometry.surface import extract_surface, make_mesh

SIDE_M = 3.0


def _box(noise_m: float = 0.0) -> TriMesh:
    """Marching cubes of a cube of 3 m, with noise on its distances."""
    voxel = 0.1
    coords = np.argwhere(np.ones((6, 6, 6), dtype=bool)).astype(np.int32)
    origin = np.full(3, -voxel * (8 * 6 - 1) / 2)
    empty = np.zeros((len(coords), 8, 8, 8), dtype=np.float32)
    grid = TsdfGrid("world", origin, voxel, 0.3, coords, empty, empty)
    rng = np.random.default_rng(0)
    sdf = np.stack(
        [
            np.abs(grid.positions(b)).max(axis=-1)
            - SIDE_M / 2
            + noise_m * rng.standard_normal((8, 8, 8))
            for b in range(len(coords))
        ]
    ).astype(np.float32)
    weight = np.ones_like(sdf)
    return extract_surface(TsdfGrid("world", origin, voxel, 0.3, coords, sdf, weight))


def _edge_counts(mesh: TriMesh) -> np.ndarray:
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def _simplified(mesh: TriMesh, error_m: float = 0.01, edge_m: float = 0.6) -> TriMesh:
    n = len(mesh.vertices)
    return simplify(mesh, np.full(n, error_m), np.full(n, edge_m))


def test_a_closed_surface_stays_closed_in_place_and_gets_light() -> None:
    mesh = _box()
    small = _simplified(mesh)
    assert len(small.faces) < 0.1 * len(mesh.faces)
    assert (_edge_counts(small) == 2).all()
    assert np.abs(np.abs(small.vertices).max(axis=1) - SIDE_M / 2).max() < 0.02
    outward = (small.face_normals() * small.vertices[small.faces].mean(axis=1)).sum(axis=1)
    assert outward.min() > 0
    edges = small.vertices[small.faces] - small.vertices[np.roll(small.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() <= 0.6 + 1e-6


def test_borders_and_material_lines_keep_their_course() -> None:
    n = 41
    x, y = np.meshgrid(*[np.linspace(0, 4, n)] * 2, indexing="ij")
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    flat = make_mesh("world", points, faces)
    right = (flat.vertices[flat.faces].mean(axis=1)[:, 0] > 1.7).astype(np.uint8)
    materials = (Material(name="left"), Material(name="right"))
    mesh = TriMesh("world", flat.vertices, flat.faces, flat.base_colour, materials, right)
    small = _simplified(mesh, edge_m=1.0)
    assert len(small.faces) < 0.1 * len(mesh.faces)
    assert small.face_material is not None
    area = small.face_areas_m2()
    assert float(area[small.face_material == 0].sum()) == pytest.approx(1.7 * 4, rel=1e-3)
    assert float(area.sum()) == pytest.approx(16.0, rel=1e-4)
    is_upper = flat.vertices[flat.faces].mean(axis=1)[:, 1] > 2.3
    provenance = np.where(is_upper, Provenance.INFERRED, Provenance.MEASURED).astype(np.uint8)
    mixed = _simplified(replace(mesh, face_provenance=provenance), edge_m=1.0)
    area = mixed.face_areas_m2()
    assert mixed.face_material is not None
    for is_right, part in ((False, 1.7), (True, 2.3)):
        found = (mixed.face_material == is_right) & mixed.has_provenance(Provenance.INFERRED)
        assert float(area[found].sum()) == pytest.approx(part * 1.7, rel=1e-3)


def test_normals_of_flat_parts_become_calm_and_edges_stay() -> None:
    mesh = _box(noise_m=0.015)
    smooth_planes = denoise(mesh, 0.05)

    def off_axis_deg(m: TriMesh) -> np.ndarray:
        inner = np.sort(np.abs(m.vertices[m.faces].mean(axis=1)), axis=1)[:, 1] < 1.2
        return np.degrees(np.arccos(np.clip(np.abs(m.face_normals()[inner]).max(axis=1), 0, 1)))

    assert off_axis_deg(smooth_planes).mean() < 0.35 * off_axis_deg(mesh).mean()
    assert np.linalg.norm(smooth_planes.vertices - mesh.vertices, axis=1).max() <= 0.05 + 1e-6
    corner = np.sort(np.abs(smooth_planes.vertices), axis=1)
    at_edge = corner[:, 1] > 1.44
    assert np.abs(corner[at_edge, 1:] - SIDE_M / 2).mean() < 0.04
