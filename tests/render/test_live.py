"""A frame on a device against the same frame lit by numba and numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, look_at, plane, random_sky, sphere, sun_sky

from lightsim.core.buffers import ShadowBuffers
from lightsim.core.casting import MakeCaster
from lightsim.core.scenario import Scenario
from lightsim.errors import InputError
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.casters.mitsuba import MitsubaBackend, is_usable, mitsuba_caster_maker
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.render.transport.light import light
from lightsim.render.transport.live import LiveFrame, LiveLight
from lightsim.render.transport.matrix import TransportConfig, exact, trace_transport
from lightsim.render.transport.samples import render_samples
from lightsim.render.transport.sky import prepare_sky

CONFIG = TransportConfig(sky_rays=16)


@pytest.fixture(params=["llvm", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request: pytest.FixtureRequest) -> MitsubaBackend:
    import torch

    if not is_usable(request.param):
        pytest.skip(f"Mitsuba cannot use {request.param} here (LLVM: set DRJIT_LIBLLVM_PATH)")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch has no CUDA device")
    return request.param


def _scene(make: MakeCaster) -> FrameScene:
    static = make_static_scene([plane(8.0, 9), box([2, 1, 1], [1, 2, 2])], make_caster=make)
    actors = (sphere([-2, 0, 1], 1.0, 2, albedo=0.8),)
    normals = tuple(mesh.vertex_normals() for mesh in actors)
    return FrameScene(static, actors, make(actors), normals, tuple(range(len(actors))))


def _traced(make: MakeCaster, config: TransportConfig, target_z_m: float = 0.5):
    scene = _scene(make)
    buffers = render_gbuffers(scene, camera(), look_at([0, -6, 4], [0, 0, target_z_m]))
    return trace_transport(scene, buffers, config), scene, buffers


def _check(found: LiveLight, expected: ShadowBuffers, base_colour: np.ndarray) -> None:
    # Where the sun stands in a surface's own plane, rounding decides whether it sees it.
    visible = found.sun_visibility.cpu().numpy()
    assert np.mean(np.abs(visible - expected.sun_visibility) > 1e-6) < 1e-3
    pairs = {
        "shaded": (found.shaded, expected.shaded),
        "unshadowed": (found.unshadowed, expected.unshadowed),
        "radiance": (found.radiance, expected.shaded * base_colour),
        "ratio": (found.ratio, expected.ratio),
    }
    for name, (tensor, image) in pairs.items():
        np.testing.assert_allclose(tensor.cpu().numpy(), image, rtol=2e-5, atol=2e-6, err_msg=name)


@pytest.mark.parametrize(
    "config",
    [CONFIG, replace(CONFIG, bounces=3, sun_rays=7), replace(exact(), face_rays=0)],
    ids=["half resolution", "three bounces", "no bounce"],
)
def test_light_equals_that_of_the_host(
    backend: MitsubaBackend, rng: np.random.Generator, config: TransportConfig
) -> None:
    table, scene, buffers = _traced(mitsuba_caster_maker(backend), config)
    live = LiveFrame(table, scene, buffers, config, backend)
    assert live.held_bytes > 0
    low, high = (prepare_sky(sun_sky(a, e, 0.3)) for a, e in ((1.0, 20.0), (-2.0, 65.0)))
    other = prepare_sky(random_sky(rng))
    skies = [low, replace(low, sun=high.sun), other, replace(other, sun=low.sun)]
    skies += [replace(low, sun=None), low]
    for sky in skies:
        expected = light(table, scene, buffers, sky, config)
        _check(live(sky), expected, buffers.base_colour)
    assert live(low).sun_visibility.device == live.device


def test_a_moved_sun_takes_no_sums_of_the_sky_and_no_kernels_of_its_own(
    backend: MitsubaBackend,
) -> None:
    import drjit

    table, scene, buffers = _traced(make_embree_caster, CONFIG)
    live = LiveFrame(table, scene, buffers, CONFIG, backend)
    sky = prepare_sky(sun_sky(1.0, 40.0, 0.3))
    first = live(sky)
    assert sky.sun is not None
    suns = [sky.sun.rotated(10.0 * k) for k in range(1, 13)]
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory):
        moved = [live(replace(sky, sun=sun)) for sun in suns]
        kernels = drjit.kernel_history([drjit.KernelType.JIT])
    # Dr.Jit may order the operands of one expression in a few ways.
    assert len(kernels) == 2 * len(suns)
    assert len({kernel["hash"] for kernel in kernels}) < len(suns)
    for lit in moved:
        assert lit.sky[0].data_ptr() == first.sky[0].data_ptr()
        assert not np.array_equal(lit.shaded.cpu().numpy(), first.shaded.cpu().numpy())


def test_a_table_of_another_caster_is_lit_alike(backend: MitsubaBackend) -> None:
    table, scene, buffers = _traced(make_embree_caster, CONFIG)
    sky = prepare_sky(sun_sky(1.0, 40.0, 0.3))
    shaded = LiveFrame(table, scene, buffers, CONFIG, backend)(sky).shaded.cpu().numpy()
    expected = light(table, scene, buffers, sky, CONFIG).shaded
    assert np.mean(np.abs(shaded - expected) > 1e-3) < 0.005
    np.testing.assert_allclose(shaded.mean(), expected.mean(), rtol=1e-3)


def test_a_frame_of_nothing_but_sky_is_black(backend: MitsubaBackend) -> None:
    table, scene, buffers = _traced(make_embree_caster, CONFIG, target_z_m=90.0)
    assert not buffers.has_surface.any()
    live = LiveFrame(table, scene, buffers, CONFIG, backend)
    lit = live(prepare_sky(sun_sky(1.0, 40.0, 0.3)))
    assert not lit.shaded.any()
    assert bool((lit.ratio == 1).all())


def test_samples_of_pixels_are_refused() -> None:
    config = replace(CONFIG, pixel_samples=4)
    static = make_static_scene([plane(8.0, 9)])
    scene = place(static, Scenario("test", (), ()), 0)
    pose = look_at([0, -6, 4], [0, 0, 0.5])
    buffers = render_gbuffers(scene, camera(), pose)
    samples = render_samples(scene, camera(), pose, buffers, config)
    table = trace_transport(scene, buffers, config, samples=samples)
    with pytest.raises(InputError, match="pixel centres"):
        LiveFrame(table, scene, buffers, config, "llvm")


def test_a_device_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    table, scene, buffers = _traced(make_embree_caster, CONFIG)
    monkeypatch.setattr("lightsim.render.transport.live_sun.is_usable", lambda backend: False)
    with pytest.raises(InputError, match="cuda"):
        LiveFrame(table, scene, buffers, CONFIG, "cuda")
