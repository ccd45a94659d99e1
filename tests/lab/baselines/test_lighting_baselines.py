"""Re-implemented comparators of lighting estimation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.lighting.fake_skies import FakeSkies

from journals import MemoryJournal
from lightsim.lighting.sky.panorama_layers import direction_map
from lightsim.networks.loop import LoopConfig
from lightsim_lab.baselines.lighting.sold_net import cell_of
from lightsim_lab.training.sky import SkyTrainConfig, train_sky
from lightsim_lab.training.sky_models import SkyKind, sky_recipe, weights_of
from lightsim_lab.training.sky_scores import SkyModel, evaluate_sky_networks

KINDS: tuple[SkyKind, ...] = ("nlfe", "nlfe_panorama", "sold_net")


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_moves_every_parameter_and_the_network_is_scored(kind: SkyKind) -> None:
    recipe, again = sky_recipe(kind, "small"), sky_recipe(kind, "small")
    before = {k: v.clone() for k, v in recipe.network.state_dict().items()}
    data, config = FakeSkies(recipe.height_px), SkyTrainConfig(LoopConfig(steps=2), batch=2)
    for made in (recipe, again):
        train_sky(replace(made, config=config), data, MemoryJournal().session())
    still = [k for k, v in recipe.network.state_dict().items() if torch.equal(v, before[k])]
    assert still == []
    stored = weights_of(kind, recipe.network)
    for name, value in again.network.state_dict().items():
        assert torch.equal(value, stored[name])
    assert isinstance(recipe.network, SkyModel)
    drawn = [data.batch(4, 0, 0, only_sunny=False)]
    rows = evaluate_sky_networks(drawn, {kind: recipe.network}, drawn)
    assert [row.name for row in rows] == ["constant", "brightest pixel", kind]
    assert np.isfinite(rows[-1].decoding_angle_deg)


def test_estimator_has_the_recipe_of_a_network_trained_on_clear_suns() -> None:
    recipe = sky_recipe("lightsim", "small")
    assert "config_json" in weights_of("lightsim", recipe.network)


def test_cells_are_those_of_a_small_panorama() -> None:
    centres = direction_map(16, 8, torch.device("cpu"))[0].flatten(1).T
    assert torch.equal(cell_of(centres), torch.arange(256))
