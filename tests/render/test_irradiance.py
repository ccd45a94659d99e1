"""Light on points, and the whole renderer against Mitsuba's path tracer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, constant_sky, look_at, plane, sun_sky

from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.irradiance import IrradianceConfig, irradiance_at
from lightsim.render.transport.light import light
from lightsim.render.transport.lobes import Lobes
from lightsim.render.transport.matrix import TransportConfig, exact, trace_transport


def test_open_ground_sees_all_of_the_sky_and_the_sun():
    scene = without_actors(make_static_scene([plane()]))
    points = np.array([[0.0, 0, 0], [3, 4, 0]])
    up = np.array([[0.0, 0, 1], [0, 0, 1]])
    lit = irradiance_at(Lobes.none_on(points, up), scene, sun_sky(0.3, 30.0, sky=0.5))
    np.testing.assert_array_equal(lit.sun_visibility, 1)
    np.testing.assert_array_equal(lit.sky_visibility, 1)
    np.testing.assert_allclose(lit.irradiance_over_pi, 0.5 + np.sin(np.radians(30)), rtol=2e-3)


def test_a_wall_hides_half_of_the_sky_and_gives_it_back_by_its_albedo():
    wall = plane(500.0, 100)
    turned = np.stack([wall.vertices[:, 0], 0 * wall.vertices[:, 0], wall.vertices[:, 1]], axis=1)
    scene = without_actors(make_static_scene([replace(wall, vertices=turned)]))
    point, up = np.array([[0.0, -0.5, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    sky = constant_sky((1.0, 1.0, 1.0))
    lit = irradiance_at(
        Lobes.none_on(point, up), scene, sky, IrradianceConfig(TransportConfig(sky_rays=1024))
    )
    assert lit.sky_visibility[0] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(lit.irradiance_over_pi[0], lit.sky_visibility[0], rtol=1e-4)
    with_bounce = IrradianceConfig(TransportConfig(sky_rays=1024), unseen_albedo=0.4)
    for confidence, bounce in ((0.0, 0.4 * 0.5), (1.0, 0.7 * 0.5)):
        # Unseen it reflects the sky; seen it sends what was seen, whatever the sky.
        seen = replace(
            wall,
            vertices=turned,
            base_colour=np.full_like(turned, 0.7, dtype=np.float32),
            confidence=np.full(len(turned), confidence, dtype=np.float32),
        )
        scene = without_actors(make_static_scene([seen]))
        lit = irradiance_at(Lobes.none_on(point, up), scene, sky, with_bounce)
        np.testing.assert_allclose(lit.bounce[0], bounce, atol=0.005)
        back = irradiance_at(Lobes.none_on(-point, up), scene, sky, with_bounce)
        np.testing.assert_allclose(back.bounce[0], 0.4 * 0.5, atol=0.005)
    sun = irradiance_at(Lobes.none_on(point, up), scene, sun_sky(np.pi / 2, 30.0)).sun_visibility
    np.testing.assert_array_equal(sun, 0)


def test_points_and_pixels_agree():
    config = exact()
    scene = without_actors(make_static_scene([plane(20.0, 20), box((0, 2, 1), (2, 2, 2))]))
    buffers = render_gbuffers(scene, camera(), look_at((0.0, -6.0, 4.0), (0, 0, 0)))
    sky = sun_sky(2.0, 40.0, sky=0.4)
    image = light(trace_transport(scene, buffers, config), scene, buffers, sky, config)
    seen = buffers.has_surface
    lit = irradiance_at(
        Lobes.none_on(buffers.position_world[seen], buffers.normal_world[seen]), scene, sky
    )
    direct = (image.direct_sun + image.sky)[seen]
    assert np.abs(lit.irradiance_over_pi - direct).mean() < 0.02
    np.testing.assert_allclose(lit.irradiance_over_pi.mean(0), direct.mean(0), rtol=3e-3)
