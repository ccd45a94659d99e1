"""The memory of intrinsic decomposition follows what was measured, not how far the scene
reaches."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.appearance.plane_mesh import plane_mesh

from lightsim.appearance.atlas import (
    choose_resolution,
    edge_lengths_m,
    pack,
    texel_parts,
    texels_of,
)
from lightsim.appearance.intrinsic import surfels as intrinsic_surfels
from lightsim.appearance.intrinsic.decompose import (
    Decomposition,
    IntrinsicConfig,
    SurfaceLight,
    decompose,
)
from lightsim.appearance.intrinsic.light import ObservedPoints
from lightsim.appearance.intrinsic.shadow_pairs import space_blocks
from lightsim.appearance.intrinsic.surfels import connect, make_surfels
from lightsim.core.mesh import Provenance, Texture, TriMesh, concatenate_meshes

_MOST_BYTES_A_SURFEL = 700
"""Grows with the measured surface: surfels, their pairs, and parts that wait to be joined."""


def _peak_bytes(task: Callable[[], object]) -> int:
    """Greatest sum of what `task` allocates at a time, numpy's arrays included."""
    tracemalloc.start()
    try:
        task()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _half_light(seen: ObservedPoints) -> SurfaceLight:
    """Sun where x is positive."""
    points = seen.position
    visibility = np.repeat((points[:, :1] > 0).astype(np.float32), 2, axis=1)
    white = np.ones((len(points), 3), np.float32)
    return SurfaceLight(white, visibility, 0.3 * white, 0 * white, 0 * white)


def _street() -> TriMesh:
    """Grey ground under that light."""
    mesh = plane_mesh(8.0, 0.5)
    light = 0.3 + (mesh.vertices[:, :1] > 0)
    return replace(mesh, base_colour=np.repeat(0.2 * light, 3, axis=1).astype(np.float32))


def _far_field() -> TriMesh:
    mesh = plane_mesh(60.0, 4.0, z=-1.0)
    mesh = replace(mesh, base_colour=np.full_like(mesh.vertices, 0.13))
    return mesh.with_provenance(Provenance.BACKGROUND_PROXY)


def test_a_far_field_costs_no_more_than_its_vertices_and_keeps_the_rendered_light():
    near, far = _street(), _far_field()
    scene = concatenate_meshes([near, far])
    rng = np.random.default_rng(0)
    alone = _peak_bytes(lambda: decompose(near, _half_light, IntrinsicConfig(), rng))
    done: list[Decomposition] = []
    both = _peak_bytes(lambda: done.append(decompose(scene, _half_light, IntrinsicConfig(), rng)))
    assert both < alone + 2000 * len(far.vertices)
    count = len(near.vertices)
    np.testing.assert_array_equal(done[0].visibility[count:], far.vertices[:, 0] > 0)
    middle = np.abs(near.vertices[:, 0]) < 1.0
    is_lit = near.vertices[:, 0] > 0
    np.testing.assert_allclose(done[0].visibility[:count][~middle], is_lit[~middle], atol=0.05)


def test_surfels_and_their_pairs_take_a_bounded_number_of_bytes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(intrinsic_surfels, "_CHUNK", 1 << 12)
    monkeypatch.setattr(intrinsic_surfels, "_CHUNK_SURFELS", 1 << 9)

    def made(side_m: float) -> tuple[int, int]:
        mesh, rng = plane_mesh(side_m, side_m / 20), np.random.default_rng(0)
        count = 0

        def task() -> None:
            nonlocal count
            surfels = make_surfels(mesh, np.arange(len(mesh.faces)), 0.25, rng)
            graph = connect(surfels, 3.0, rng)
            count = len(surfels)
            assert len(graph.pairs) > 5 * count

        return _peak_bytes(task), count

    small, large = made(12.0), made(36.0)
    assert (large[0] - small[0]) / (large[1] - small[1]) < _MOST_BYTES_A_SURFEL


def test_blocks_are_those_of_unique_rows(rng: np.random.Generator):
    position = rng.uniform(-30, 30, (2000, 3))
    rows = np.floor(position / 4.0)
    slow = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    fast = np.unique(space_blocks(position, 4.0), return_inverse=True)[1].ravel()
    np.testing.assert_array_equal(fast, slow)


def test_every_pair_is_named_once_and_lies_on_one_surface(rng: np.random.Generator):
    upper, lower = plane_mesh(6.0, 0.5, z=0.5), plane_mesh(6.0, 0.5)
    mesh = concatenate_meshes([upper, lower])
    surfels = make_surfels(mesh, np.arange(len(mesh.faces)), 0.25, rng)
    first, second = connect(surfels, 3.0, rng).pairs.T
    assert (first < second).all()
    assert len(np.unique(first * np.int64(len(surfels)) + second)) == len(first)
    np.testing.assert_allclose(surfels.position[first, 2], surfels.position[second, 2], atol=1e-6)
    nearest = np.linalg.norm(surfels.position[:, None] - surfels.position, axis=2)
    np.fill_diagonal(nearest, np.inf)
    named = set(zip(first.tolist(), second.tolist(), strict=True))
    asked = enumerate(nearest.argmin(axis=1).tolist())
    assert all((min(i, j), max(i, j)) in named for i, j in asked)


def test_parts_of_a_texture_are_all_of_its_texels():
    mesh = plane_mesh(4.0, 0.5)
    edges = edge_lengths_m(mesh.vertices, mesh.faces)
    footprint = np.linspace(0.02, 0.6, len(mesh.faces)).astype(np.float32)
    patches = pack(choose_resolution(edges, footprint, 0.02, 64, 1 << 20), edges)
    image = np.zeros((patches.height_px, patches.width_px, 3), np.float32)
    whole = texels_of(patches)
    parts = list(texel_parts(Texture(image, patches.corner_uv()), 500))
    assert len(parts) > 5
    for name, expected in vars(whole).items():
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in parts]), expected
        )
