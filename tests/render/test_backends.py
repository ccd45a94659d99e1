"""Mitsuba's ray casters against Embree, and the choice among backends."""

from __future__ import annotations

import numpy as np
import pytest
from rendering_scenes import box, camera, look_at, mesh, plane, sphere, sun_sky

from lightsim.core.casting import RayCaster
from lightsim.core.scenario import Scenario
from lightsim.errors import FrameMismatchError, InputError
from lightsim.render.casters import mitsuba as mitsuba_caster
from lightsim.render.casters.choice import Backend, choose_caster
from lightsim.render.casters.embree import EmbreeCaster, make_embree_caster
from lightsim.render.casters.mitsuba import MitsubaBackend, is_usable, mitsuba_caster_maker
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, place
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import exact, trace_transport


@pytest.fixture(params=["llvm", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request: pytest.FixtureRequest) -> MitsubaBackend:
    if not is_usable(request.param):
        pytest.skip(f"Mitsuba cannot use {request.param} here (LLVM: set DRJIT_LIBLLVM_PATH)")
    return request.param


def _scene():
    empty = mesh(np.zeros((0, 3)), np.zeros((0, 3)))
    return [plane(8.0, 9), empty, box([2, 1, 1], [1, 2, 2]), sphere([-2, 0, 1], 1.0, 3)]


def _rays(rng: np.random.Generator, count: int):
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform([-4, -4, 0.1], [4, 4, 4], (count, 3)), directions


def test_hits_equal_those_of_embree(rng: np.random.Generator, backend: MitsubaBackend) -> None:
    meshes = _scene()
    caster, reference = mitsuba_caster_maker(backend)(meshes), make_embree_caster(meshes)
    assert isinstance(caster, RayCaster)
    origins, directions = _rays(rng, 20000)
    found, expected = (c.intersect(origins, directions) for c in (caster, reference))
    # Rays through edges may take either face.
    same = (found.mesh_index == expected.mesh_index) & (found.face_index == expected.face_index)
    assert same.mean() > 0.999
    assert set(np.unique(found.mesh_index)) == {-1, 0, 2, 3}
    hit = same & expected.is_hit
    np.testing.assert_array_equal(found.is_hit[same], expected.is_hit[same])
    np.testing.assert_allclose(
        found.distance_m[hit], expected.distance_m[hit], rtol=1e-5, atol=1e-4
    )
    np.testing.assert_allclose(found.barycentric[hit], expected.barycentric[hit], atol=2e-4)
    assert np.isinf(found.distance_m[~found.is_hit]).all()
    occluded = caster.is_occluded(origins, directions)
    np.testing.assert_array_equal(occluded, found.is_hit)


def test_no_meshes_and_no_rays_are_allowed(backend: MitsubaBackend) -> None:
    make = mitsuba_caster_maker(backend)
    up = np.array([[0.0, 0.0, 1.0]])
    for meshes in ([], [mesh(np.zeros((0, 3)), np.zeros((0, 3)))]):
        assert not make(meshes).is_occluded(np.zeros((1, 3)), up).any()
        assert not make(meshes).intersect(np.zeros((1, 3)), up).is_hit.any()
    none = np.zeros((0, 3))
    assert len(make(_scene()).intersect(none, none).distance_m) == 0


def test_the_callers_variant_comes_back(backend: MitsubaBackend) -> None:
    import mitsuba

    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    try:
        caster = mitsuba_caster_maker(backend)(_scene())
        assert caster.is_occluded(np.array([[0.0, 0, 5]]), np.array([[0.0, 0, -1]])).all()
        assert mitsuba.variant() == "scalar_rgb"
    finally:
        if before is not None:
            mitsuba.set_variant(before)


def test_meshes_of_another_frame_are_refused(backend: MitsubaBackend) -> None:
    from dataclasses import replace

    with pytest.raises(FrameMismatchError):
        mitsuba_caster_maker(backend)([replace(plane(), frame="actor")])


def test_light_is_the_same_whatever_casts_the_rays(backend: MitsubaBackend) -> None:
    images = []
    for make in (mitsuba_caster_maker(backend), make_embree_caster):
        static = make_static_scene(_scene(), make_caster=make)
        scene = place(static, Scenario("test", (), ()), 0, make)
        view, config = camera(), exact()
        buffers = render_gbuffers(scene, view, look_at([0, -6, 4], [0, 0, 0.5]))
        table = trace_transport(scene, buffers, config)
        images.append(light(table, scene, buffers, sun_sky(1.0, 40.0, 0.3), config).shaded)
    difference = np.abs(images[0] - images[1])
    assert np.mean(difference > 1e-3) < 0.005
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=1e-3)


def test_a_backend_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightsim.render.casters.choice.is_usable", lambda backend: False)
    monkeypatch.setattr(mitsuba_caster, "is_usable", lambda backend: False)
    assert choose_caster("auto") is make_embree_caster
    assert isinstance(choose_caster("embree")([plane()]), EmbreeCaster)
    names: tuple[Backend, ...] = ("mitsuba-cuda", "mitsuba-llvm")
    for name in names:
        with pytest.raises(InputError, match="--backend embree"):
            choose_caster(name)


@pytest.mark.parametrize(
    "name", ["", "libLLVM.so", "libLLVM-14.so", "libLLVM.so.15", "libLLVM-16.so.1"]
)
def test_old_or_unnamed_llvm_is_never_loaded(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    library = tmp_path / name if name else tmp_path
    if name:
        library.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    is_usable.cache_clear()
    assert not is_usable("llvm")
    is_usable.cache_clear()
