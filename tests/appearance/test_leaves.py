"""Leaves of a crown are of one colour, whatever a picture shows between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim.appearance.intrinsic.decompose import IntrinsicConfig, mesh_surfels
from lightsim.appearance.intrinsic.leaves import leaf_colours, leaf_vertices
from lightsim.core.mesh import Material, TriMesh, concatenate_meshes


def _quads(middle: np.ndarray, size_m: float) -> TriMesh:
    corner = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size_m / 2
    vertices = (middle[:, None] + corner).reshape(-1, 3).astype(np.float32)
    first = 4 * np.arange(len(middle))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]).astype(np.int32)
    leaves = (Material(0.7, 0.0, "vegetation"),)
    return TriMesh("world", vertices, faces, np.zeros_like(vertices), leaves)


def _wall() -> TriMesh:
    x, z = np.meshgrid(np.arange(4.0), np.arange(4.0), indexing="ij")
    vertices = np.stack([x, 0 * x + 3.0, z], axis=-1).reshape(-1, 3).astype(np.float32)
    low = (4 * np.arange(3)[:, None] + np.arange(3)).reshape(-1, 1)
    faces = np.concatenate([low + [0, 4, 5], low + [0, 5, 1]]).astype(np.int32)
    return TriMesh("world", vertices, faces, np.zeros_like(vertices))


def test_colours_of_leaves_are_those_around() -> None:
    rng = np.random.default_rng(0)
    near, far = rng.random((100, 3)), rng.random((30, 3)) + [40.0, 0.0, 0.0]
    mesh = concatenate_meshes([_wall(), _quads(near, 0.1), _quads(far, 0.1)])
    is_leaf = leaf_vertices(mesh)
    np.testing.assert_array_equal(is_leaf, np.arange(len(is_leaf)) >= 16)
    billboards = replace(_quads(near, 5.0), materials=(Material(0.8, 0.0, "matte"),))
    assert not leaf_vertices(billboards).any()
    colour = np.tile([0.05, 0.1, 0.03], (len(is_leaf), 1))
    colour[:16] = 0.5
    # A third of the leaves show the wall behind; of the far crown nothing was seen.
    shows_wall = is_leaf & (rng.random(len(is_leaf)) < 0.3)
    colour[shows_wall] = 0.5
    is_seen = mesh.vertices[:, 0] < 20.0
    colour[~is_seen] = 0.9
    fill = leaf_colours(mesh, colour, is_leaf, is_seen)
    np.testing.assert_allclose(fill[is_leaf], np.tile([0.05, 0.1, 0.03], (520, 1)))
    np.testing.assert_array_equal(fill[:16], colour[:16])


def test_leaves_tell_nothing_of_shadows() -> None:
    """Patches, which carry labels, lie on the wall alone."""
    rng = np.random.default_rng(0)
    wall = _wall()
    mesh = concatenate_meshes([wall, _quads(rng.random((300, 3)), 0.2)])
    patches = mesh_surfels(mesh, IntrinsicConfig(), rng)
    assert patches is not None
    assert patches.surfels.position[:, 1].min() > 2.9


def test_a_street_without_leaves_keeps_its_colours() -> None:
    mesh = _wall()
    colour = np.full((16, 3), 0.4)
    fill = leaf_colours(mesh, colour, leaf_vertices(mesh), np.ones(16, bool))
    np.testing.assert_array_equal(fill, colour)
