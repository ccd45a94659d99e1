"""Anti-aliased images against exact coverage and against larger images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, constant_sky, look_at, plane, sphere, street, sun_sky

from lightsim.core.camera import PinholeCamera
from lightsim.errors import InputError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.image import scene_image
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import TransportConfig, exact, trace_transport
from lightsim.render.transport.samples import render_samples, sample_offsets

_VIEW = look_at((0.0, -9.0, 5.0), (0.0, 0.0, 0.5))
_ABOVE = look_at((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))


def _render(meshes, sky, config, view=_VIEW, lens=None):
    lens = lens or camera()
    scene = without_actors(make_static_scene(meshes))
    gbuffers = render_gbuffers(scene, lens, view)
    samples = render_samples(scene, lens, view, gbuffers, config)
    table = trace_transport(scene, gbuffers, config, samples=samples)
    return gbuffers, samples, light(table, scene, gbuffers, sky, config)


def street_with_post():
    return [*street(), box((0.6, -1.0, 1.5), (0.05, 0.05, 3.0), 0.9)]


def _area_left_of(slope: float, shift_px: float, lens: PinholeCamera) -> np.ndarray:
    """Fraction of each pixel left of the line u = shift + slope x v, by 64 x 64 points."""
    fine = (np.arange(64) + 0.5) / 64
    u = (np.arange(lens.width_px)[:, None] + fine).reshape(1, -1)
    v = (np.arange(lens.height_px)[:, None] + fine).reshape(-1, 1)
    inside = u < shift_px + slope * v
    return inside.reshape(lens.height_px, 64, lens.width_px, 64).mean(axis=(1, 3))


@pytest.mark.parametrize("count", [4, 16, 25])
def test_samples_are_stratified_in_cells_rows_and_columns(count):
    points = sample_offsets(count)
    side = round(count**0.5)
    np.testing.assert_allclose(points.mean(axis=0), 0.5)
    for axis in range(2):
        assert len(np.unique((points[:, axis] * count).astype(int))) == count
    assert len(np.unique((points * side).astype(int), axis=0)) == count


@pytest.mark.parametrize("count", [4, 16])
def test_coverage_of_an_edge_against_the_sky(count):
    """A plane 10 m below the camera ends on a slanted line."""
    lens = camera(48, 36, 40.0)
    slope, shift = 0.3, 17.3
    half = plane(200.0)
    # On the ground: x = (u - cx) / f x 10, y = -(v - cy) / f x 10; the edge goes through x0.
    x0 = (shift - lens.cx + slope * lens.cy) / lens.fx * 10.0
    angle = np.arctan(slope)
    c, s = np.cos(angle), np.sin(angle)
    corners = half.vertices - np.array([200.0, 0, 0], np.float32)
    turned = corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    half = replace(half, vertices=(turned + np.array([x0, 0, 0], np.float32)).astype(np.float32))
    config = replace(exact(), pixel_samples=count, glossy_rays=0)
    gbuffers, _, out = _render([half], constant_sky((1.0, 1.0, 1.0)), config, _ABOVE, lens)
    exact_fraction = _area_left_of(slope, shift, lens)
    assert out.coverage is not None
    error = out.coverage - exact_fraction
    is_cut = (exact_fraction > 0) & (exact_fraction < 1)
    assert is_cut.sum() > 30
    assert np.abs(error).max() < 2.0 / count
    assert abs(error[is_cut].mean()) < 0.02
    np.testing.assert_allclose(out.shaded[out.coverage > 0], 1.0, rtol=1e-5)
    black = np.zeros_like(out.shaded)
    image = scene_image(gbuffers, out, black)
    np.testing.assert_allclose(image[..., 0], 0.5 * out.coverage, atol=1e-5)


def test_a_sharp_shadow_edge_is_the_covered_fraction_of_each_pixel():
    """A roof 5 cm above the ground has a penumbra of half a millimetre; a pixel has 25 cm."""
    lens = camera(48, 36, 40.0)
    roof = plane(20.0, z_m=0.05)
    roof = replace(roof, vertices=roof.vertices - np.array([20.0, 0, 0], np.float32))
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    roof = replace(roof, vertices=(roof.vertices @ turn).astype(np.float32))
    scene = without_actors(make_static_scene([plane(30.0)], [roof]))
    config = replace(exact(), pixel_samples=16)
    gbuffers = render_gbuffers(scene, lens, _ABOVE)
    samples = render_samples(scene, lens, _ABOVE, gbuffers, config)
    table = trace_transport(scene, gbuffers, config, samples=samples)
    out = light(table, scene, gbuffers, sun_sky(0.0, 90.0), config)
    fine = camera(48 * 16, 36 * 16, 40.0 * 16)
    x = render_gbuffers(scene, fine, _ABOVE).position_world
    is_lit = x[..., 0] * c + x[..., 1] * s > 0
    fraction = is_lit.reshape(36, 16, 48, 16).mean(axis=(1, 3))
    assert np.abs(out.sun_visibility - fraction).max() < 0.15
    assert np.abs(out.sun_visibility - fraction).mean() < 0.004
    between = (out.sun_visibility > 0.05) & (out.sun_visibility < 0.95)
    assert between.sum() > 25


def test_an_anti_aliased_image_is_the_mean_of_a_larger_one():
    sky = sun_sky(1.0, 40.0, sky=0.5)
    fine_lens = camera(64 * 4, 48 * 4, 50.0 * 4)
    scene = without_actors(make_static_scene(street_with_post()))
    fine = render_gbuffers(scene, fine_lens, _VIEW)
    config = replace(exact(), sky_rays=128, glossy_rays=0)
    table = trace_transport(scene, fine, config)
    white = np.full((192, 256, 3), 0.5, np.float32)
    reference = scene_image(fine, light(table, scene, fine, sky, config), white)
    reference = reference.reshape(48, 4, 64, 4, 3).mean(axis=(1, 3))
    images = {}
    for count in (1, 16):
        few = replace(config, pixel_samples=count)
        gbuffers, _, out = _render(street_with_post(), sky, few)
        images[count] = scene_image(gbuffers, out, white[:48, :64])
    error = {n: np.sqrt(np.square(i - reference).mean()) for n, i in images.items()}
    assert error[16] < 0.3 * error[1]
    assert error[16] < 0.02 * reference.mean()
    np.testing.assert_allclose(images[16].mean(), reference.mean(), rtol=2e-3)


def test_one_sample_at_the_centre_is_the_plain_table():
    sky = constant_sky()
    config = TransportConfig()
    scene = without_actors(make_static_scene(street_with_post()))
    gbuffers = render_gbuffers(scene, camera(), _VIEW)
    plain = light(trace_transport(scene, gbuffers, config), scene, gbuffers, sky, config)
    _, _, sampled = _render(street_with_post(), sky, config)
    for name in ("sky", "bounce", "shaded", "unshadowed"):
        np.testing.assert_allclose(getattr(sampled, name), getattr(plain, name), rtol=1e-5)
    white = np.ones_like(plain.shaded)
    np.testing.assert_allclose(
        scene_image(gbuffers, sampled, white), scene_image(gbuffers, plain, white), rtol=1e-4
    )


@pytest.mark.parametrize("count", [1, 4])
def test_shadow_ratio_stays_at_most_one(count):
    config = replace(TransportConfig(), pixel_samples=count)
    meshes = [*street_with_post(), sphere((0.0, -1.0, 0.7), 0.7)]
    _, _, out = _render(meshes, sun_sky(1.0, 40.0, sky=0.3), config)
    assert (out.direct_sun + out.sky <= out.unshadowed * (1 + 1e-4) + 1e-6).all()
    assert out.sun_visibility.min() >= 0
    assert out.sun_visibility.max() <= 1 + 1e-6
    assert out.ratio.min() < 0.4


def test_a_number_of_samples_that_is_no_square_is_refused():
    with pytest.raises(InputError, match="square"):
        TransportConfig(pixel_samples=8)
