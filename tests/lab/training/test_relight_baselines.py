"""Training of the baselines on frames whose error is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.lab.training.test_relight import streets as streets

from lightsim import cli
from lightsim.errors import InputError
from lightsim.relighting.network.stored import network_of
from lightsim.store.weights import read_record, read_weights
from lightsim_lab.baselines.epe import EpeNet
from lightsim_lab.baselines.methods import all_kinds
from lightsim_lab.baselines.self_osr import SelfOsrConfig, SelfOsrNet, lighting_of
from lightsim_lab.training.options import RelightTrainingOptions
from lightsim_lab.training.relight_baselines import BaselineTrainConfig, self_osr_loss
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_losses import Perceptual
from lightsim_lab.training.run_relight import train


def test_light_of_domes_follows_the_exposure(streets: Path) -> None:
    """Brighter pictures have brighter light, whichever way it is told."""
    plain = RelightDataConfig(exposure_ev=(0.0, 0.0), identity_fraction=0.0, light_error_ev=0.0)
    varied, one = (
        RelightData([streets / "1"], config).batch(0, 0).planes
        for config in (replace(plain, exposure_ev=(-2.0, 2.0)), plain)
    )
    shaded = varied["target_shaded"].mean((1, 2, 3)) / one["target_shaded"].mean((1, 2, 3))
    assert float(shaded.std()) > 0.1
    for which in ("source", "target"):
        light = [lighting_of(planes, which)[:, 0, 0] for planes in (varied, one)]
        torch.testing.assert_close(light[0] / light[1], shaded, rtol=2e-3, atol=0)


def test_steps_lower_the_loss_of_self_osr(streets: Path) -> None:
    torch.manual_seed(0)
    config = BaselineTrainConfig(network=SelfOsrConfig(widths=(8, 16), shadow_widths=(8, 16)))
    network, perceptual = SelfOsrNet(config.network), Perceptual()  # type: ignore[arg-type]
    batch = RelightData([streets / "1"], RelightDataConfig(batch=2)).batch(0, 0)
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
    assert isinstance(network_of(read_weights(weights), all_kinds()), kind)
    assert network in read_record(weights).command


def test_ablations_are_not_of_baselines(streets: Path, tmp_path: Path) -> None:
    given = RelightTrainingOptions(data=streets, out=tmp_path, network="epe", without=("buffers",))
    with pytest.raises(InputError, match="baselines do not have this option"):
        train(given)
