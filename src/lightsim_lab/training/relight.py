"""Training of RelitNet and of the paper's relighting network."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from lightsim.errors import InputError
from lightsim.networks.devices import choose_device
from lightsim.networks.loop import LoopConfig, Loss, Session
from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import RemovedInput, srgb_of
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.relighting.network.stored import make_network, network_of
from lightsim.store.weights import read_weights
from lightsim_lab.baselines.methods import all_kinds
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_loop import FrameTrainConfig, learner_of, train_on_frames
from lightsim_lab.training.relight_losses import (
    Perceptual,
    colour_loss,
    error_loss,
    paper_terms,
    picture_terms,
    shown,
)
from lightsim_lab.training.relight_pairs import RelightBatch

# Largest shift of the frames in the stability loss, in pixels. The network's finest stage works on
# pairs of pixels, so shifts of 1 to 3 px cover odd and even offsets. Sensitivity not measured.
_LARGEST_SHIFT_PX = 3


@dataclass(frozen=True, kw_only=True)
class RelightTrainConfig(FrameTrainConfig):
    """Settings of the training of a relighting network; the defaults are those of RelitNet."""

    network: RelitNetConfig | PaperNetConfig = field(default_factory=RelitNetConfig)
    """Kind and size of the network."""
    perception: float = 0.15
    """Weight of LPIPS; the weight of the colour loss is 1."""
    perception_crops: int = 2
    """Number of crops per step that LPIPS (ten times the cost of the network) and the stability
    loss are evaluated on."""
    stability: float = 0.5
    """Weight of the change of the result when the frame shifts by a few pixels; it reduces flicker
    in videos (Eilertsen et al. 2019, doi:10.1109/CVPR.2019.01143)."""
    error: float = 0.05
    """Weight of the likelihood of the predicted error; its gradient does not reach the picture."""


def full() -> RelightTrainConfig:
    """Return the settings for a GPU: three times as many weights, larger crops and batches."""
    return RelightTrainConfig(
        network=RelitNetConfig(widths=(48, 96, 160, 224, 256)),
        loop=LoopConfig(
            steps=60000,
            warm_up_steps=500,
            average_decay=0.9995,
            mixed_precision=True,
            is_mixed_on_cpu=True,
        ),
        perception_crops=8,
        workers=8,
        data=RelightDataConfig(batch=32, crop_px=(192, 192)),
    )


def paper(config: RelightTrainConfig) -> RelightTrainConfig:
    """Return a config with the network, pairs, augmentation and losses of the paper, and the loop,
    crops and batch of another, which are not published.

    Source: Sec. 4, "Learning", and appendix, "Learning details".
    """
    data = replace(
        config.data,
        # The kinds of pairs are published, their fractions are not: chosen, not measured.
        sim_sim_fraction=0.45,
        sim_real_fraction=0.45,
        identity_fraction=0.1,
        true_twin_fraction=0.0,
        # "Random intensity" of the target skies; the range is not published. Chosen: half to twice.
        intensity_ev=(-1.0, 1.0),
        # No other change of light or surfaces is published.
        exposure_ev=(0.0, 0.0),
        light_error_ev=0.0,
        paint_ev=(0.0, 0.0),
    )
    return replace(
        config,
        network=PaperNetConfig(tile_px=max(data.crop_px)),
        perception=1.0,  # lambda_lpips
        edges=400.0,  # lambda_edge
        # L_lpips is a mean over all pictures.
        perception_crops=data.batch,
        error=0.0,
        stability=0.0,
        data=data,
    )


# Kinds of training pairs that an ablation can leave out.
Pairs = Literal["sim-real", "identity", "truth"]


def ablated(
    config: RelightTrainConfig, parts: Collection[Pairs | RemovedInput]
) -> RelightTrainConfig:
    """Return the config without some kinds of pairs or inputs (paper, table A2, and more)."""
    data = config.data
    # The other kinds of pairs take over the fraction of the omitted kind, in proportion.
    if "sim-real" in parts:
        more = data.sim_sim_fraction + data.sim_real_fraction
        data = replace(data, sim_sim_fraction=more, sim_real_fraction=0.0)
    if "identity" in parts:
        more = 1 / (1 - data.identity_fraction)
        data = replace(
            data,
            identity_fraction=0.0,
            sim_sim_fraction=more * data.sim_sim_fraction,
            sim_real_fraction=more * data.sim_real_fraction,
            true_twin_fraction=more * data.true_twin_fraction,
        )
    if "truth" in parts:
        half = (1 - data.identity_fraction) / 2
        data = replace(data, sim_sim_fraction=half, sim_real_fraction=half, true_twin_fraction=0.0)
    unseen = tuple(part for part in parts if part in get_args(RemovedInput))
    return replace(config, data=data, network=replace(config.network, unseen=unseen))


def train_relight(
    config: RelightTrainConfig, data: RelightData, session: Session, start: Path | None = None
) -> tuple[RelitNet | PaperNet, int]:
    """Train a relighting network; return it and the number of steps done.

    Args:
        start: file of initial weights, used where there is no checkpoint; None: random weights.

    Raises:
        ArtefactError: the checkpoint belongs to another network, or `start` is damaged.
        InputError: `start` contains weights of another network.
    """
    device = choose_device(session.device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = make_network(config.network) if start is None else _read(config.network, start)
    learners = {"network": learner_of(network, config, device)}
    perceptual = Perceptual().to(device)

    def losses(batch: RelightBatch, draw: int) -> Iterator[Loss]:
        if isinstance(network, PaperNet):
            yield "network", *paper_loss(network, batch, perceptual, config)
        else:
            yield "network", *_loss(network, batch, perceptual, config, draw)

    label = "train relighting"
    return network, train_on_frames(learners, losses, data, config, session, label)


def _read(config: RelitNetConfig | PaperNetConfig, start: Path) -> RelitNet | PaperNet:
    """Return the network with this config from a weights file.

    The file may contain several networks whose results are averaged in use.
    """
    network = network_of(read_weights(start), all_kinds())
    for one in network.alone() if isinstance(network, RelitNet) else [network]:
        if one.config == config:
            return one
    raise InputError(
        "the file of initial weights belongs to another network",
        where=start,
        got=network.config,
        expected=config,
        remedy="Omit --start, or give weights of this network and size.",
    )


def paper_loss(
    network: PaperNet, batch: RelightBatch, perceptual: Perceptual, config: RelightTrainConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return L_relight of the paper for a batch, and its terms."""
    made, crops = network(batch.planes), config.perception_crops
    terms = paper_terms(made, batch.truth, batch.weight, perceptual, crops)
    total = terms["colour"] + config.perception * terms["lpips"] + config.edges * terms["edges"]
    return total, terms


