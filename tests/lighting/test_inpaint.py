"""Inpainting of panoramas: closed forms of its parts, training and what is kept of the seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional

from journals import MemoryJournal
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.panorama.attention_network import (
    contextual_attention,
    fold_sphere,
    pad_sphere,
)
from lightsim.lighting.panorama.complete import completed_ldr
from lightsim.lighting.panorama.inpaint import (
    complete_panorama,
    fill_by_laplace,
    fill_by_nearest,
    fill_by_rows,
)
from lightsim.lighting.panorama.inpaint_network import (
    GatedConvolution,
    InpaintGenerator,
    PatchDiscriminator,
)
from lightsim.lighting.sample import PanoramaBatch
from lightsim.networks.loop import LoopConfig
from lightsim_lab.training.inpaint import InpaintConfig, train_inpaint
from lightsim_lab.training.inpaint_losses import (
    discriminator_loss,
    generator_loss,
    reconstruction_loss,
    row_weights,
)
from lightsim_lab.training.inpaint_scores import evaluate_inpaint

HEIGHT = 16
TINY = InpaintConfig(
    LoopConfig(6),
    batch=2,
    width=2,
    dilations=(1, 2),
    discriminator_width=2,
    discriminator_layers=2,
    adversarial_from=0.3,
    adversarial_weight=0.1,
)


class Gradients:
    """The same blue above the same brown, more or less exposed; a band of it is seen."""

    height_px = HEIGHT

    def panoramas(self, size: int, seed: int, index: int) -> PanoramaBatch:
        rng = np.random.default_rng([seed, index])
        h, w = HEIGHT, 2 * HEIGHT
        is_up = (np.arange(h) < h // 4)[:, None, None]
        colours = np.where(is_up, [0.2, 0.4, 0.9], [0.5, 0.4, 0.2])
        exposure = rng.uniform(0.5, 1.0, (size, 1, 1, 1))
        panorama = exposure * colours * np.ones((1, 1, w, 1))
        seen = np.zeros((size, h, w), bool)
        seen[:, h // 3 : 2 * h // 3] = True
        seen[:, :, w // 2 :] &= rng.random((size, h, w // 2)) < 0.9
        return PanoramaBatch(panorama.astype(np.float32), seen)


def generator_of(**options: Any) -> InpaintGenerator:
    torch.manual_seed(0)
    return InpaintGenerator(3, HEIGHT, (1, 2), **options).eval()


def image_and_hole(height: int = HEIGHT) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    image = torch.rand(2, 3, height, 2 * height) * 2 - 1
    hole = torch.zeros(2, 1, height, 2 * height)
    hole[:, :, : height // 3] = 1
    hole[0, :, height // 2 :, 5:9] = 1
    return image, hole


def test_padding_continues_over_the_pole() -> None:
    x = torch.arange(4 * 8, dtype=torch.float32).reshape(1, 1, 4, 8)
    padded = pad_sphere(x, 2)[0, 0]
    assert padded.shape == (8, 12)
    assert torch.equal(padded[2:-2, :2], x[0, 0, :, -2:])
    assert torch.equal(padded[1, 2:-2], x[0, 0, 0].roll(4))
    assert torch.equal(padded[0, 2:-2], x[0, 0, 1].roll(4))
    assert torch.equal(padded[-1, 2:-2], x[0, 0, 2].roll(4))


def test_fold_is_the_transpose_of_padding() -> None:
    torch.manual_seed(0)
    x, y = torch.rand(1, 2, 4, 8), torch.rand(1, 2, 8, 12)
    torch.testing.assert_close((pad_sphere(x, 2) * y).sum(), (x * fold_sphere(y, 2)).sum())


def test_an_open_gate_leaves_convolution_and_elu() -> None:
    torch.manual_seed(0)
    layer = GatedConvolution(3, 4)
    with torch.no_grad():
        layer.convolution.weight[4:] = 0
        layer.convolution.bias[4:] = 100  # type: ignore[index]
    x = torch.randn(1, 3, 8, 16)
    weight, bias = layer.convolution.weight[:4], layer.convolution.bias[:4]  # type: ignore[index]
    expected = functional.elu(functional.conv2d(pad_sphere(x, 1), weight, bias))
    torch.testing.assert_close(layer(x), expected)


@pytest.mark.parametrize("propagates", [False, True])
def test_attention_copies_the_matching_patch_of_a_periodic_texture(propagates: bool) -> None:
    torch.manual_seed(0)
    texture = torch.randn(1, 6, 16, 8).repeat(1, 1, 1, 4)
    hole = torch.zeros(1, 1, 16, 32)
    hole[..., 4:12, 9:15] = 1
    result = contextual_attention(texture, hole, sharpness=200.0, propagates=propagates)
    torch.testing.assert_close(result, texture, atol=1e-3, rtol=0)


def test_attention_takes_nothing_from_holes() -> None:
    torch.manual_seed(0)
    features, hole = torch.rand(1, 4, 16, 32), torch.zeros(1, 1, 16, 32)
    hole[..., 8:] = 1
    spoilt = features.clone()
    spoilt[:, 0] += 1000 * hole[:, 0]
    assert contextual_attention(spoilt, hole).max() <= 1.0
    assert contextual_attention(features, torch.ones_like(hole)).isfinite().all()


@pytest.mark.parametrize("is_plain", [False, True])
def test_a_turned_panorama_gives_the_turned_result(is_plain: bool) -> None:
    generator = generator_of(propagates=not is_plain, is_residual=not is_plain)
    image, hole = image_and_hole()
    quarter = HEIGHT // 2
    with torch.inference_mode():
        _, straight = generator(image, hole)
        _, turned = generator(image.roll(quarter, -1), hole.roll(quarter, -1))
    torch.testing.assert_close(turned, straight.roll(quarter, -1), atol=1e-5, rtol=1e-4)


def test_what_lies_in_holes_is_not_looked_at() -> None:
    generator = generator_of()
    image, hole = image_and_hole()
    with torch.inference_mode():
        results = [generator(x, hole)[1] for x in (image, image + 5 * hole)]
    assert torch.equal(*results)


def test_losses_by_hand() -> None:
    truth, result = torch.tensor([2.0, 0.5]), torch.tensor([-2.0, 0.0])
    assert float(discriminator_loss(truth, result)) == pytest.approx(0.25 + 0.5)
    assert float(generator_loss(result)) == pytest.approx(1.0)
    assert float(row_weights(8).mean()) == pytest.approx(1.0)
    image, hole = torch.zeros(1, 3, 8, 16), torch.zeros(1, 1, 8, 16)
    hole[..., :8] = 1
    off = image + hole + 0.5 * (1 - hole)
    loss = reconstruction_loss(off, image, hole, 0.1)
    assert float(loss) == pytest.approx((1.0 + 0.1 * 0.5) / 1.1)


def test_the_discriminator_is_spectrally_normal() -> None:
    torch.manual_seed(0)
    network = PatchDiscriminator(4, 3)
    image, hole = image_and_hole()
    for _ in range(50):
        network(image, hole)
    network.eval()
    for layer in network.layers:
        weight = layer.weight
        assert isinstance(weight, torch.Tensor)
        norm = torch.linalg.matrix_norm(weight.detach().flatten(1), 2)
        assert float(norm) == pytest.approx(1.0, abs=0.02)


def test_gradients_reach_every_parameter() -> None:
    generator, discriminator = generator_of(), PatchDiscriminator(4, 2)
    image, hole = image_and_hole()
    coarse, refined = generator(image, hole)
    loss = reconstruction_loss(refined, image, hole, 0.1)
    (loss + reconstruction_loss(coarse, image, hole, 0.1)).backward()
    generator_loss(discriminator(refined.detach(), hole)).backward()
    for network in (generator, discriminator):
        for name, parameter in network.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name


@pytest.mark.slow
def test_training_learns_and_what_was_learnt_can_be_loaded() -> None:
    config = replace(TINY, loop=LoopConfig(120), width=4, rate=1e-2, adversarial_weight=0.001)
    checkpointer = MemoryJournal()
    weights, steps = train_inpaint(Gradients(), config, checkpointer.session())
    assert steps == 120
    assert checkpointer.lines[-1]["l1"] < 0.6 * checkpointer.lines[0]["l1"]
    scores = evaluate_inpaint(Gradients(), weights, batches=1, size=2, seed=7)
    assert set(scores) == {"network", "row mean", "nearest", "laplace"}
    assert scores["network"]["psnr_db"] > scores["row mean"]["psnr_db"]
    again = InpaintGenerator.from_weights({k: v.half() for k, v in weights.items()})
    assert int(again.height_px) == HEIGHT


@pytest.mark.parametrize("height", [HEIGHT, 24, 50])
@pytest.mark.parametrize("is_trained", [True, False])
def test_the_seen_is_kept_to_the_bit(height: int, is_trained: bool) -> None:
    rng = np.random.default_rng(0)
    ldr = rng.random((height, 2 * height, 3)).astype(np.float32)
    seen = rng.random((height, 2 * height)) < 0.3
    weights = generator_of().state_dict() if is_trained else None
    result = complete_panorama(ldr, seen, weights)
    assert np.array_equal(result[seen], ldr[seen])
    assert result.min() >= 0
    assert result.max() <= 1
    assert np.array_equal(complete_panorama(ldr, np.ones_like(seen), weights), ldr)


def test_without_weights_colours_go_on_smoothly_without_a_seam() -> None:
    height = 128
    rows = np.linspace(0.2, 0.6, height, dtype=np.float32)[:, None, None]
    ldr = np.broadcast_to(rows, (height, 2 * height, 3)).copy()
    seen = np.zeros((height, 2 * height), bool)
    seen[40:90, 30:-30] = True
    result = complete_panorama(ldr, seen, None)
    assert np.abs(np.diff(result[40:90], axis=1)).max() < 0.02
    assert np.abs(result[50:80] - ldr[50:80]).max() < 0.03
    constant = complete_panorama(np.full_like(ldr, 0.37), seen, None)
    assert np.abs(constant - 0.37).max() < 1e-4


def test_fills_without_a_network_by_hand() -> None:
    ldr = np.zeros((4, 8, 3), np.float32)
    ldr[1, 0], ldr[1, 1], ldr[2] = 0.2, 0.4, 0.8
    seen = np.zeros((4, 8), bool)
    seen[1, :2] = seen[2, :] = True
    rows = fill_by_rows(ldr, seen)
    assert np.allclose(rows[:, 5, 0], [0.3, 0.3, 0.8, 0.8])
    nearest = fill_by_nearest(ldr, seen)
    assert np.allclose(nearest[0, [0, 1, 7], 0], [0.2, 0.4, 0.2])
    assert np.allclose(nearest[3, :, 0], 0.8)
    laplace = fill_by_laplace(ldr, seen)
    assert 0.2 < laplace[1, 7, 0] < 0.8
    assert np.array_equal(laplace[seen], ldr[seen])


@pytest.mark.parametrize(
    ("radiance", "clips", "exposure"),
    [(0.2, True, 1.0), (0.02, True, 4.0), (0.6, True, 1.0), (0.6, False, 0.5)],
)
def test_exposure_keeps_to_what_was_trained(radiance: float, clips: bool, exposure: float) -> None:
    seen, clipped = np.zeros((16, 32), bool), np.zeros((16, 32), bool)
    seen[4:12] = True
    clipped[5, 5] = clips
    linear = np.where(seen, radiance, 0.0)[..., None] * np.ones(3)
    panorama = Panorama(linear.astype(np.float32), seen, seen, clipped)
    ldr, factor = completed_ldr(panorama, None)
    assert factor == pytest.approx(exposure)
    code = 1.055 * (radiance * exposure) ** (1 / 2.4) - 0.055
    assert ldr[8, 8] == pytest.approx(code, abs=1e-5)
    assert ldr[0, 0] == pytest.approx(code, abs=0.05)
    assert (ldr[5, 5] == 1).all() == clips


def test_wrong_input_is_named() -> None:
    ldr, seen = np.zeros((8, 12, 3), np.float32), np.ones((8, 12), bool)
    with pytest.raises(InputError, match="12x8"):
        complete_panorama(ldr, seen, None)
    with pytest.raises(InputError, match="no observed pixel"):
        complete_panorama(np.zeros((8, 16, 3), np.float32), np.zeros((8, 16), bool), None)
    nothing = np.zeros((8, 16), bool)
    with pytest.raises(InputError, match="black or empty"):
        completed_ldr(Panorama(np.zeros((8, 16, 3), np.float32), nothing, nothing, nothing), None)
    wide = replace(TINY, dilations=(1, 8))
    with pytest.raises(InputError, match="dilations"):
        train_inpaint(Gradients(), wide, MemoryJournal().session())


def test_the_published_size_takes_two_steps() -> None:
    """Not at its width, nor on a CPU in its precision, but with its losses and threads."""
    full = InpaintConfig.full()
    config = replace(
        full, loop=replace(full.loop, steps=2), batch=1, width=2, discriminator_width=2,
        adversarial_from=0.0, workers=1, dilations=(2, 4), discriminator_layers=3,
    )  # fmt: skip
    checkpointer = MemoryJournal()
    train_inpaint(Gradients(), config, checkpointer.session())
    assert "discriminator" in checkpointer.lines[-1]
    assert all(math.isfinite(value) for value in checkpointer.lines[-1].values())
