"""The light transport matrix against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import (
    box,
    camera,
    constant_sky,
    look_at,
    plane,
    sphere,
    street,
    sun_sky,
)

from lightsim.core.dome import split_sun
from lightsim.core.frames import RigidTransform
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    exact,
    trace_transport,
)

_VIEW = look_at((0.0, -9.0, 5.0), (0.0, 0.0, 0.5))


def _render(meshes, sky, config=None, view=_VIEW, size=(64, 48)):
    config = config or exact()
    scene = without_actors(make_static_scene(meshes))
    gbuffers = render_gbuffers(scene, camera(*size), view)
    table = trace_transport(scene, gbuffers, config)
    return gbuffers, table, light(table, scene, gbuffers, sky, config)


@pytest.mark.parametrize("config", [exact(), TransportConfig()])
def test_an_open_surface_under_a_constant_sky_shows_its_radiance(config):
    sky = constant_sky()
    gbuffers, table, out = _render([sphere((0, 0, 0), 2.0)], sky, config)
    seen = gbuffers.has_surface
    expected = np.broadcast_to(sky.radiance[0, 0], out.shaded[seen].shape)
    np.testing.assert_allclose(out.shaded[seen], expected, rtol=1e-5)
    np.testing.assert_allclose(out.unshadowed[seen], expected, rtol=1e-5)
    np.testing.assert_allclose(out.ratio, 1.0, rtol=1e-6)
    np.testing.assert_allclose(table.ambient_occlusion, 1.0, rtol=1e-6)
    assert seen.any()
    np.testing.assert_array_equal(out.shaded[~seen], 0)


def test_white_furnace():
    """Inside a constant sky, white surfaces give back in the bounce what they block of the sky,
    except for what their own surroundings block."""
    meshes = [replace(m, base_colour=np.ones_like(m.base_colour)) for m in street()]
    gbuffers, _, out = _render(meshes, constant_sky((1.0, 1.0, 1.0)))
    seen = gbuffers.has_surface
    assert out.shaded[seen].max() <= 1 + 1e-5
    np.testing.assert_allclose(out.unshadowed[seen], 1, rtol=1e-5)
    assert 0.96 < out.shaded[seen].mean() <= 1.0
    assert out.sky[seen].mean() < 0.93


def test_sun_follows_the_cosine_law_and_split_sun_keeps_its_energy():
    sky = sun_sky(0.7, 35.0)
    _, sun = split_sun(sky)
    assert sun is not None
    gbuffers, _, out = _render([plane(50.0)], sky)
    seen = gbuffers.has_surface
    expected = np.sin(np.radians(35.0)) * sun.irradiance / np.pi
    np.testing.assert_allclose(
        out.direct_sun[seen], np.broadcast_to(expected, (seen.sum(), 3)), rtol=1e-4
    )
    np.testing.assert_allclose(sun.irradiance, np.pi, rtol=1e-4)
    np.testing.assert_array_equal(out.sun_visibility[seen], 1)


def test_penumbra_has_the_width_of_the_solar_disc():
    """An edge 20 m above the ground under a sun at the zenith: 20 m x 0.53 degrees = 18.5 cm."""
    roof = plane(20.0, z_m=20.0)
    roof = replace(roof, vertices=roof.vertices + np.array([20.0, 0, 0], np.float32))
    config = replace(exact(), sun_rays=16)
    near = look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    gbuffers, _, out = _render([plane(30.0), roof], sun_sky(0.0, 90.0), config, near, (128, 64))
    x = gbuffers.position_world[..., 0]
    width = 2 * 20.0 * np.tan(np.radians(0.265))
    assert (out.sun_visibility[x < -0.6 * width] == 1).all()
    assert (out.sun_visibility[x > 0.6 * width] == 0).all()
    inside = np.abs(x) < 0.2 * width
    t = np.clip(-x[inside] / (width / 2), -1, 1)
    expected = 0.5 + (np.arcsin(t) + t * np.sqrt(1 - t * t)) / np.pi
    assert np.abs(out.sun_visibility[inside] - expected).mean() < 0.08


@pytest.mark.parametrize("config", [exact(), TransportConfig()])
def test_shadow_ratio_never_exceeds_one_and_direct_light_never_the_unshadowed(config):
    gbuffers, _, out = _render(street(), sun_sky(1.0, 40.0, sky=0.3), config)
    assert (out.direct_sun + out.sky <= out.unshadowed * (1 + 1e-5) + 1e-6).all()
    assert out.ratio.max() <= 1 + 1e-5
    assert out.ratio[gbuffers.has_surface].min() < 0.4


def test_turning_sky_and_scene_together_changes_nothing(rng):
    turn_deg = 70.0
    turn = RigidTransform.from_yaw("world", "world", np.radians(turn_deg), np.zeros(3))
    sky = sun_sky(2.0, 30.0, sky=0.2, rows=180)
    sky = replace(
        sky, radiance=sky.radiance + np.linspace(1, 0, 180, dtype=np.float32)[:, None, None]
    )
    config = replace(exact(), sky_rays=256)
    _, _, out = _render(street(), sky, config)
    turned = [m.transformed(turn) for m in street()]
    _, _, other = _render(turned, sky.rotated(turn_deg), config, turn @ _VIEW)
    assert np.abs(out.shaded - other.shaded).mean() < 0.01 * out.shaded.mean()
    np.testing.assert_allclose(other.shaded.mean(), out.shaded.mean(), rtol=2e-3)


def test_ambient_occlusion_beside_a_sphere():
    """A sphere of radius r touching the ground at distance d: its centre stands at elevation
    asin(r / l), l = hypot(d, r), so it blocks (r / l)^2 * cos(zenith) of the hemisphere."""
    radius = 1.0
    above = look_at((0.0, 0.0, 14.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    meshes = [plane(30.0), sphere((0, 0, radius), radius, 5)]
    config = replace(exact(), sky_rays=256)
    gbuffers, table, _ = _render(meshes, constant_sky(), config, above)
    d = np.linalg.norm(gbuffers.position_world[..., :2], axis=-1)
    ground = (gbuffers.position_world[..., 2] < 0.01) & (d > 1.2)
    length = np.hypot(d, radius)
    blocked = (radius / length) ** 2 * (radius / length)
    error = table.ambient_occlusion[ground] - (1 - blocked[ground])
    assert np.abs(error).max() < 0.03
    assert abs(error.mean()) < 1e-3


def test_a_coloured_wall_bounces_its_colour():
    """Close to the foot of a wide sunlit wall, half of the hemisphere shows albedo x sun."""
    wall = box((0.0, 10.0, 50.0), (200.0, 0.2, 100.0), (0.9, 0.3, 0.0))
    below = look_at((0.0, 8.0, 3.0), (0.0, 9.6, 0.0))
    config = replace(exact(), sky_rays=256)
    gbuffers, _, out = _render(
        [plane(100.0, 1, 0.0), wall], sun_sky(-np.pi / 2, 45.0), config, below
    )
    near = (gbuffers.position_world[..., 2] < 0.01) & gbuffers.has_surface
    y = gbuffers.position_world[..., 1][near]
    form = 0.5 * (1 - (9.9 - y) / np.hypot(9.9 - y, 100.0))
    expected = form[:, None] * np.array([0.9, 0.3, 0.0]) * np.cos(np.radians(45.0))
    np.testing.assert_allclose(out.bounce[near].mean(0), expected.mean(0), rtol=0.02)


def test_half_resolution_shading_stays_close_to_full():
    sky = sun_sky(1.0, 40.0, sky=0.5)
    full = _render(street(), sky, replace(exact(), sky_rays=256), size=(128, 96))
    half = _render(street(), sky, TransportConfig(), size=(128, 96))
    seen = full[0].has_surface
    error = np.abs(full[2].shaded - half[2].shaded)[seen]
    assert error.mean() < 0.02 * full[2].shaded[seen].mean()


def test_a_coarse_ball_does_not_shadow_itself_where_its_smooth_normals_see_the_sun():
    """The shadow terminator: faces that turn away from the sun lie inside the ball they stand
    for, and rays start on that ball."""
    sky = sun_sky(0.3, 15.0)
    _, sun = split_sun(sky)
    assert sun is not None
    ball = sphere((0, 0, 0.5), 0.4, subdivisions=1)
    view = look_at((1.0, -3.0, 1.0), (0.0, 0.0, 0.5))
    gbuffers, _, out = _render([ball], sky, view=view, size=(128, 96, 400.0))
    facing = gbuffers.has_surface & (gbuffers.normal_world @ sun.direction_world > 0.1)
    assert facing.sum() > 100
    np.testing.assert_array_equal(out.sun_visibility[facing], 1.0)
    radius = np.linalg.norm(gbuffers.ray_starts_world - [0, 0, 0.5], axis=-1)
    flat = np.linalg.norm(gbuffers.position_world - [0, 0, 0.5], axis=-1)
    seen = gbuffers.has_surface
    assert np.abs(radius[seen] - 0.4).max() < 0.7 * np.abs(flat[seen] - 0.4).max()
