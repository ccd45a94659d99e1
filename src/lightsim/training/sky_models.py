"""All sky networks by name: the estimator, the paper's own form and the comparators of table A4."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from torch import Tensor, nn

from lightsim.baselines.nlfe import Nlfe, NlfeConfig, nlfe_loss
from lightsim.baselines.sold_net import SoldNet, SoldNetConfig, sold_net_loss
from lightsim.lighting.sky.network import SkyNetwork, SkyNetworkConfig, tensors_of
from lightsim.networks.loop import LoopConfig
from lightsim.training.sky import SkyRecipe, SkyTrainConfig
from lightsim.training.sky_losses import sky_loss

Preset = Literal["small", "full"]
SkyKind = Literal["lightsim", "lightsim_paper", "nlfe", "nlfe_panorama", "sold_net"]


def sky_recipe(
    kind: SkyKind, preset: Preset, seed: int = 0, *, inpaints: bool = False
) -> SkyRecipe:
    """What `training.sky.train_sky` needs to train one of the networks.

    `small` is for one CPU core (panoramas of 64 x 128): about 25 minutes for the estimator and 7
    for a comparator; `full` is for a GPU. The comparators' encoders and decoders are as wide as
    the estimator's. With `inpaints` the estimator looks at what the completion of `train_sky` made
    of the unseen, and not at smooth fills.
    """
    ours = SkyNetworkConfig() if preset == "small" else SkyNetworkConfig.full()
    ours = replace(ours, fills_unseen=not inpaints)
    steps = 2000 if preset == "small" else 30_000
    rate = 1.5e-3 if preset == "small" else 6e-4
    batch = 8 if preset == "small" else 32
    workers = 0 if preset == "small" else 8
    short = SkyTrainConfig(LoopConfig(steps), rate, batch=batch, seed=seed, workers=workers)
    long = replace(short, loop=LoopConfig(2 * steps))
    widths, decoder = ours.widths, ours.decoder_widths
    if kind == "lightsim":
        return SkyRecipe(SkyNetwork(ours, seed), sky_loss, long)
    if kind == "lightsim_paper":
        return SkyRecipe(SkyNetwork(SkyNetworkConfig.paper(), seed), sky_loss, long)
    if kind == "sold_net":
        config = SoldNetConfig(widths=widths, decoder_widths=decoder)
        return SkyRecipe(SoldNet(config, seed), sold_net_loss, short)
    nlfe = NlfeConfig(kind == "nlfe_panorama", widths=widths, decoder_widths=decoder)
    return SkyRecipe(Nlfe(nlfe, seed), nlfe_loss, short)


def weights_of(network: nn.Module) -> dict[str, Tensor]:
    """What `store.weights.write_weights` is given of a trained network."""
    return tensors_of(network) if isinstance(network, SkyNetwork) else network.state_dict()
