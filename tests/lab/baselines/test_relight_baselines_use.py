"""Published methods, re-implemented: what holds whatever their weights are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.relighting.test_network import inputs as inputs
from tests.relighting.test_network import planes_of
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.relighting.methods import relight_by
from lightsim.relighting.network.features import rendered, srgb_of, tensors_of
from lightsim.relighting.network.stored import network_of, tensors_of_network
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs
from lightsim.store.weights import WeightsRecord, write_weights
from lightsim_lab.baselines.epe import EpeConfig, EpeNet, PatchDiscriminator
from lightsim_lab.baselines.methods import all_kinds
from lightsim_lab.baselines.relight import (
    FieldSurface,
    lighting_of,
    relit_field,
    shown_by,
)
from lightsim_lab.baselines.self_osr import (
    Decomposition,
    SelfOsrConfig,
    SelfOsrNet,
)
from lightsim_lab.baselines.self_osr import (
    lighting_of as lighting_in_planes,
)
from lightsim_lab.baselines.spherical_harmonics import shading, shading_basis

SELF_OSR = SelfOsrConfig(widths=(8, 16), shadow_widths=(8, 16))
EPE = EpeConfig(widths=(8, 16), buffer_width=8)


def batch_of(inputs: RelightInputs) -> dict[str, torch.Tensor]:
    return tensors_of(planes_of(inputs)[0])


def trained(network: SelfOsrNet | EpeNet) -> SelfOsrNet | EpeNet:
    """Weights that do something everywhere."""
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network.eval()


def test_an_exactly_decomposed_lambert_scene_is_relit_exactly(inputs: RelightInputs) -> None:
    batch = batch_of(inputs)
    albedo = 0.1 + 0.8 * torch.rand_like(batch["source"])
    normal = functional.normalize(torch.randn_like(albedo), dim=1)
    lit = torch.ones_like(batch["matte"])
    source, target = (lighting_in_planes(batch, which) for which in ("source", "target"))
    batch["source"] = srgb_of(albedo * shading(normal, source))
    exact = Decomposition(albedo, normal, lit, source)
    with torch.inference_mode():
        relit = SelfOsrNet(SELF_OSR).relit(batch, exact)
    truth = albedo * shading(normal, target)
    torch.testing.assert_close(relit.lambert / relit.shadow, truth, atol=1e-6, rtol=1e-5)
    # At first the renderer adds nothing, and the target sky stands behind the matte.
    is_sky = batch["matte"].expand_as(truth) == 1
    behind = torch.where(is_sky, batch["target_sky"], relit.lambert)
    sure = is_sky | (batch["matte"] == 0)
    torch.testing.assert_close(relit.picture[sure], srgb_of(behind)[sure])


def test_self_osr_sees_the_picture_and_the_target_sky_alone(inputs: RelightInputs) -> None:
    network, batch = trained(SelfOsrNet(SELF_OSR)), batch_of(inputs)
    seen = {"source", "matte", "target_dome", "target_sky"}
    check_what_it_sees(network, batch, seen)


def test_epe_sees_the_twin_under_the_target_sky_alone(inputs: RelightInputs) -> None:
    buffers = {"surface", "depth", "position", "normal", "base_colour", "openness", "actor"}
    light = {f"target_{name}" for name in ("shaded", "ratio", "sun", "reflected", "sky")}
    network, batch = trained(EpeNet(EPE)), batch_of(inputs)
    check_what_it_sees(network, batch, buffers | light)
    with torch.inference_mode():
        first = EpeNet(EPE)(batch)
        assert PatchDiscriminator((8, 16))(first).shape[1] == 1
    torch.testing.assert_close(first, srgb_of(rendered(batch, "target")).clamp_max(1.0))


def check_what_it_sees(
    network: torch.nn.Module, batch: dict[str, torch.Tensor], seen: set[str]
) -> None:
    with torch.inference_mode():
        picture = network(batch)
        for name, value in batch.items():
            changed = network({**batch, name: value + 0.5})
            assert torch.equal(changed, picture) == (name not in seen), name


@pytest.mark.parametrize("network", [SelfOsrNet(SELF_OSR), EpeNet(EPE)])
def test_frames_are_radiance_up_to_the_cameras_white(
    network: SelfOsrNet | EpeNet, inputs: RelightInputs
) -> None:
    made = shown_by(network.eval(), inputs, RatioConfig()).radiance
    assert inputs.camera_and_skies is not None
    assert made.shape == inputs.radiance.shape
    assert (made >= 0).all()
    assert (made <= 1.001 / inputs.camera_and_skies.gain).all()
    with pytest.raises(InputError, match="camera and skies"):
        shown_by(network, replace(inputs, camera_and_skies=None), RatioConfig())


def test_a_method_takes_the_weights_of_its_own_network_alone(tmp_path: Path) -> None:
    record = WeightsRecord("a", "b", "c", "d", 0, 1, {}, "e", "f")
    files = {}
    for method, network in (("self-osr", SelfOsrNet(SELF_OSR)), ("epe", EpeNet(EPE))):
        files[method] = tmp_path / f"{method}.safetensors"
        write_weights(files[method], tensors_of_network(network, all_kinds()), record)
        again = network_of(tensors_of_network(network, all_kinds()), all_kinds())
        assert isinstance(again, type(network))
        assert again.config == network.config
    for method in ("self-osr", "epe"):
        assert relight_by(method, files[method])
        other = next(file for name, file in files.items() if name != method)
        with pytest.raises(InputError, match="another network"):
            relight_by(method, other)


@pytest.mark.parametrize(("method", "bound"), [("paper", 0.42), ("self-osr", 0.56), ("epe", 0.08)])
def test_the_shipped_networks_relight(method: str, bound: float, inputs: RelightInputs) -> None:
    """Mean error of the logarithm on a scene unlike any street; the source picture's is 0.65."""
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    pictures = (relight_by(method)(inputs, RatioConfig()).radiance, inputs.radiance)
    is_surface = inputs.sky_matte < 1
    made, copied = (np.abs(np.log(p[is_surface] / wanted[is_surface])).mean() for p in pictures)
    assert made < bound < copied


