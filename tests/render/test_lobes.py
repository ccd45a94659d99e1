"""Wide specular lobes at pixel centres and at points: against sums over directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import camera, constant_sky, look_at, plane, sun_sky

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.mesh import Material
from lightsim.geometry.materials import ASPHALT
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.image import scene_image
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.irradiance import IrradianceConfig, irradiance_at
from lightsim.render.transport.light import light
from lightsim.render.transport.lobes import Lobes, normal_reflectance, specular_lobe
from lightsim.render.transport.matrix import TransportConfig, exact, trace_transport
from lightsim.render.transport.samples import render_samples

_ROUGHNESS = 0.8
_GRAZING = look_at((0.0, -10.0, 1.6), (0.0, 0.0, 0.0))
_LENS = camera(48, 36, 40.0)


def _reflected(towards: np.ndarray, dome: SkyDome) -> np.ndarray:
    """Of level ground, by a sum over the dome's pixels; the sun by its direction."""
    sky, sun = split_sun(dome)
    directions = pixel_directions(len(sky)).reshape(-1, 3).astype(np.float32)
    light = (sky * solid_angles_sr(len(sky))[..., None]).reshape(-1, 3)
    if sun is not None:
        directions = np.vstack([directions, sun.direction_world.astype(np.float32)])
        light = np.vstack([light, sun.irradiance])
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), directions.shape)
    view = np.broadcast_to(towards.astype(np.float32), directions.shape)
    alphas = np.full(len(up), _ROUGHNESS**2, np.float32)
    lobe = specular_lobe(up, np.ascontiguousarray(view), directions, alphas)
    fresnel = 0.04 * (1 - lobe[:, 1]) + lobe[:, 1]
    return (lobe[:, 0] * fresnel) @ light


def _ground(dome: SkyDome, config: TransportConfig) -> tuple[GBuffers, ShadowBuffers]:
    mesh = replace(plane(60.0, 2, 0.2), materials=(Material(_ROUGHNESS),))
    scene = without_actors(make_static_scene([mesh]))
    gbuffers = render_gbuffers(scene, _LENS, _GRAZING)
    samples = None
    if config.pixel_samples > 1:
        samples = render_samples(scene, _LENS, _GRAZING, gbuffers, config)
    table = trace_transport(scene, gbuffers, config, samples=samples)
    return gbuffers, light(table, scene, gbuffers, dome, config)


@pytest.mark.parametrize("pixel_samples", [1, 4])
def test_rough_ground_reflects_what_its_lobe_gathers(pixel_samples: int) -> None:
    """A low sun ahead and a uniform sky, as a front camera sees a road."""
    dome = sun_sky(np.pi / 2, 20.0, 0.5)
    config = replace(exact(), glossy_rays=64, pixel_samples=pixel_samples)
    gbuffers, out = _ground(dome, config)
    assert gbuffers.towards_camera_world is not None
    assert out.glossy is not None
    rows = np.flatnonzero(gbuffers.has_surface.reshape(-1))[::97]
    wanted = [_reflected(v, dome) for v in gbuffers.towards_camera_world.reshape(-1, 3)[rows]]
    found = out.glossy.reshape(-1, 3)[rows]
    np.testing.assert_allclose(found, wanted, rtol=0.08)
    np.testing.assert_allclose(found.mean(axis=0), np.mean(wanted, axis=0), rtol=0.01)
    # What a Lambert model of this road leaves out.
    assert (found / (0.2 * out.shaded.reshape(-1, 3)[rows])).max() > 0.5
    image = scene_image(gbuffers, out, np.zeros_like(out.shaded)).reshape(-1, 3)[rows]
    np.testing.assert_allclose(image - found, 0.2 * out.shaded.reshape(-1, 3)[rows], rtol=1e-3)


def test_points_reflect_as_pixels_do_and_a_part_of_the_dome_its_part() -> None:
    dome = sun_sky(np.pi / 2, 20.0, 0.5)
    scene = without_actors(make_static_scene([plane(60.0, 2, 0.2)]))
    slopes = np.radians([5.0, 20.0, 60.0])
    zero = np.zeros(3)
    towards = np.stack([zero, -np.cos(slopes), np.sin(slopes)], axis=1).astype(np.float32)
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), (3, 3)).copy()
    f0 = normal_reflectance(np.zeros((3, 3), np.float32), zero.astype(np.float32))
    lobes = Lobes(np.zeros_like(up), up, towards, np.full(3, _ROUGHNESS, np.float32), f0)
    config = IrradianceConfig(TransportConfig(glossy_rays=4096))
    half = dome.radiance.copy()
    half[:, : half.shape[1] // 2] = 0.0
    part = SkyDome(half, None)
    part = SkyDome(split_sun(part)[0], None)
    found = irradiance_at(lobes, scene, dome, config, part_of_dome=part)
    total = found.reflected + found.sun_visibility[:, None] * found.reflected_sun
    np.testing.assert_allclose(total, [_reflected(v, dome) for v in towards], rtol=0.01)
    np.testing.assert_allclose(
        found.reflected_part, [_reflected(v, part) for v in towards], rtol=0.02, atol=1e-3
    )
    dark = irradiance_at(Lobes.none_on(lobes.ray_starts_world, up), scene, dome, config)
    assert not dark.reflected.any()
    assert not dark.reflected_sun.any()


def test_what_reflects_nothing_stays_without() -> None:
    gbuffers, out = _ground(constant_sky((1.0, 1.0, 1.0)), replace(exact(), glossy_rays=0))
    assert out.glossy is None
    assert not out.reflected.any()
    np.testing.assert_allclose(out.shaded[gbuffers.has_surface], 1.0, rtol=1e-5)


def test_asphalt_is_as_glossy_as_roads_are() -> None:
    """Class R III of CIE 144:2001, usual asphalt: specular factor S1 from .85 to 1.35. It compares
    reduced luminance coefficients q cos^3 (tan gamma = 2, ahead) and q (overhead), seen at 1
    degree; q is the BRDF, of albedo .1."""

    def q(tan_gamma: float) -> float:
        low = np.radians(1.0)
        view = np.array([[np.cos(low), 0.0, np.sin(low)]], np.float32)
        light = np.array([[-tan_gamma, 0.0, 1.0]], np.float32)
        light /= np.linalg.norm(light)
        up = np.array([[0.0, 0.0, 1.0]], np.float32)
        alpha = np.array([ASPHALT.roughness**2], np.float32)
        lobe, grazing = specular_lobe(up, view, light, alpha)[0]
        f0 = normal_reflectance(np.zeros((1, 3), np.float32), np.zeros(1, np.float32))[0, 0]
        return float(lobe * (f0 + (1 - f0) * grazing) / light[0, 2] + 0.1 / np.pi)

    s1 = q(2.0) * np.cos(np.arctan(2.0)) ** 3 / q(0.0)
    assert 0.85 < s1 < 1.35
