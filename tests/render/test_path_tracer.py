"""The Mitsuba path tracer against closed forms and against the light transport matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, constant_sky, look_at, plane, sphere, sun_sky

from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import Texture, TriMesh
from lightsim.core.mitsuba_variants import choose_variant
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.mitsuba_scene import rows_at_poles
from lightsim.render.reference.corner_mesh import corner_mesh
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.render.reference.renderer import ReferenceRenderer, Shot, open_irradiance_over_pi
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import exact, trace_transport

_LENS = camera(48, 36, 42.0)
_VIEW = look_at((0.0, -7.0, 4.0), (0.0, 0.0, 0.5))
_ABOVE = look_at((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))


@pytest.fixture(scope="module")
def tracer() -> PathTracer:
    return PathTracer("scalar_rgb")


def things() -> list[TriMesh]:
    return [
        plane(12.0, 60, 0.5),
        box((-2.0, 1.0, 1.0), (2, 2, 2), (0.8, 0.3, 0.2)),
        sphere((2.0, 0.5, 1.0), 1.0, 5, (0.3, 0.6, 0.8)),
    ]


def graded(sky: SkyDome) -> SkyDome:
    """Brighter towards the zenith."""
    rise = np.linspace(1.5, 0.5, sky.height_px, dtype=np.float32)[:, None, None]
    return replace(sky, radiance=sky.radiance * rise)


@pytest.mark.slow
@pytest.mark.parametrize("sky", [graded(constant_sky()), sun_sky(-1.0, 40.0, 0.4)])
def test_parity_with_the_ray_table(tracer, sky):
    scene = without_actors(make_static_scene(things(), [box((0, -2, 3), (2, 2, 0.2), 0.7)]))
    buffers = render_gbuffers(scene, _LENS, _VIEW)
    config = replace(exact(), sky_rays=256, sun_rays=16, face_sun_rays=4)
    table = light(trace_transport(scene, buffers, config), scene, buffers, sky, config)
    shot = Shot(sky, 64, 1, "diffuse", is_antialiased=False)
    shots = [shot, replace(shot, surfaces="white"), replace(shot, bounces=0, surfaces="white")]
    radiance, white, direct = tracer.render_shots(scene, _LENS, _VIEW, shots, 0)
    seen = buffers.has_surface
    for ours, theirs in (
        (table.shaded * buffers.base_colour, radiance),
        (table.shaded, white),
        (table.direct_sun + table.sky, direct),
    ):
        np.testing.assert_allclose(ours[seen].mean(0) / theirs[seen].mean(0), 1.0, atol=0.008)
        # The path tracer's own noise at 64 samples is some 6 % a pixel.
        assert np.median(np.abs(ours / theirs - 1)[seen]) < 0.06
    np.testing.assert_allclose(radiance[~seen], sky.look_up(_directions())[~seen], rtol=3e-5)


def _directions():
    return _VIEW.rotate(_LENS.directions(_LENS.pixel_centres()).reshape(-1, 3)).reshape(36, 48, 3)


def test_the_sun_disc_has_its_irradiance(tracer):
    sky = sun_sky(0.7, 30.0)
    scene = without_actors(make_static_scene([plane(20.0)]))
    shot = Shot(sky, 4, 0, "white", has_sky=False)
    (image,) = tracer.render_shots(scene, _LENS, _ABOVE, [shot], 0)
    _, sun = split_sun(sky)
    assert sun is not None
    expected = sun.irradiance / np.pi * sun.direction_world[2]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), expected, rtol=1.5e-4)


def test_a_texture_lies_where_the_buffers_have_it(tracer):
    ground = plane(4.0)
    image = np.zeros((8, 8, 3), np.float32) + 0.2
    image[..., 0] = np.linspace(0.1, 0.9, 8)
    image[..., 1] = np.linspace(0.9, 0.1, 8)[:, None]
    uv = (ground.vertices[ground.faces][..., :2] + 4).astype(np.float32)
    ground = replace(ground, texture=Texture(image, uv))
    scene = without_actors(make_static_scene([ground]))
    buffers = render_gbuffers(scene, _LENS, _ABOVE)
    shot = Shot(constant_sky((1.0, 1.0, 1.0)), 4, 0, "diffuse", is_antialiased=False)
    (radiance,) = tracer.render_shots(scene, _LENS, _ABOVE, [shot], 0)
    seen = buffers.has_surface
    # All colours share their paths, so the noise drops out of their ratio.
    colour = 0.2 * radiance / radiance[..., 2:]
    np.testing.assert_allclose(colour[seen], buffers.base_colour[seen], rtol=1e-3)


def test_hard_edges_are_not_rounded():
    """A box that shares its corners' vertices, as reconstructed meshes do."""
    corners = box((0, 0, 0), (2, 2, 2))
    vertices, index = np.unique(corners.vertices, axis=0, return_inverse=True)
    colour = np.full_like(vertices, 0.5)
    shared = TriMesh("world", vertices, index.reshape(-1, 3).astype(np.int32), colour)
    found = corner_mesh(shared, shared.vertex_normals())
    expected = np.repeat(shared.face_normals(), 3, axis=0)
    np.testing.assert_allclose(found.normals, expected, atol=1e-6)
    ball = sphere((0, 0, 0), 1.0, 4)
    found = corner_mesh(ball, ball.vertex_normals())
    np.testing.assert_allclose(found.normals, found.vertices, atol=0.006)


