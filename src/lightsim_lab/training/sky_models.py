"""Sky networks by name: the estimator, the paper's form and the baselines of table A4."""

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
# Networks whose input is the inpainted panorama; that of the others is the front image, or a
# panorama with smooth fills.
USES_INPAINTING: tuple[SkyKind, ...] = ("lightsim_paper", "nlfe_panorama")


@dataclass(frozen=True)
class _Form:
    """Config type, network type and loss of one kind of sky network."""

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
    """Return network, loss and settings for `training.sky.train_sky`.

    `small` is for one CPU core and 64 x 128 panoramas, `full` for a GPU and 128 x 256. All kinds
    have the same channel counts and number of steps, so that the comparison is fair.

    Args:
        part: "direction" trains the estimator's direction encoder alone.

    Raises:
        InputError: the network has no such part.
    """
    form = _FORMS[kind]
    if part != "all" and kind != "lightsim":
        raise InputError(
            "only the estimator has parts that train alone",
            where="--part",
            got=f"{part} of {kind}",
            expected="--network lightsim",
        )
    is_small = preset == "small"
    # All networks have the channel counts of the paper's form.
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
    """Return the settings with initial weights from a file, at a quarter of the learning rate.

    Raises:
        InputError: the weights belong to another network.
    """
    network = network_of(tensors)
    expected = getattr(recipe.network, "config", None)
    if type(network) is not type(recipe.network) or getattr(network, "config", None) != expected:
        raise InputError(
            "the initial weights belong to another network",
            where="--start",
            got=f"{getattr(network, 'config', None)}",
            expected=f"{expected}",
        )
    # A quarter of the rate, as the weights are already trained. Sensitivity not measured.
    config = replace(recipe.config, rate=recipe.config.rate / 4)
    return replace(recipe, network=network, config=config)


def weights_of(kind: SkyKind, network: nn.Module) -> dict[str, Tensor]:
    """Return the tensors of a trained network for `store.weights.write_weights`."""
    return stored_tensors(network, network.config, kind)


def network_of(tensors: Mapping[str, Tensor]) -> nn.Module:
    """Return the network of stored weights, ready for use.

    Raises:
        InputError: the weights belong to no sky network.
    """
    try:
        kind, values = stored_config(tensors)
        form = _FORMS[kind]  # type: ignore[index]
    except (KeyError, ValueError) as error:
        raise InputError(
            "the weights belong to no sky network",
            got=f"{type(error).__name__}: {error}"[:200],
            expected=f"one of {', '.join(get_args(SkyKind))}",
            remedy="Give weights of lightsim train sky or baseline.",
        ) from error
    network = form.network(form.config(**values))
    load_stored(network, tensors)
    return network
