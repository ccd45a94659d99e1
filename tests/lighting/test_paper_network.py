"""The published form of the sky dome estimator, against the paper's appendix."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_skies import FakeSkies

from lightsim.lighting.sky.panorama_layers import direction_map
from lightsim.lighting.sky.paper_network import (
    PaperSkyConfig,
    PaperSkyNetwork,
    encoder_input,
    sun_encoding,
)
from lightsim.lighting.sky.sky_terms import SkyTensors, angles, log_radiance
from lightsim_lab.training.sky import sky_tensors
from lightsim_lab.training.sky_losses import paper_sky_loss

ROWS, WIDTH = 16, 64


@pytest.fixture
def network() -> PaperSkyNetwork:
    return PaperSkyNetwork(PaperSkyConfig((8, 8, 16), (8, 8, 16), 2 * ROWS), seed=1)


def batch_of(size: int = 4, *, only_sunny: bool = False) -> SkyTensors:
    drawn = FakeSkies(2 * ROWS).batch(size, 0, 0, only_sunny=only_sunny)
    return sky_tensors(drawn, np.zeros(size, bool), None, torch.device("cpu"))


def test_the_input_is_the_upper_half_and_a_unit_vector_for_each_pixel() -> None:
    """ "only the top half of the panorama is used", "concatenated channel-wise"."""
    batch = batch_of()
    image = encoder_input(batch)
    assert image.shape == (4, 3 + 3, ROWS, WIDTH)
    assert torch.equal(image[:, :3], batch.panorama[:, :, :ROWS] * 2 - 1)
    torch.testing.assert_close(image[:, 3:].norm(dim=1), torch.ones(4, ROWS, WIDTH))


def test_three_encoders_of_one_architecture(network: PaperSkyNetwork) -> None:
    """ "Three separate encoders with the same architecture"; z_sky has 64 numbers."""
    encoders = [network.direction_encoder, network.intensity_encoder, network.latent_encoder]
    shapes = [[p.shape for p in e.parameters()][:-2] for e in encoders]
    assert shapes[0] == shapes[1] == shapes[2]
    found = network.encode(batch_of())
    assert found.direction.shape == (4, 3)
    torch.testing.assert_close(found.direction.norm(dim=1), torch.ones(4))
    assert found.log_peak.shape == (4,)
    assert found.latent.shape == (4, 64)
    assert (found.log_concentration, found.log_peak_scale, found.sunny_logit) == (None,) * 3


def test_five_maps_of_the_ldr_skys_size() -> None:
    """ "five intermediate representations with the same size as the input LDR"."""
    direction, peak = torch.tensor([[0.6, 0.0, 0.8]]), torch.tensor([6.0])
    maps = sun_encoding(direction, peak, ROWS)
    assert maps.shape == (1, 5, ROWS, WIDTH)
    position = direction_map(2 * ROWS, ROWS, maps.device)
    assert torch.equal(maps[:, :3], position)
    cosine = (position[0] * direction[0, :, None, None]).sum(dim=0)
    torch.testing.assert_close(maps[0, 3], torch.exp(100 * (cosine - 1)))
    bright = maps[0, 4] > 0
    assert bright.any()
    assert torch.equal(bright, maps[0, 3] > 0.9 * maps[0, 3].max())
    assert (maps[0, 4][bright] == 6.0 / 4.0).all()


def test_the_dome_depends_on_latent_intensity_and_direction_alone(
    network: PaperSkyNetwork,
) -> None:
    """Eq. 2: E = HDRdecoder(z_sky, [f_int, f_dir])."""
    batch = batch_of()
    found = network.encode(batch)
    dome = network.dome(batch, found, found.direction, found.log_peak)
    assert dome.shape == (4, 3, ROWS, WIDTH)
    assert (dome >= 0).all()
    other = batch.shown(torch.rand_like(batch.panorama), batch.seen)
    assert torch.equal(network.dome(other, found, found.direction, found.log_peak), dome)
    for changed in (
        network.decode(found.direction.flip(1).abs(), found.log_peak, found.latent, ROWS),
        network.decode(found.direction, found.log_peak + 20.0, found.latent, ROWS),
        network.decode(found.direction, found.log_peak, found.latent + 1.0, ROWS),
    ):
        assert not torch.allclose(changed, dome)


def test_the_loss_has_the_papers_three_terms(network: PaperSkyNetwork) -> None:
    """ "L1 angular loss, L1 peak intensity, and L2 HDR reconstruction loss in the log space"."""
    batch, sunny = batch_of(), batch_of(only_sunny=True)
    loss, terms = paper_sky_loss(
        network, lambda s: sunny if s else batch, torch.Generator().manual_seed(0)
    )
    assert set(terms) == {"angle", "peak", "hdr"}
    torch.testing.assert_close(loss, terms["angle"] + terms["peak"] + terms["hdr"])
    found = network.encode(batch)
    clear = network.encode(sunny).direction
    torch.testing.assert_close(terms["angle"], angles(clear, sunny.sun_direction).mean())
    torch.testing.assert_close(terms["peak"], (found.log_peak - batch.log_peak).abs().mean())
    forced = torch.rand(4, generator=torch.Generator().manual_seed(0)) < 0.5
    assert forced.any()
    assert not forced.all()
    dome = network.decode(
        torch.where(forced[:, None], batch.sun_direction, found.direction),
        torch.where(forced, batch.log_peak, found.log_peak),
        found.latent,
        ROWS,
    )
    expected = (log_radiance(dome) - log_radiance(batch.sky)).square().mean()
    torch.testing.assert_close(terms["hdr"], expected)


def test_all_skies_do_not_move_the_encoder_of_clear_suns(network: PaperSkyNetwork) -> None:
    """The dual encoder: f_dir learns from skies "with a clearly visible sun" alone."""
    batch = batch_of()
    _, terms = paper_sky_loss(network, lambda _: batch, torch.Generator().manual_seed(0))
    (terms["peak"] + terms["hdr"]).backward()
    assert all(p.grad is None for p in network.direction_encoder.parameters())
    assert all(p.grad is not None for p in network.latent_encoder.parameters())