def test_a_field_is_lit_by_the_target_and_actors_by_the_twins_colours(
    inputs: RelightInputs,
) -> None:
    buffers = inputs.buffers
    actor_index = buffers.actor_index.copy()
    actor_index[-8:] = 0
    inputs = replace(inputs, buffers=replace(buffers, actor_index=actor_index))
    assert inputs.camera_and_skies is not None
    light = lighting_of(inputs.camera_and_skies.target_sky)
    asked = {}

    def field(points: np.ndarray, directions: np.ndarray, given: np.ndarray) -> FieldSurface:
        asked.update(points=points, directions=directions, light=given)
        up = np.tile(np.array([[0, 0, 1]], np.float32), (len(points), 1))
        return FieldSurface(0.5 * np.ones_like(points), up, 0.25 * np.ones(len(points), np.float32))

    made = relit_field(field, inputs, RatioConfig()).radiance
    np.testing.assert_allclose(np.linalg.norm(asked["directions"], axis=1), 1, atol=1e-5)
    assert np.array_equal(asked["light"], light)
    level = shading_basis(torch.tensor([[0.0, 0.0, 1.0]])).numpy() @ light
    is_ground = buffers.normal_world[..., 2] > 0.9
    is_field = is_ground & (actor_index == -1) & (inputs.sky_matte == 0)
    np.testing.assert_allclose(made[is_field], 0.125 * level.repeat(is_field.sum(), 0), rtol=1e-4)
    is_actor = is_ground & (actor_index == 0)
    np.testing.assert_allclose(
        made[is_actor], buffers.base_colour[is_actor] * level, rtol=1e-4, atol=1e-6
    )
    is_sky = inputs.sky_matte >= 1
    assert np.array_equal(made[is_sky], inputs.target_sky[is_sky])
