"""Patches of texels: nothing overlaps, nothing foreign is read, budgets hold."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.appearance.atlas import (
    choose_resolution,
    pack,
    patches_of,
    texel_count,
    texels_of,
)
from lightsim.core.mesh import Texture


@pytest.fixture
def resolution(rng: np.random.Generator) -> np.ndarray:
    return rng.choice([0, 1, 2, 3, 5, 8, 32], 500).astype(np.int32)


def _texture(resolution: np.ndarray, rng: np.random.Generator) -> Texture:
    edges = rng.random((len(resolution), 3)).astype(np.float32)
    patches = pack(resolution, edges)
    image = np.zeros((patches.height_px, patches.width_px, 3), np.float32)
    return Texture(image, patches.corner_uv())


def test_patches_do_not_overlap_and_fill_the_image(
    resolution: np.ndarray, rng: np.random.Generator
) -> None:
    texture = _texture(resolution, rng)
    texels = texels_of(patches_of(texture))
    assert len(np.unique(texels.pixel)) == len(texels.pixel) == texel_count(resolution).sum()
    height, width = texture.image.shape[:2]
    assert texels.pixel.max() < height * width
    assert len(texels.pixel) > 0.85 * height * width
    assert 0.7 < height / width < 1.4
    np.testing.assert_allclose(texels.barycentric.sum(axis=1), 1.0, atol=1e-6)


def test_patches_are_found_again_from_the_corners(
    resolution: np.ndarray, rng: np.random.Generator
) -> None:
    edges = rng.random((len(resolution), 3)).astype(np.float32)
    patches = pack(resolution, edges)
    image = np.zeros((patches.height_px, patches.width_px, 3), np.float32)
    again = texels_of(patches_of(Texture(image, patches.corner_uv())))
    direct = texels_of(patches)
    np.testing.assert_array_equal(again.pixel, direct.pixel)
    single = resolution[direct.face] == 0
    np.testing.assert_array_equal(again.barycentric[~single], direct.barycentric[~single])


def test_look_up_is_linear_inside_a_face_and_reads_nothing_foreign(
    resolution: np.ndarray, rng: np.random.Generator
) -> None:
    """Each face has its own linear colour; what lies between patches is far off."""
    texture = _texture(resolution, rng)
    texels = texels_of(patches_of(texture))
    slopes = rng.random((len(resolution), 3, 3)).astype(np.float32)
    poison = np.full((texture.image.shape[0] * texture.image.shape[1], 3), 10.0, np.float32)
    poison[texels.pixel] = (texels.barycentric[:, :, None] * slopes[texels.face]).sum(axis=1)
    texture = Texture(poison.reshape(texture.image.shape), texture.corner_uv)
    face = rng.integers(0, len(resolution), 20000)
    barycentric = rng.dirichlet([0.5, 0.5, 0.5], 20000)
    barycentric[:3000] = np.eye(3)[rng.integers(0, 3, 3000)]
    found = texture.look_up(face, barycentric)
    expected = (barycentric[:, :, None] * slopes[face]).sum(axis=1)
    flat = resolution[face] == 0
    np.testing.assert_allclose(found[~flat], expected[~flat], atol=1e-3)
    np.testing.assert_allclose(found[flat], slopes[face[flat]].mean(axis=1), atol=1e-3)


def test_the_budget_holds(rng: np.random.Generator) -> None:
    edges = rng.uniform(0.05, 1.0, (4000, 3)).astype(np.float32)
    footprint = rng.uniform(0.01, 0.1, 4000).astype(np.float32)
    footprint[:500] = np.inf
    free = choose_resolution(edges, footprint, 0.01, 32, 10**9)
    assert free.max() == 32
    assert free[:500].max() == 1
    tight = choose_resolution(edges, footprint, 0.01, 32, 100_000)
    assert 95_000 < texel_count(tight).sum() <= 100_000
    assert (tight <= free).all()
    nothing = choose_resolution(edges[:0], footprint[:0], 0.01, 32, 10)
    assert len(nothing) == 0
    empty = pack(nothing, edges[:0])
    assert texels_of(empty).pixel.shape == (0,)
