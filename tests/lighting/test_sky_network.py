"""The sky dome estimator: geometry of its layers, control of its domes, training."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from fake_skies import FakeSkies

from journals import MemoryJournal
from lightsim.errors import InputError
from lightsim.lighting.sample import LightingData, SkyPrediction
from lightsim.lighting.sky.estimator import SkyEstimator
from lightsim.lighting.sky.forms import load_sky_network
from lightsim.lighting.sky.network import (
    SkyNetwork,
    SkyNetworkConfig,
    tensors_of,
)
from lightsim.lighting.sky.panorama_layers import UNet, filled
from lightsim.lighting.sky.paper_network import PaperSkyConfig, PaperSkyNetwork
from lightsim.lighting.sky.sky_terms import fisher_loss, laplace_loss, sun_lobe
from lightsim.networks.loop import LoopConfig
from lightsim.store.weights import WeightsRecord, read_record, read_weights, write_weights
from lightsim_lab.training.sky import (
    LossFunction,
    SkyRecipe,
    SkyTrainConfig,
    sky_tensors,
    train_sky,
)
from lightsim_lab.training.sky_losses import direction_loss, paper_sky_loss, sky_loss
from lightsim_lab.training.sky_models import (
    SkyKind,
    network_of,
    sky_recipe,
    started_from,
    weights_of,
)
from lightsim_lab.training.sky_scores import (
    angles_deg,
    brightest_spot,
    credible_cone_deg,
    evaluate_sky_networks,
    parts_of,
)

TINY: dict[str, Any] = {"widths": (8, 8, 16), "decoder_widths": (8, 8, 16), "height_px": 32}
DATA = FakeSkies()


def batch_of(size: int = 4, seed: int = 0) -> Any:
    whole = np.zeros(size, bool)
    drawn = DATA.batch(size, seed, 0, only_sunny=False)
    return sky_tensors(drawn, whole, None, torch.device("cpu"))


def train(network: SkyNetwork, steps: int, checkpointer: MemoryJournal, rate: float = 1e-3) -> None:
    config = SkyTrainConfig(LoopConfig(steps), rate, batch=4)
    train_sky(SkyRecipe(network, sky_loss, config, DATA.height_px), DATA, checkpointer.session())


def test_fake_skies_are_lighting_data() -> None:
    assert isinstance(DATA, LightingData)


def test_network_turns_with_the_panorama() -> None:
    network, batch = SkyNetwork(SkyNetworkConfig(**TINY)).eval(), batch_of()
    shift = 16
    turned = batch.shown(batch.panorama.roll(shift, 3), batch.seen.roll(shift, 3))
    with torch.no_grad():
        before, after = network.encode(batch), network.encode(turned)
    angle = -2 * math.pi * shift / batch.panorama.shape[3]
    x, y, z = before.direction.unbind(1)
    c, s = math.cos(angle), math.sin(angle)
    expected = torch.stack([c * x - s * y, s * x + c * y, z], dim=1)
    assert torch.allclose(after.direction, expected, atol=1e-5)
    assert torch.allclose(after.log_peak, before.log_peak, atol=1e-5)
    assert torch.allclose(after.latent, before.latent, atol=1e-5)


def test_unet_has_no_seam() -> None:
    network = UNet(3, 3, (8, 8, 8), 4)
    image, vector = torch.rand(1, 3, 16, 64), torch.rand(1, 4)
    turned = network(image.roll(4, 3), vector)[0]
    assert torch.allclose(turned, network(image, vector)[0].roll(4, 3), atol=1e-5)


def test_fill_keeps_what_was_seen_and_hides_the_rest() -> None:
    batch = batch_of()
    seen = batch.seen
    other = batch.panorama * seen + torch.rand_like(batch.panorama) * (1 - seen)
    done = filled(batch.panorama, seen)
    assert torch.equal(done * seen, batch.panorama * seen)
    assert torch.allclose(filled(other, seen), done)
    ones = torch.ones_like(batch.panorama)
    assert torch.allclose(filled(ones, seen), ones, atol=1e-5)


def test_fisher_density_integrates_to_one() -> None:
    cosine = torch.linspace(-1, 1, 20001)
    truth = torch.stack([torch.sqrt(1 - cosine**2), torch.zeros_like(cosine), cosine], dim=1)
    axis = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(cosine), 3)
    for kappa in (0.5, 5.0, 80.0):
        log_kappa = torch.full((len(cosine),), math.log(kappa))
        density = torch.exp(-fisher_loss(axis, log_kappa, truth))
        assert float(torch.trapezoid(density, cosine)) * 2 * math.pi == pytest.approx(1, abs=1e-3)
        cone = credible_cone_deg(np.array([kappa]), 0.9)[0]
        inside = cosine >= math.cos(math.radians(cone))
        fraction = float(torch.trapezoid(density[inside], cosine[inside])) * 2 * math.pi
        assert fraction == pytest.approx(0.9, abs=1e-2)


def test_laplace_loss_is_least_at_the_mean_absolute_error() -> None:
    error = torch.tensor([0.5, 1.0, 1.5])
    scale = torch.zeros(3, requires_grad=True)
    laplace_loss(error, scale, torch.zeros(3)).sum().backward()
    assert scale.grad is not None
    assert float(scale.grad.sum()) == pytest.approx(0.0, abs=1e-6)


def test_centroid_of_the_lobe_is_its_direction() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(64, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 0.2
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    lobes = sun_lobe(torch.from_numpy(direction), 32).numpy()[:, 0]
    spots = [brightest_spot(np.repeat(lobe[..., None], 3, axis=2))[1] for lobe in lobes]
    error = angles_deg(np.array(spots), direction.astype(np.float64))
    assert error.mean() < 0.6
    assert error.max() < 1.5


def test_decoded_dome_follows_the_sun_asked_for() -> None:
    estimator = SkyEstimator(SkyNetwork(SkyNetworkConfig(**TINY), seed=1).eval())
    batch = DATA.batch(1, 0, 0, only_sunny=True)
    ldr, seen = batch.panorama[0], batch.visibility[0]
    prediction = estimator.predict(ldr, seen)
    asked = np.array([0.48, -0.6, 0.64])
    for log_peak in (-0.5, 2.0, 9.0):
        dome = estimator.decode(prediction, ldr, seen=seen, sun_direction=asked, log_peak=log_peak)
        found, spot = brightest_spot(dome)
        assert found == pytest.approx(log_peak, abs=1e-3)
        # Half a pixel of 5.6 degrees.
        assert angles_deg(spot[None], asked[None])[0] < 2.0


def test_estimator_takes_any_size_and_keeps_the_energy_of_the_sun() -> None:
    estimator = SkyEstimator(SkyNetwork(SkyNetworkConfig(**TINY), seed=1).eval())
    small = FakeSkies(32).batch(1, 0, 0, only_sunny=True).panorama[0]
    large = np.repeat(np.repeat(small, 4, axis=0), 4, axis=1)
    a, b = estimator.predict(small), estimator.predict(large)
    assert np.allclose(a.sun_direction, b.sun_direction, atol=1e-4)
    coarse = estimator.decode(a, small, log_peak=9.0)
    fine = estimator.decode(a, large, log_peak=9.0)
    assert fine.shape == (64, 256, 3)

    def energy(upper: np.ndarray) -> float:
        polar = (np.arange(len(upper)) + 0.5) * np.pi / (2 * len(upper))
        return float((upper * np.sin(polar)[:, None, None]).sum()) / upper.shape[1] ** 2

    assert energy(fine) == pytest.approx(energy(coarse), rel=0.05)
    spot = brightest_spot(fine)[1]
    assert angles_deg(spot[None], a.sun_direction[None].astype(np.float64))[0] < 1.5


def test_a_mirrored_panorama_gives_the_mirrored_sun() -> None:
    estimator = SkyEstimator(SkyNetwork(SkyNetworkConfig(**TINY), seed=1).eval())
    ldr = DATA.batch(1, 0, 0, only_sunny=True).panorama[0]
    prediction = estimator.predict(ldr)
    assert isinstance(prediction, SkyPrediction)
    mirrored = estimator.predict(np.ascontiguousarray(ldr[:, ::-1]))
    assert np.allclose(mirrored.sun_direction * [1, -1, 1], prediction.sun_direction, atol=0.05)


def test_bad_input_is_named() -> None:
    estimator = SkyEstimator(SkyNetwork(SkyNetworkConfig(**TINY)).eval())
    with pytest.raises(InputError, match="twice as wide"):
        estimator.predict(np.zeros((32, 32, 3), np.float32))
    ldr = DATA.batch(1, 0, 0, only_sunny=True).panorama[0]
    with pytest.raises(InputError, match="above the horizon"):
        estimator.decode(estimator.predict(ldr), ldr, sun_direction=np.array([1.0, 0.0, -0.1]))


def draw(only_sunny: bool) -> Any:
    """One batch of all skies and one of clear suns."""
    return batch_of(seed=int(only_sunny))


@pytest.mark.parametrize(
    ("network", "loss"),
    [
        (SkyNetwork(SkyNetworkConfig(**TINY)), sky_loss),
        (PaperSkyNetwork(PaperSkyConfig(**TINY)), paper_sky_loss),
    ],
)
def test_gradient_reaches_every_parameter(network: Any, loss: LossFunction) -> None:
    loss(network, draw, torch.Generator().manual_seed(0))[0].backward()
    dead = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert dead == []


def test_the_direction_alone_learns_as_it_does_with_the_rest() -> None:
    whole, alone = (SkyNetwork(SkyNetworkConfig(**TINY)) for _ in range(2))
    sky_loss(whole, draw, torch.Generator().manual_seed(0))[0].backward()
    direction_loss(alone, draw, torch.Generator().manual_seed(0))[0].backward()
    moved = [n for n, p in alone.named_parameters() if p.grad is not None]
    assert {n.split("_")[0] for n in moved} == {"direction"}
    for (name, a), b in zip(alone.named_parameters(), whole.parameters(), strict=True):
        if name in moved:
            assert a.grad is not None
            assert b.grad is not None
            torch.testing.assert_close(a.grad, b.grad)


def test_weights_carry_their_config_and_their_record(tmp_path: Any) -> None:
    network = SkyNetwork(SkyNetworkConfig(**TINY), seed=3).eval()
    record = WeightsRecord("sky", "train", "fake", "0", 3, 0, {"x": 0.5}, "none", "0.2.0")
    write_weights(tmp_path / "sky.safetensors", tensors_of(network), record)
    assert read_record(tmp_path / "sky.safetensors") == record
    again = load_sky_network(read_weights(tmp_path / "sky.safetensors"))
    assert again.config == network.config
    with torch.no_grad():
        a, b = network.encode(batch_of()), again.encode(batch_of())
    assert torch.allclose(a.direction, b.direction, atol=2e-3)


def test_weights_of_every_kind_carry_what_they_are(tmp_path: Path) -> None:
    record = WeightsRecord("sky", "train", "fake", "0", 3, 0, "none", "none", "0.2.0")
    for kind in get_args(SkyKind):
        recipe = sky_recipe(kind, "small", seed=1)
        write_weights(tmp_path / "w", weights_of(kind, recipe.network), record)
        again = network_of(read_weights(tmp_path / "w"))
        assert type(again) is type(recipe.network)
        assert again.config == recipe.network.config
        assert started_from(recipe, read_weights(tmp_path / "w")).config.rate < recipe.config.rate
    with pytest.raises(InputError, match="another network"):
        started_from(sky_recipe("lightsim", "small"), read_weights(tmp_path / "w"))
    with pytest.raises(InputError, match="no sky network"):
        network_of({})


@pytest.mark.parametrize("kind", get_args(SkyKind))
def test_data_of_another_size_are_refused(kind: SkyKind) -> None:
    small, full = sky_recipe(kind, "small"), sky_recipe(kind, "full")
    count = [sum(p.numel() for p in r.network.parameters()) for r in (small, full)]
    assert count[1] > 4 * count[0]
    assert full.config.loop.steps == sky_recipe("lightsim", "full").config.loop.steps
    for recipe in (small, full):
        with pytest.raises(InputError, match="--height"):
            train_sky(recipe, DATA, MemoryJournal().session())


@pytest.mark.slow
def test_training_finds_the_sun() -> None:
    network, checkpointer = SkyNetwork(SkyNetworkConfig(**TINY)), MemoryJournal()
    train(network, 60, checkpointer, rate=4e-3)
    assert checkpointer.lines[-1]["loss"] < checkpointer.lines[0]["loss"] - 1.0
    drawn = parts_of(DATA.batch(64, 7, 0, only_sunny=False), 25)
    assert [len(part.log_peak) for part in drawn] == [25, 25, 14]
    rows = {r.name: r for r in evaluate_sky_networks(drawn, {"ours": network}, drawn)}
    assert rows["ours"].angle_mean_deg < 0.7 * rows["constant"].angle_mean_deg
    assert rows["ours"].decoding_angle_deg < 1.78
    assert rows["ours"].decoding_log_peak < 0.01
