"""Gains, the colour of what nobody saw, and the removal of light, with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from plane_mesh import plane_mesh

from lightsim.appearance import colour
from lightsim.appearance.colour import fill_unseen
from lightsim.appearance.gains import solve_gains
from lightsim.appearance.intrinsic.divide import base_colour_from_radiance
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError


def test_cameras_without_overlap_keep_gain_one() -> None:
    colours = np.full((100, 2, 3), 0.3, dtype=np.float32)
    colours[50:] = 0.6
    cameras = np.zeros((100, 2), dtype=np.int16)
    cameras[50:] = 1
    places = np.arange(100)
    gains = solve_gains(colours, np.ones((100, 2), np.float32), cameras, places, 2)
    np.testing.assert_allclose(gains, 1.0, atol=1e-6)


@pytest.mark.parametrize(("place_count", "shrinkage"), [(1, 10 / 19), (800, 1.0)])
def test_gains_are_pulled_to_one_by_few_common_places(place_count: int, shrinkage: float) -> None:
    """Two cameras whose pictures differ by 10 % in blue at 800 texels, of one place or of 800.

    Without spread the variance of n places is 4 x .15^2 / (4 + n) / n, and the posterior of the
    white balance is the ratio / (1 + variance / 2 x .1^2).
    """
    colours = np.full((800, 2, 3), 0.3, dtype=np.float32)
    colours[:, 1, 2] *= 1.1
    cameras = np.tile(np.array([0, 1], np.int16), (800, 1))
    places = np.arange(800) % place_count
    gains = solve_gains(colours, np.ones((800, 2), np.float32), cameras, places, 2)
    ratio = np.log(gains[1] / gains[0])
    balance = ratio[2] - ratio.mean()
    assert balance == pytest.approx(2 / 3 * np.log(1.1) * shrinkage, rel=0.01)
    assert ratio[0] == pytest.approx(ratio[1], abs=1e-6)


def test_unseen_vertices_take_the_colour_around_them() -> None:
    plane = plane_mesh(4.0, 0.2)
    colour = (0.4 + 0.05 * plane.vertices[:, :1] * np.ones(3)).astype(np.float32)
    is_known = np.linalg.norm(plane.vertices, axis=1) > 0.7
    holed = np.where(is_known[:, None], colour, 0).astype(np.float32)
    filled = fill_unseen(plane, holed, is_known, np.zeros(3, np.float32))
    np.testing.assert_allclose(filled, colour, atol=0.02)
    usual = np.array([0.1, 0.2, 0.3], dtype=np.float32)
    nothing = fill_unseen(plane, holed, np.zeros(len(holed), dtype=bool), usual)
    np.testing.assert_array_equal(nothing, np.broadcast_to(usual, nothing.shape))


def test_filled_colours_stay_within_the_known_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles of very uneven size, and an iteration that ends early as it does on large meshes: a
    base colour of 1.02 broke a build."""
    monkeypatch.setattr(colour, "_MAX_ITERATIONS", 2)
    plane = plane_mesh(4.0, 0.2)
    vertices = plane.vertices.copy()
    vertices[:, 0] **= 3
    uneven = TriMesh("world", vertices, plane.faces, plane.base_colour)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        known = np.where(rng.random((len(vertices), 1)) < 0.2, 0.95, 0.02) * np.ones(3)
        is_known = rng.random(len(known)) < 0.03
        filled = fill_unseen(uneven, known, is_known, np.ones(3))
        assert filled.min() > 0.02 - 1e-6
        assert filled.max() < 0.95 + 1e-6


def test_colours_hardly_pass_around_corners() -> None:
    """Grey ground, a red wall on it, and a hole in the ground up to the wall."""
    flat = plane_mesh(4.0, 0.2)
    x, y = flat.vertices[:, 0], flat.vertices[:, 1]
    bent = np.stack([np.minimum(x, 0.0), y, np.maximum(x, 0.0)], axis=1).astype(np.float32)
    mesh = TriMesh("world", bent, flat.faces, flat.base_colour)
    colour = np.where((x > 1e-6)[:, None], [0.5, 0.1, 0.1], [0.2, 0.2, 0.2])
    is_known = (x > 0.1) | (np.abs(y) > 1.0) | (x < -1.0)
    filled = fill_unseen(mesh, np.where(is_known[:, None], colour, 0.0), is_known, np.ones(3))
    ground = x < -0.1
    np.testing.assert_allclose(filled[ground], colour[ground], atol=0.02)


def test_baked_shadows_disappear() -> None:
    """A pole's shadow at a quarter of the light: albedo ratio 4 before, under 1.2 after, with
    the shadow edge two vertices off."""
    plane = plane_mesh(10.0, 0.1)
    x, y = plane.vertices[:, 0], plane.vertices[:, 1]
    albedo = (0.3 + 0.1 * np.sin(3 * y))[:, None] * np.array([1.0, 0.9, 0.8])
    is_shadow = (np.abs(x) < 1.0) & (y > -2)
    assumed = (np.abs(x - 0.2) < 1.0) & (y > -2)
    light = np.where(is_shadow, 0.25, 1.0)[:, None] * np.array([1.0, 1.0, 1.1])
    source = np.where(assumed, 0.25, 1.0)[:, None] * np.array([1.0, 1.0, 1.1])
    baked = TriMesh("world", plane.vertices, plane.faces, (albedo * light).astype(np.float32))
    result = base_colour_from_radiance(baked, source.astype(np.float32))
    inside, outside = (np.abs(x) < 1.0) & (y > -1.8), (np.abs(x) > 1.5) & (y > -1.8)
    truth = albedo[outside].mean() / albedo[inside].mean()
    before = baked.base_colour[outside].mean() / baked.base_colour[inside].mean()
    after = result.base_colour[outside].mean() / result.base_colour[inside].mean()
    assert before / truth > 3.8
    assert 1 / 1.2 < after / truth < 1.2
    wrong = np.abs(result.base_colour - albedo).max(axis=1) > 0.1
    assert float(wrong.mean()) < 0.01


def test_light_must_fit_the_mesh() -> None:
    plane = plane_mesh(1.0, 0.5)
    with pytest.raises(InputError, match="every vertex"):
        base_colour_from_radiance(plane, np.ones((2, 3), np.float32))
    dark = np.zeros((len(plane.vertices), 3), np.float32)
    result = base_colour_from_radiance(plane, dark)
    assert np.isfinite(result.base_colour).all()
    assert result.base_colour.min() >= np.float32(0.02)
