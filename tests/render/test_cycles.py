"""Cycles against Mitsuba. Needs an interpreter with bpy (LIGHTSIM_BLENDER_PYTHON)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, constant_sky, look_at, plane, sphere, sun_sky

from lightsim.core.mesh import Material, Texture
from lightsim.errors import LightSimError, MissingDependencyError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.reference.cycles import Cycles
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.render.reference.renderer import Shot
from lightsim.render.scene import make_static_scene, without_actors

_LENS = replace(camera(64, 48, 55.0), cx=29.0, cy=25.5)
_VIEW = look_at((0.0, -7.0, 4.0), (0.0, 0.0, 0.5))


@pytest.fixture(scope="module")
def cycles() -> Iterator[Cycles]:
    try:
        renderer = Cycles()
    except MissingDependencyError as error:
        pytest.skip(f"no Blender: {error}")
    yield renderer
    renderer.close()


def _scene():
    ground = plane(12.0, 60, 0.5)
    image = np.full((16, 16, 3), 0.3, np.float32)
    image[:8, :, 0] = 0.8
    uv = ((ground.vertices[ground.faces][..., :2] + 12) / 24 * 16).astype(np.float32)
    ground = replace(ground, texture=Texture(image, uv))
    meshes = [ground, box((-2.0, 1.0, 1.0), (2, 2, 2), 0.7), sphere((2.0, 0.5, 1.0), 1.0, 5, 0.4)]
    return without_actors(make_static_scene(meshes, [box((0, -2, 3), (2, 2, 0.2), 0.7)]))


@pytest.mark.slow
@pytest.mark.blender
def test_parity_with_mitsuba(cycles):
    scene, sky = _scene(), sun_sky(-1.0, 40.0, 0.4)
    whole = Shot(sky, 96, 1, "diffuse", is_antialiased=False)
    shots = [
        whole,
        replace(whole, surfaces="white", bounces=0, has_sky=False),
        replace(whole, surfaces="white", bounces=0, has_sun=False),
        replace(whole, bounces=3, is_antialiased=True),
    ]
    ours = cycles.render_shots(scene, _LENS, _VIEW, shots, 0)
    theirs = PathTracer().render_shots(scene, _LENS, _VIEW, shots, 0)
    seen = render_gbuffers(scene, _LENS, _VIEW).has_surface
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a[seen].mean(0), b[seen].mean(0), rtol=0.01)
        # The noise of a pixel is about 3 %: the texture and the camera agree too.
        assert np.median(np.abs(a - b)[seen] / b[seen].mean()) < 0.06
    np.testing.assert_allclose(ours[0][~seen], theirs[0][~seen], atol=2e-3)


@pytest.mark.slow
@pytest.mark.blender
def test_a_changed_scene_is_handed_over(cycles):
    sky = constant_sky((1.0, 1.0, 1.0))
    shot = Shot(sky, 32, 0, "diffuse", is_antialiased=False)
    for albedo in (0.2, 0.6):
        scene = without_actors(make_static_scene([plane(30.0, 1, albedo)]))
        (image,) = cycles.render_shots(scene, _LENS, _VIEW, [shot], 0)
        assert image[30:].mean() == pytest.approx(albedo, rel=0.01)


@pytest.mark.slow
@pytest.mark.blender
def test_materials_reach_blender(cycles):
    """A smooth metal plane shows the sky above it; a rough one mixes it."""
    sky = constant_sky((1.0, 1.0, 1.0))
    radiance = sky.radiance.copy()
    radiance[: len(radiance) // 4] = 0
    sky = replace(sky, radiance=radiance)
    level = look_at((0.0, -7.0, 1.0), (0.0, 0.0, 0.0))
    means = []
    for roughness in (0.05, 1.0):
        metal = (Material(roughness, 1.0, "metal"),)
        scene = without_actors(make_static_scene([replace(plane(30.0, 1, 0.9), materials=metal)]))
        (image,) = cycles.render_shots(scene, _LENS, level, [Shot(sky, 32, 0)], 0)
        means.append(image[30:].mean())
    assert means[0] == pytest.approx(0.9, rel=0.06)
    assert means[1] < 0.8


@pytest.mark.slow
@pytest.mark.blender
def test_rough_dielectrics_reflect_as_much_as_lambert_surfaces(cycles):
    """The specular lobe replaces as much diffuse light (MATTE_ROUGHNESS), bounces included."""
    sky = sun_sky(-1.0, 40.0, 0.4)
    shots = [Shot(sky, 64, 2, kind, is_antialiased=False) for kind in ("principled", "diffuse")]
    found = []
    for roughness in (0.9, 0.2):
        material = (Material(roughness, 0.0, "paint"),)
        meshes = [
            replace(mesh, materials=material)
            for mesh in (plane(12.0, 60, 0.5), sphere((0.0, 0.5, 1.0), 1.0, 5, 0.4))
        ]
        scene = without_actors(make_static_scene(meshes))
        principled, diffuse = cycles.render_shots(scene, _LENS, _VIEW, shots, 0)
        seen = render_gbuffers(scene, _LENS, _VIEW).has_surface
        found.append(principled[seen].mean() / diffuse[seen].mean())
    # Blender 4.5: 1.017 and 0.981.
    assert found[0] == pytest.approx(1.0, abs=0.03)
    assert found[1] < found[0] - 0.02


@pytest.mark.blender
def test_blenders_own_words_reach_the_user(cycles):
    scene = without_actors(make_static_scene([plane()]))
    with pytest.raises(LightSimError, match="KeyError"):
        cycles._blender.request({"do": "shot", "surfaces": "unknown"})
    assert cycles.render_shots(scene, _LENS, _VIEW, [Shot(constant_sky(), 1)], 0)


def test_a_python_without_blender_is_told_apart():
    with pytest.raises(MissingDependencyError, match="cannot be run"):
        Cycles("/nowhere/python")
    if __import__("importlib.util").util.find_spec("bpy") is None:
        with pytest.raises(MissingDependencyError, match="LIGHTSIM_BLENDER_PYTHON"):
            Cycles(sys.executable)