def _loss(
    network: RelitNet,
    batch: RelightBatch,
    perceptual: Perceptual,
    config: RelightTrainConfig,
    draw: int,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the total loss of RelitNet for a batch, and its terms."""
    count, weight = len(batch.truth), batch.weight
    few = slice(config.perception_crops)
    # The shift depends on the draw number alone, so that a resumed run repeats it.
    shift_px = (1 + draw % _LARGEST_SHIFT_PX, 1 + draw // _LARGEST_SHIFT_PX % _LARGEST_SHIFT_PX)
    found = network(_with_moved(batch.planes, few, shift_px))
    pictures = shown(srgb_of(found.picture))
    made, moved = pictures[:count], pictures[count:]
    terms = picture_terms(made, batch.truth, weight, perceptual, config.perception_crops)
    # `roll` wraps around the border, which therefore does not count.
    inside = (
        ...,
        slice(_LARGEST_SHIFT_PX, -_LARGEST_SHIFT_PX),
        slice(_LARGEST_SHIFT_PX, -_LARGEST_SHIFT_PX),
    )
    back = moved.roll([-px for px in shift_px], (-2, -1))
    terms["stability"] = colour_loss(back[inside], made[few][inside], weight[few][inside])
    terms["error"] = error_loss(found.log_error[:count], made, batch.truth, weight)
    total = terms["colour"] + config.edges * terms["edges"] + config.perception * terms["lpips"]
    total = total + config.stability * terms["stability"] + config.error * terms["error"]
    if "target_physical" in batch.planes:
        # Reference in the log: the colour loss of the uncorrected physical estimate.
        physical = shown(srgb_of(batch.planes["target_physical"]))
        terms["physical"] = colour_loss(physical, batch.truth, weight).detach()
    return total, terms


def _with_moved(
    planes: dict[str, Tensor], few: slice, shift_px: tuple[int, int]
) -> dict[str, Tensor]:
    """Append shifted copies (down and to the right) of the first samples to a batch."""
    return {
        name: torch.cat(
            [value, value[few] if name.endswith(OF_SKIES) else value[few].roll(shift_px, (-2, -1))]
        )
        for name, value in planes.items()
    }
