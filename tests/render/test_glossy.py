"""Reflections against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, constant_sky, look_at, plane, sphere, sun_sky

from lightsim.core.dome import SkyDome
from lightsim.core.equirect import pixel_directions
from lightsim.core.mesh import Material
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.image import scene_image
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.glossy_kernels import reflected_rays
from lightsim.render.transport.light import light
from lightsim.render.transport.lobes import specular_lobe
from lightsim.render.transport.matrix import exact, trace_transport
from lightsim.render.transport.samples import render_samples

_VIEW = look_at((0.0, -6.0, 3.0), (0.0, 0.0, 0.0))


def _of(mesh, roughness, metallic=0.0, albedo=None):
    colour = mesh.base_colour if albedo is None else np.full_like(mesh.base_colour, albedo)
    return replace(mesh, materials=(Material(roughness, metallic),), base_colour=colour)


def _render(meshes, sky, config, view=_VIEW, lens=None):
    lens = lens or camera()
    scene = without_actors(make_static_scene(meshes))
    gbuffers = render_gbuffers(scene, lens, view)
    samples = render_samples(scene, lens, view, gbuffers, config)
    table = trace_transport(scene, gbuffers, config, samples=samples)
    return gbuffers, table, light(table, scene, gbuffers, sky, config)


def _smooth_sky(rows: int = 128) -> SkyDome:
    d = pixel_directions(rows)
    rgb = np.stack([1.0 + d[..., 0], 1.0 + d[..., 1], 1.5 + np.sin(3 * d[..., 2])], axis=-1)
    return SkyDome(rgb.astype(np.float32), None)


@pytest.mark.parametrize("count", [1, 4])
def test_a_mirror_shows_the_sky_in_the_reflected_direction(count):
    sky = _smooth_sky()
    config = replace(exact(), pixel_samples=count)
    gbuffers, _, out = _render([_of(plane(50.0), 0.0, 1.0, 1.0)], sky, config)
    seen = gbuffers.has_surface
    towards = gbuffers.position_world[seen] - _VIEW.translation_m
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    expected = sky.look_up(towards * np.array([1.0, 1.0, -1.0]))
    assert out.glossy is not None
    error = np.abs(out.glossy[seen] / expected - 1)
    assert np.quantile(error, 0.999) < 0.02
    assert error.mean() < 0.002
    assert out.diffuse is not None
    np.testing.assert_allclose(out.diffuse[seen], 0, atol=1e-6)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.5])
def test_white_furnace(roughness, metallic):
    """A white convex body in a constant sky: dielectrics give all light back, metals lose what
    the microfacets bounce among themselves."""
    body = _of(sphere((0, 0, 0), 1.5, 5), roughness, metallic, 1.0)
    gbuffers, _, out = _render([body], constant_sky((1.0, 1.0, 1.0)), exact())
    image = scene_image(gbuffers, out, np.zeros_like(out.shaded))[gbuffers.has_surface]
    assert image.max() <= 1 + 1e-4
    if metallic == 0:
        np.testing.assert_allclose(image, 1, rtol=1e-4)
    assert image.mean() > 0.85


def test_the_lobe_is_reciprocal_and_sampled_as_evaluated(rng):
    count = 400
    normals = np.tile(np.array([0.36, 0.48, 0.8], np.float32), (count, 1))
    alphas = rng.uniform(0.05, 0.6, count).astype(np.float32)

    def upper(n):
        v = rng.normal(size=(n, 3))
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        v *= np.sign(v @ normals[0])[:, None]
        v += 0.05 * normals[0]
        return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)

    a, b = upper(count), upper(count)
    there, back = specular_lobe(normals, a, b, alphas), specular_lobe(normals, b, a, alphas)
    cosine = [np.einsum("nc,nc->n", v, normals) for v in (a, b)]
    np.testing.assert_allclose(there[:, 0] / cosine[1], back[:, 0] / cosine[0], rtol=2e-3)
    np.testing.assert_allclose(there[:, 1], back[:, 1], rtol=1e-3, atol=1e-6)
    for view, alpha in zip(a[:4], (0.1, 0.2, 0.4, 0.6), strict=True):
        rays = 4096
        directions = np.empty((1, rays, 3), np.float32)
        weights = np.empty((1, rays, 2), np.float32)
        one = np.array([alpha], np.float32)
        reflected_rays(normals[:1], view[None], one, np.zeros((1, 2), np.float32),
                       (np.zeros(1, np.int64), 1, rays),
                       directions, weights)  # fmt: skip
        steps = pixel_directions(512).reshape(-1, 3).astype(np.float32)
        solid = (2 * np.pi**2 / 512**2 / 2 * np.sqrt(1 - steps[:, 2] ** 2)).astype(np.float32)
        lobe = specular_lobe(
            np.tile(normals[:1], (len(steps), 1)), np.tile(view, (len(steps), 1)), steps,
            np.full(len(steps), alpha, np.float32),
        )  # fmt: skip
        total = float((lobe[:, 0] * solid).sum())
        np.testing.assert_allclose(weights.sum(axis=2).mean(), total, rtol=0.01)
        mean = (lobe[:, :1] * solid[:, None] * steps).sum(axis=0)
        sampled = (weights.sum(axis=2)[..., None] * directions)[0].mean(axis=0)
        np.testing.assert_allclose(sampled, mean, atol=0.01)


def test_the_sun_is_reflected_where_nothing_stands_before_it():
    floor = _of(plane(20.0), 0.3)
    towards = look_at((0.0, -6.0, 3.0), (0.0, 0.0, 0.0))
    sky = sun_sky(np.pi / 2, np.degrees(np.arctan2(3.0, 6.0)))
    gbuffers, _, out = _render([floor], sky, exact(), towards, camera(65, 49))
    assert out.glossy is not None
    brightest = np.unravel_index(out.glossy[..., 0].argmax(), out.glossy.shape[:2])
    np.testing.assert_allclose(gbuffers.position_world[brightest], 0.0, atol=1.2)
    wall = box((0.0, 10.0, 10.0), (40.0, 0.2, 20.0), 0.0)
    _, _, dark = _render([floor, wall], sky, exact(), towards, camera(65, 49))
    assert dark.glossy is not None
    ground = np.abs(gbuffers.position_world[..., 2]) < 0.01
    assert dark.glossy[ground].max() < 1e-3 * out.glossy.max()


def test_a_mirror_shows_the_lit_wall_behind_it():
    wall = box((0.0, 8.0, 50.0), (300.0, 0.2, 100.0), (0.8, 0.4, 0.2))
    mirror = _of(plane(5.0), 0.0, 1.0, 1.0)
    sky = sun_sky(-np.pi / 2, 30.0)
    low = look_at((0.0, -3.0, 1.0), (0.0, 0.0, 0.0))
    gbuffers, _, out = _render([mirror, wall], sky, exact(), low)
    ground = (np.abs(gbuffers.position_world[..., 2]) < 0.01) & gbuffers.has_surface
    expected = np.array([0.8, 0.4, 0.2]) * np.cos(np.radians(30.0))
    assert out.glossy is not None
    middle = np.median(out.glossy[ground], axis=0)
    np.testing.assert_allclose(middle, expected, rtol=0.03)


def test_reflections_are_no_part_of_the_shading():
    sky = _smooth_sky()
    meshes = [_of(plane(10.0), 0.1), _of(sphere((0, 0, 1), 1.0), 0.1)]
    _, _, with_rays = _render(meshes, sky, exact())
    _, _, without = _render(meshes, sky, replace(exact(), glossy_rays=0))
    np.testing.assert_array_equal(with_rays.shaded, without.shaded)
    np.testing.assert_array_equal(with_rays.ratio, without.ratio)
    assert without.glossy is None