def test_edges_are_averaged_over_the_pixel(tracer):
    scene = without_actors(make_static_scene([box((0.0, 0.0, 0.0), (3.17, 4.0, 0.1))]))
    shot = Shot(constant_sky((1.0, 1.0, 1.0)), 64, 0, "diffuse")
    (smooth,) = tracer.render_shots(scene, _LENS, _ABOVE, [shot], 0)
    covered_px = 3.17 * 42.0 / 9.95
    row = smooth[18, :, 0]
    assert (48 - row.sum()) / 0.5 == pytest.approx(covered_px, abs=0.15)


def test_principled_surfaces_keep_energy(tracer):
    ball = sphere((0.0, 0.0, 0.0), 2.0, 4, 1.0)
    scene = without_actors(make_static_scene([ball]))
    shot = Shot(constant_sky((1.0, 1.0, 1.0)), 16, 4)
    (image,) = tracer.render_shots(scene, _LENS, _ABOVE, [shot], 0)
    assert image[16:20, 22:26].mean() == pytest.approx(1.0, abs=0.04)


def test_frames_of_light(tracer):
    sky = sun_sky(-1.0, 40.0, 0.4)
    frame = CameraFrame("test", "00", 0, _VIEW, lambda: np.zeros((36, 48, 3), np.uint8))
    background, roof = plane(12.0, 60, 0.5), box((0, -2, 3), (2, 2, 0.2), 0.7)
    renderer = ReferenceRenderer(background, roof, tracer, samples=16, bounces=1)
    scenario = Scenario("test", (), ())
    skies = [renderer.prepare(sky)]
    traced = renderer.trace(scenario, frame, _LENS)
    buffers, lit = traced.buffers, traced.light(skies[0])
    seen = buffers.has_surface
    scene = renderer.scene(scenario, 0)
    table = light(trace_transport(scene, buffers, exact()), scene, buffers, sky, exact())
    for name in ("sun_visibility", "direct_sun", "sky", "shaded", "unshadowed"):
        ours, theirs = getattr(lit, name)[seen], getattr(table, name)[seen]
        np.testing.assert_allclose(ours.mean(0), theirs.mean(0), rtol=9e-3)
    np.testing.assert_allclose(lit.direct_sun + lit.sky + lit.bounce, lit.shaded, atol=1e-6)
    np.testing.assert_array_equal(lit.shaded[~seen], 0)
    assert buffers.ambient_occlusion.min() < 0.9
    # The image has all bounces and the materials' own reflections, the light one bounce.
    image = traced.image(skies[0])
    assert image[seen].mean() == pytest.approx(
        (lit.shaded * buffers.base_colour)[seen].mean(), rel=0.13
    )


def test_irradiance_of_an_open_dome(rng):
    sky = graded(constant_sky())
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.stack([sky.irradiance(n) for n in normals]) / np.pi
    np.testing.assert_allclose(open_irradiance_over_pi(sky.radiance, normals), expected, rtol=2e-4)


def test_rows_at_poles_keep_the_pixels_between_them(rng):
    image = rng.uniform(size=(4, 8, 3)).astype(np.float32)
    rows = rows_at_poles(image)
    np.testing.assert_array_equal(rows[1::2], image)
    np.testing.assert_allclose(rows[2], (image[0] + image[1]) / 2)


def test_a_pose_of_something_else_is_refused(tracer):
    scene = without_actors(make_static_scene([plane()]))
    pose = RigidTransform.from_rotation("world", "ego", np.eye(3), np.zeros(3))
    with pytest.raises(FrameMismatchError):
        tracer.render_shots(scene, _LENS, pose, [Shot(constant_sky(), 1)], 0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("libLLVM-14.so", "scalar_rgb"), ("libLLVM.so.19.1", "llvm_ad_rgb")],
)
def test_llvm_is_used_only_when_named(monkeypatch, tmp_path, name, expected):
    monkeypatch.setattr("lightsim.core.mitsuba_variants.has_cuda", lambda: False)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert choose_variant() == "scalar_rgb"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / name))
    assert choose_variant() == "scalar_rgb"
    (tmp_path / name).touch()
    assert choose_variant() == expected
