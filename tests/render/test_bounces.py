"""Several bounces of light, linearity of every output, and all casters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from casters import CASTERS
from rendering_scenes import (
    box,
    camera,
    constant_sky,
    look_at,
    plane,
    random_sky,
    sphere,
    street,
    sun_sky,
)

from lightsim.core.dome import SkyDome
from lightsim.core.mesh import Material, Texture
from lightsim.errors import InputError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.kernels import fill_unlisted
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    exact,
    static_face_table,
    trace_transport,
)
from lightsim.render.transport.samples import render_samples
from lightsim.render.transport.sky import prepare_sky

_VIEW = look_at((0.0, -9.0, 5.0), (0.0, 0.0, 0.5))


def _integrating_sphere(albedo: float, opening_deg: float):
    ball = sphere((0, 0, 0), 1.0, 5, albedo)
    centres = ball.vertices[ball.faces].mean(axis=1)
    kept = centres[:, 2] / np.linalg.norm(centres, axis=1) < np.cos(np.radians(opening_deg))
    return replace(ball, faces=ball.faces[kept])


@pytest.mark.parametrize("bounces", [1, 2, 5, 40])
def test_light_in_an_integrating_sphere(bounces):
    """From anywhere on a sphere every part of it fills its fraction of the area in form factor:
    with
    an opening of share f, direct light is f, and every bounce adds a factor albedo x (1 - f)."""
    albedo, opening = 0.8, 60.0
    ball = _integrating_sphere(albedo, opening)
    fraction = (1 - np.cos(np.radians(opening))) / 2
    config = replace(exact(), bounces=bounces, sky_rays=256, face_rays=64)
    scene = without_actors(make_static_scene([ball]))
    view = look_at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), up=(0.0, 1.0, 0.0))
    gbuffers = render_gbuffers(scene, camera(32, 24, 20.0), view)
    table = trace_transport(scene, gbuffers, config)
    out = light(table, scene, gbuffers, constant_sky((1.0, 1.0, 1.0)), config)
    kept = albedo * (1 - fraction)
    expected = fraction * (1 - kept ** (bounces + 1)) / (1 - kept)
    assert out.shaded.mean() == pytest.approx(expected, rel=0.01)
    assert np.abs(out.shaded - expected).max() < 0.12 * expected


def test_a_shared_face_table_and_a_prepared_sky_change_nothing():
    config = replace(TransportConfig(), bounces=2)
    scene = without_actors(make_static_scene(street()))
    sky = sun_sky(1.0, 40.0, sky=0.3)
    gbuffers = render_gbuffers(scene, camera(), _VIEW)
    shared = static_face_table(scene, config)
    first = light(trace_transport(scene, gbuffers, config), scene, gbuffers, sky, config)
    for _ in range(2):
        table = trace_transport(scene, gbuffers, config, face_table=shared)
        again = light(table, scene, gbuffers, prepare_sky(sky), config)
        np.testing.assert_array_equal(again.shaded, first.shaded)
    once = replace(config, bounces=1)
    single = light(trace_transport(scene, gbuffers, once), scene, gbuffers, sky, once)
    assert (first.bounce >= single.bounce - 1e-6).all()
    assert first.bounce.mean() > 1.02 * single.bounce.mean()


def test_every_output_is_linear_in_the_sky(rng):
    first, second = random_sky(rng), random_sky(rng)
    both = SkyDome(first.radiance + second.radiance, None)
    car = replace(sphere((0.0, -1.0, 1.0), 1.0), materials=(Material(0.3, 0.5),))
    scene = without_actors(make_static_scene([plane(15.0, 30, 0.4), car]))
    config = TransportConfig(bounces=2, pixel_samples=4)
    gbuffers = render_gbuffers(scene, camera(), _VIEW)
    samples = render_samples(scene, camera(), _VIEW, gbuffers, config)
    table = trace_transport(scene, gbuffers, config, samples=samples)
    a, b, c = (light(table, scene, gbuffers, sky, config) for sky in (first, second, both))
    for name in ("sky", "bounce", "shaded", "unshadowed", "diffuse", "glossy"):
        total = getattr(a, name) + getattr(b, name)
        np.testing.assert_allclose(getattr(c, name), total, rtol=1e-4, atol=1e-6)
    assert c.glossy is not None
    assert c.glossy.max() > 0


@pytest.mark.parametrize("make_caster", CASTERS)
@pytest.mark.parametrize("azimuth_deg", [15.0, 130.0, 260.0])
def test_every_caster_throws_a_pole_s_shadow_away_from_the_sun(make_caster, azimuth_deg):
    azimuth = np.radians(azimuth_deg)
    meshes = [plane(20.0), box((0, 0, 2), (0.2, 0.2, 4))]
    above = look_at((0.0, 0.0, 30.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    scene = without_actors(make_static_scene(meshes, make_caster=make_caster))
    gbuffers = render_gbuffers(scene, camera(96, 96, 180.0), above)
    config = replace(exact(), sky_rays=4, face_rays=0)
    table = trace_transport(scene, gbuffers, config)
    out = light(table, scene, gbuffers, sun_sky(azimuth, 45.0), config)
    ground = gbuffers.has_surface & (np.abs(gbuffers.position_world[..., 2]) < 0.01)
    points = gbuffers.position_world[ground & (out.sun_visibility < 0.5)][:, :2]
    points = points[np.linalg.norm(points, axis=1) > 0.5]
    away = -np.array([np.cos(azimuth), np.sin(azimuth)])
    centre = points.mean(axis=0)
    assert centre @ away / np.linalg.norm(centre) > np.cos(np.radians(2.0))
    assert (points @ away).max() == pytest.approx(4.0, abs=0.3)


@pytest.mark.parametrize(("face_rays", "least"), [(1, 0.0), (16, 0.99)])
def test_a_white_furnace_never_gains_light(face_rays, least):
    """However many bounces, and though most faces are met by no ray of the table."""
    scene = without_actors(make_static_scene([_integrating_sphere(1.0, 60.0)]))
    config = TransportConfig(bounces=100, sky_rays=8, face_rays=face_rays)
    view = look_at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), up=(0.0, 1.0, 0.0))
    gbuffers = render_gbuffers(scene, camera(32, 24, 20.0), view)
    table = trace_transport(scene, gbuffers, config)
    out = light(table, scene, gbuffers, constant_sky((1.0, 1.0, 1.0)), config)
    seen = out.shaded[gbuffers.has_surface]
    assert seen.max() < 1 + 1e-5
    assert seen.mean() > least


def test_rays_that_meet_unlisted_faces_follow_the_others():
    rows = np.array(
        [[-2, 5, -1, -2, 7, -2], [-2, -2, -1, -1, -2, -2], [-1, -2, -1, 3, -2, -1]], np.int32
    )
    fill_unlisted(rows)
    np.testing.assert_array_equal(
        rows, [[7, 5, -1, 5, 7, 7], [-1, -1, -1, -1, -1, -1], [-1, 3, -1, 3, 3, -1]]
    )


def test_faces_have_the_mean_colour_of_their_texture():
    """Stripes that the colour of the vertices does not show."""
    ground = plane(2.0, 4, 0.9)
    image = np.zeros((64, 64, 3), np.float32)
    image[:, ::2] = (0.2, 0.4, 0.6)
    uv = ((ground.vertices[ground.faces][..., :2] + 2) * 16).astype(np.float32)
    textured = replace(ground, texture=Texture(image, uv))
    bare = replace(ground, base_colour=np.full_like(ground.base_colour, 0.3))
    scene = without_actors(make_static_scene([bare, textured]))
    table = static_face_table(scene, exact())
    sides = np.arange(0, 2 * table.face_count, 3)
    colour = table.samples(sides).base_colour
    is_textured = sides >= table.face_count
    np.testing.assert_allclose(colour[~is_textured], 0.3, rtol=1e-6)
    np.testing.assert_allclose(colour[is_textured].mean(axis=0), (0.1, 0.2, 0.3), rtol=0.1)
    assert colour[is_textured, 2].min() > 0


def test_no_bounces_are_refused():
    with pytest.raises(InputError, match="number of bounces is too small"):
        TransportConfig(bounces=0)
