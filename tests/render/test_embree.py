"""The Embree caster against brute force in float64."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.casting import MISS
from lightsim.core.mesh import TriMesh
from lightsim.errors import FrameMismatchError
from lightsim.render.casters.embree import make_embree_caster, offset_origins


def _soup(rng: np.random.Generator, faces: int, centre_m: float = 0.0) -> TriMesh:
    corners = rng.uniform(-5, 5, (faces, 1, 3)) + rng.uniform(-1, 1, (faces, 3, 3)) + centre_m
    vertices = corners.reshape(-1, 3).astype(np.float32)
    index = np.arange(3 * faces, dtype=np.int32).reshape(-1, 3)
    return TriMesh("world", vertices, index, np.full_like(vertices, 0.5))


def _empty() -> TriMesh:
    none = np.zeros((0, 3), np.float32)
    return TriMesh("world", none, np.zeros((0, 3), np.int32), none)


def _rays(rng: np.random.Generator, count: int):
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform(-6, 6, (count, 3)), directions


def _brute_force(meshes: list[TriMesh], origins: np.ndarray, directions: np.ndarray):
    """Nearest hit of every ray over all faces (Moeller and Trumbore 1997), in float64."""
    best = np.full(len(origins), np.inf)
    mesh_index = np.full(len(origins), MISS)
    face_index = np.full(len(origins), MISS)
    for k, mesh in enumerate(meshes):
        corners = mesh.vertices.astype(np.float64)[mesh.faces]
        for j, (a, b, c) in enumerate(corners):
            p = np.cross(directions, c - a)
            det = p @ (b - a)
            s = origins - a
            u = (s * p).sum(1) / det
            q = np.cross(s, b - a)
            v = (directions * q).sum(1) / det
            t = (q @ (c - a)) / det
            nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best)
            best[nearer], mesh_index[nearer], face_index[nearer] = t[nearer], k, j
    return best, mesh_index, face_index


def test_hits_equal_brute_force_and_rebuild_the_hit_point(rng):
    meshes = [_soup(rng, 40), _empty(), _soup(rng, 60)]
    caster = make_embree_caster(meshes)
    origins, directions = _rays(rng, 4000)
    hits = caster.intersect(origins, directions)
    distance, mesh_index, face_index = _brute_force(meshes, origins, directions)
    np.testing.assert_array_equal(hits.face_index, face_index)
    np.testing.assert_array_equal(hits.mesh_index, mesh_index)
    np.testing.assert_allclose(hits.distance_m, distance, rtol=1e-5, atol=2e-5)
    assert set(np.unique(mesh_index)) == {MISS, 0, 2}
    hit = np.flatnonzero(hits.is_hit)
    corners = np.stack(
        [
            meshes[m].vertices[meshes[m].faces[f]]
            for m, f in zip(mesh_index[hit], face_index[hit], strict=True)
        ]
    )
    rebuilt = (hits.barycentric[hit, :, None] * corners).sum(1)
    expected = origins[hit] + distance[hit, None] * directions[hit]
    np.testing.assert_allclose(rebuilt, expected, atol=5e-5)
    np.testing.assert_array_equal(hits.barycentric[~hits.is_hit], 0)


def test_occlusion_is_intersection(rng):
    caster = make_embree_caster([_soup(rng, 50)])
    origins, directions = _rays(rng, 300_000)
    hits = caster.intersect(origins, directions)
    np.testing.assert_array_equal(caster.is_occluded(origins, directions), hits.is_hit)


@pytest.mark.parametrize("meshes", [[], [_empty()]])
def test_no_faces_means_no_hits(rng, meshes):
    caster = make_embree_caster(meshes)
    origins, directions = _rays(rng, 10)
    hits = caster.intersect(origins, directions)
    assert not hits.is_hit.any()
    assert np.isinf(hits.distance_m).all()
    assert not caster.is_occluded(origins, directions).any()


def test_no_rays(rng):
    caster = make_embree_caster([_soup(rng, 3)])
    none = np.zeros((0, 3))
    assert len(caster.intersect(none, none).distance_m) == 0
    assert len(caster.is_occluded(none, none)) == 0


@pytest.mark.parametrize("centre_m", [0.0, 800.0])
def test_offset_origins_leave_their_own_surface(rng, centre_m):
    mesh = _soup(rng, 1, centre_m)
    weights = rng.dirichlet(np.ones(3), 5000)
    points = weights @ mesh.vertices[mesh.faces[0]].astype(np.float64)
    normals = np.repeat(mesh.face_normals(), 5000, axis=0)
    directions = normals + 0.99 * _rays(rng, 5000)[1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = offset_origins(points, normals)
    assert np.linalg.norm(origins - points, axis=1).max() < 2.1e-3
    assert not make_embree_caster([mesh]).is_occluded(origins, directions).any()


def test_a_mesh_in_another_frame_is_refused(rng):
    soup = _soup(rng, 1)
    actor = TriMesh("actor", soup.vertices, soup.faces, soup.base_colour)
    with pytest.raises(FrameMismatchError, match="world"):
        make_embree_caster([actor])
