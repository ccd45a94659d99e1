"""Training of the baselines on frames whose error is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.training.test_relight import made_sample
from tests.training.test_relight import streets as streets

from lightsim import cli
from lightsim.core.equirect import sample_bilinear
from lightsim.errors import InputError
from lightsim.relighting.baselines.epe import EpeNet
from lightsim.relighting.baselines.self_osr import WHITE, SelfOsrConfig, SelfOsrNet, lighting_of
from lightsim.relighting.network.stored import network_of
from lightsim.store.weights import read_record, read_weights
from lightsim.training.baseline_data import BaselineData, camera_gain
from lightsim.training.options import RelightTrainingOptions
from lightsim.training.relight_baselines import BaselineTrainConfig, self_osr_loss
from lightsim.training.relight_cache import RelightSample, RelightTargetSample
from lightsim.training.relight_data import RelightDataConfig
from lightsim.training.relight_losses import Perceptual
from lightsim.training.run_relight import train

GAIN = np.array([0.5, 0.8, 1.2], np.float32)


def sample_of_gain(rng: np.random.Generator) -> RelightSample:
    """The target sky behind every pixel is its dome's, as a camera of GAIN shows it."""
    sample = made_sample(rng)
    target = sample.targets["low_sun"]
    dome = rng.uniform(0.1, 1, target.planes["target_dome"].shape).astype(np.float32)
    position = rng.normal(size=sample.scene["position"].shape).astype(np.float32)
    right, forward, up = position / np.linalg.norm(position, axis=0)
    directions = np.stack([forward, -right, up], axis=-1)
    sky = sample_bilinear(np.moveaxis(dome, 0, -1), directions) * GAIN
    planes = target.planes | {"target_dome": dome, "target_sky": np.moveaxis(sky, -1, 0)}
    scene = sample.scene | {"position": position}
    return RelightSample(scene, {"low_sun": RelightTargetSample(planes, target.truth)})


def test_the_cameras_gain_is_found_where_pixels_look_down(rng: np.random.Generator) -> None:
    sample = sample_of_gain(rng)
    np.testing.assert_allclose(camera_gain(sample), GAIN, rtol=1e-4)
    high = sample.scene["position"].copy()
    high[2] = np.abs(high[2])
    assert np.array_equal(
        camera_gain(replace(sample, scene=sample.scene | {"position": high})),
        np.ones(3, np.float32),
    )


def test_light_of_domes_follows_exposure_and_mirrors(streets: Path) -> None:
    """Brighter pictures have brighter light; of a mirrored one it comes from the other side."""
    plain = RelightDataConfig(exposure_ev=0.0, identity_fraction=0.0, light_error_ev=0.0)
    one = BaselineData([streets / "1"], plain).batch(0, 0)
    ratios = (one.planes[WHITE][:, :, 0, 0] / one.planes[WHITE][:, :, 0, 0]).flatten()
    varied = BaselineData([streets / "1"], replace(plain, exposure_ev=2.0)).batch(0, 0)
    brighter = varied.planes["target_shaded"].mean() / one.planes["target_shaded"].mean()
    assert torch.allclose(ratios, torch.ones_like(ratios))
    assert brighter != 1
    white = [x.planes[WHITE].mean((1, 2, 3)) for x in (varied, one)]
    shaded = [x.planes["target_shaded"].mean((1, 2, 3)) for x in (varied, one)]
    torch.testing.assert_close(white[0] / white[1], shaded[0] / shaded[1], rtol=2e-3, atol=0)
    light = [lighting_of(x.planes, "target")[:, 0, 0] for x in (varied, one)]
    torch.testing.assert_close(light[0] / light[1], white[0] / white[1], rtol=2e-3, atol=0)


def test_steps_lower_the_loss_of_self_osr(streets: Path) -> None:
    torch.manual_seed(0)
    config = BaselineTrainConfig(SelfOsrConfig(widths=(8, 16), shadow_widths=(8, 16)))
    network, perceptual = SelfOsrNet(config.network), Perceptual()  # type: ignore[arg-type]
    batch = BaselineData([streets / "1"], RelightDataConfig(batch=2)).batch(0, 0)
    adam = torch.optim.AdamW(network.parameters(), 1e-2)
    found = []
    for _ in range(12):
        loss, terms = self_osr_loss(network, batch, perceptual, config)
        adam.zero_grad()
        loss.backward()
        adam.step()
        found.append(float(loss.detach()))
        assert all(bool(torch.isfinite(value)) for value in terms.values())
    assert found[-1] < 0.9 * found[0]


@pytest.mark.parametrize(("network", "kind"), [("self-osr", SelfOsrNet), ("epe", EpeNet)])
def test_the_command_trains_and_scores_a_baseline(
    network: str, kind: type, streets: Path, tmp_path: Path
) -> None:
    words = ["train", "relight", "--data", str(streets), "--out", str(tmp_path), "--device", "cpu"]
    cli.main([*words, "--network", network, "--steps", "2", "--validation", "2"])
    row = json.loads((tmp_path / "scores.json").read_text())["low_sun"]
    assert {"network", "physical", "copy"} == set(row)
    weights = tmp_path / "weights.safetensors"
    assert isinstance(network_of(read_weights(weights)), kind)
    assert network in read_record(weights).command


def test_ablations_are_not_of_baselines(streets: Path, tmp_path: Path) -> None:
    given = RelightTrainingOptions(data=streets, out=tmp_path, network="epe", without=("buffers",))
    with pytest.raises(InputError, match="ablations"):
        train(given)
