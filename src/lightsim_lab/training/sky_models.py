"""All sky networks by name: the estimator, the paper's own form and the comparators of table A4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from torch import Tensor, nn

from lightsim.errors import InputError
from lightsim.lighting.sky.network import SkyNetwork, SkyNetworkConfig
from lightsim.lighting.sky.paper_network import PaperSkyConfig, PaperSkyNetwork
from lightsim.networks.loop import LoopConfig
from lightsim.networks.stored import load_stored, stored_config, stored_tensors
from lightsim_lab.baselines.lighting.nlfe import Nlfe, NlfeConfig, nlfe_loss
from lightsim_lab.baselines.lighting.sold_net import SoldNet, SoldNetConfig, sold_net_loss
from lightsim_lab.training.sky import LossFunction, SkyRecipe, SkyTrainConfig
from lightsim_lab.training.sky_losses import direction_loss, paper_sky_loss, sky_loss

Preset = Literal["small", "full"]
SkyKind = Literal["lightsim", "lightsim_paper", "nlfe", "nlfe_panorama", "sold_net"]
SkyPart = Literal["all", "direction"]
USES_INPAINTING: tuple[SkyKind, ...] = ("lightsim_paper", "nlfe_panorama")
"""These look at what the completion painted; the others at the front picture, or at smooth fills
of their own."""


@dataclass(frozen=True)
class _Form:
    """What the networks of a kind are made of."""

    config: type[Any]
    network: type[nn.Module]
    loss: LossFunction


_FORMS: dict[SkyKind, _Form] = {
    "lightsim": _Form(SkyNetworkConfig, SkyNetwork, sky_loss),
    "lightsim_paper": _Form(PaperSkyConfig, PaperSkyNetwork, paper_sky_loss),
    "nlfe": _Form(NlfeConfig, Nlfe, nlfe_loss),
    "nlfe_panorama": _Form(NlfeConfig, Nlfe, nlfe_loss),
    "sold_net": _Form(SoldNetConfig, SoldNet, sold_net_loss),
}


def sky_recipe(kind: SkyKind, preset: Preset, seed: int = 0, part: SkyPart = "all") -> SkyRecipe:
    """What `training.sky.train_sky` needs to train one of the networks.

    `small` is for one CPU core and panoramas of 64 x 128, `full` for a GPU and 128 x 256. All are
    equally wide and, by default, take equally many steps.

    Args:
        part: "direction" trains the estimator's encoder of the sun's direction alone.

    Raises:
        InputError: the network has no such part.
    """
    form = _FORMS[kind]
    if part != "all" and kind != "lightsim":
        raise InputError(
            "only the estimator's direction is trained alone",
            where="--part",
            got=f"{part} of {kind}",
            expected="--network lightsim",
        )
    is_small = preset == "small"
    sizes = PaperSkyConfig() if is_small else PaperSkyConfig.full()
    options: dict[str, Any] = {"widths": sizes.widths, "decoder_widths": sizes.decoder_widths}
    if kind.startswith("nlfe"):
        options["from_panorama"] = kind == "nlfe_panorama"
    elif kind != "sold_net":
        options["height_px"] = sizes.height_px
    config = SkyTrainConfig(
        LoopConfig(4000 if is_small else 60_000),
        1.5e-3 if is_small else 6e-4,
        batch=8 if is_small else 32,
        seed=seed,
        workers=0 if is_small else 8,
    )
    network = form.network(form.config(**options), seed)
    loss = form.loss if part == "all" else direction_loss
    return SkyRecipe(network, loss, config, sizes.height_px)


def started_from(recipe: SkyRecipe, tensors: Mapping[str, Tensor]) -> SkyRecipe:
    """The recipe with a network that goes on from stored weights, more slowly.

    Raises:
        InputError: they are of another network.
    """
    network = network_of(tensors)
    expected = getattr(recipe.network, "config", None)
    if type(network) is not type(recipe.network) or getattr(network, "config", None) != expected:
        raise InputError(
            "the weights to start from are of another network",
            where="--start",
            got=f"{getattr(network, 'config', None)}",
            expected=f"{expected}",
        )
    config = replace(recipe.config, rate=recipe.config.rate / 4)
    return replace(recipe, network=network, config=config)


def weights_of(kind: SkyKind, network: nn.Module) -> dict[str, Tensor]:
    """What `store.weights.write_weights` is given of a trained network."""
    return stored_tensors(network, network.config, kind)


def network_of(tensors: Mapping[str, Tensor]) -> nn.Module:
    """The network whose weights these are, ready for use.

    Raises:
        InputError: they are of no sky network.
    """
    try:
        kind, values = stored_config(tensors)
        form = _FORMS[kind]  # type: ignore[index]
    except (KeyError, ValueError) as error:
        raise InputError(
            "the weights are of no sky network",
            got=f"{type(error).__name__}: {error}"[:200],
            expected=f"one of {', '.join(get_args(SkyKind))}",
            remedy="Give weights that lightsim train sky or baseline wrote.",
        ) from error
    network = form.network(form.config(**values))
    load_stored(network, tensors)
    return network
