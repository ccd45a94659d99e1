"""Colours of a vehicle's unseen parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim.appearance.intrinsic.bodies import body_colours
from lightsim.appearance.intrinsic.panes import pane_colours, pane_vertices
from lightsim.core.mesh import Material, TriMesh


def test_the_unseen_side_takes_the_other_sides_colours_part_by_part() -> None:
    """Two side walls along x at y = +-1: red ahead, blue behind, the upper half a dark pane."""
    x, z = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(0, 1, 11), indexing="ij")
    walls = [np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1) for y in (1.0, -1.0)]
    cell = np.arange(20)[:, None] * 11 + np.arange(10)
    a = cell.ravel()
    faces = np.concatenate([np.stack([a, a + 11, a + 1], 1), np.stack([a + 1, a + 11, a + 12], 1)])
    vertices = np.concatenate(walls).astype(np.float32)
    mesh = TriMesh(
        "actor",
        vertices,
        np.concatenate([faces, faces + x.size]).astype(np.int32),
        np.zeros_like(vertices),
    )
    is_pane = mesh.vertices[mesh.faces][:, :, 2].min(axis=1) > 0.49
    mesh = replace(
        mesh,
        materials=(Material(0.3, 0.0, "paint"), Material(0.05, 0.0, "pane")),
        face_material=is_pane.astype(np.uint8),
    )
    is_glass = vertices[:, 2] > 0.51
    paint = np.where(vertices[:, :1] > 0, [[0.8, 0.1, 0.1]], [[0.1, 0.1, 0.8]])
    true = np.where(is_glass[:, None], 0.03, paint)
    is_seen = vertices[:, 1] > 0
    wrong = np.where(is_seen[:, None], true, 0.5)
    with_reflections = is_seen & is_glass & (vertices[:, 0] > 0)
    filled, is_filled = body_colours(mesh, np.where(with_reflections[:, None], 0.4, wrong), is_seen)
    np.testing.assert_array_equal(is_filled, ~is_seen | is_glass)
    np.testing.assert_allclose(filled[is_seen], true[is_seen], atol=1e-6)
    clear = ~is_seen & (np.abs(vertices[:, 0]) > 0.5)
    np.testing.assert_allclose(filled[clear], true[clear], atol=0.02)
    np.testing.assert_allclose(filled[~is_seen & is_glass], 0.03, atol=1e-6)
    nothing, is_filled = body_colours(mesh, wrong, np.zeros(len(vertices), dtype=bool))
    np.testing.assert_array_equal(nothing, wrong)
    assert not is_filled.any()


def test_each_pane_of_a_wall_has_its_own_dark_colour() -> None:
    """A wall with three panes: a dark one half of which mirrors the sky, a curtain, one unseen."""
    square = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0, 1], [0, 0, 1]], np.float32)
    strips = np.array([[0, 0, 0], [0.4, 0, 0], [2, 0, 0], [2.4, 0, 0], [4, 0, 0], [9, 0, 0]])
    vertices = (square + strips[:, None]).reshape(-1, 3).astype(np.float32)
    # The second strip shares an edge with the first, and the fourth with the third.
    joined = np.array([[4, 7], [12, 15]])
    vertices[joined] = vertices[[[1, 2], [9, 10]]]
    index = np.arange(24)
    index[joined] = [[1, 2], [9, 10]]
    quads = index.reshape(6, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    is_glass = np.tile([True, True, True, True, True, False], 2)
    mesh = TriMesh(
        "world",
        vertices,
        faces,
        np.zeros_like(vertices),
        (Material(0.8), Material(0.05, 0.0, "glass")),
        is_glass.astype(np.uint8),
    )
    is_pane = pane_vertices(mesh)
    np.testing.assert_array_equal(np.flatnonzero(~is_pane), [4, 7, 12, 15, *range(20, 24)])
    colour = np.repeat([[0.05], [0.4], [0.3], [0.3], [0.9], [0.6]], 4, axis=0) * np.ones(3)
    is_seen = np.repeat([True, True, True, True, False, True], 4)
    found = pane_colours(mesh, colour, is_pane, is_seen)[:, 0]
    np.testing.assert_allclose(found[[0, 3, 5, 6]], 0.05)
    np.testing.assert_allclose(found[[8, 13]], 0.3)
    # Of the unseen one, the percentile over all panes.
    np.testing.assert_allclose(found[16:20], 0.05, atol=0.05)
    np.testing.assert_array_equal(found[20:], 0.6)
