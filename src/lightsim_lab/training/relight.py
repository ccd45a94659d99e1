"""Training of the relighting networks, ours and the paper's, through the one training loop."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from lightsim.errors import InputError
from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import Unseen, srgb_of
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.relighting.network.stored import make_network, network_of
from lightsim.store.weights import read_weights
from lightsim_lab.baselines.methods import all_kinds
from lightsim_lab.training.ahead import Ahead
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_losses import (
    Perceptual,
    colour_loss,
    error_loss,
    even_loss,
    picture_terms,
    shown,
)
from lightsim_lab.training.relight_pairs import RelightBatch

_MOST_PX = 3
"""By which frames are moved: the network looks at pairs of pixels, and at every 16th at its
lowest."""


@dataclass(frozen=True)
class RelightTrainConfig:
    """How a relighting network is trained; the defaults are those of `--method network`."""

    network: RelitNetConfig | PaperNetConfig = field(default_factory=RelitNetConfig)
    """Which network, and its size."""
    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            steps=20000, warm_up_steps=300, average_decay=0.999, is_mixed_on_cpu=True
        )
    )
    """Steps and averages."""
    rate: float = 1e-3
    """Highest learning rate (AdamW)."""
    weight_decay: float = 1e-2
    """Of AdamW."""
    knee: float | None = None
    """Of the colour's error, above which it counts by its logarithm (`even_loss`)."""
    perception: float = 0.15
    """Weight of LPIPS beside that of colour, which is 1."""
    edges: float = 0.5
    """Weight of the edges' difference."""
    edge_pixels_px: tuple[int, ...] = (1,)
    """Edges are compared with pixels so many times as large, too (`edge_loss`)."""
    stability: float = 0.5
    """Weight of how the picture changes when the frame moves by a few pixels, so that videos do not
    flicker (single frames tell: Eilertsen et al. 2019, doi:10.1109/CVPR.2019.01143)."""
    error: float = 0.05
    """Weight of the expected error's likelihood, on which the picture does not depend."""
    perception_crops: int = 2
    """Crops of a step that LPIPS looks at, which costs ten times as much as the network, and that
    are moved."""
    seed: int = 0
    """Of first weights and batches."""
    workers: int = 0
    """Threads that make batches ahead of their use."""
    data: RelightDataConfig = field(default_factory=RelightDataConfig)
    """How frames are shown."""


def full() -> RelightTrainConfig:
    """For a GPU: three times as many weights, whole pictures, larger batches."""
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
    """The paper's network, pairs and weights of losses (Sec. 4, "Learning"; appendix, "Learning
    details": lambda_lpips = 1, lambda_edge = 400 on squared differences), with the loop of another
    config. In what parts pairs are mixed is not published."""
    data = replace(
        config.data,
        sim_sim_fraction=0.45,
        sim_real_fraction=0.45,
        true_twin_fraction=0.0,
        identity_fraction=0.1,
    )
    return replace(
        config,
        network=PaperNetConfig(),
        perception=1.0,
        edges=400.0,
        edge_pixels_px=(1,),
        error=0.0,
        stability=0.0,
        data=data,
    )


Pairs = Literal["sim-real", "identity", "truth"]
"""Kinds of pairs that ablations leave out."""


def ablated(config: RelightTrainConfig, parts: Collection[Pairs | Unseen]) -> RelightTrainConfig:
    """The config without some parts (paper, table A2, and ours)."""
    data = config.data
    if "sim-real" in parts:
        more = data.sim_sim_fraction + data.sim_real_fraction
        data = replace(data, sim_sim_fraction=more, sim_real_fraction=0.0)
    if "identity" in parts:
        data = replace(data, identity_fraction=0.0)
    if "truth" in parts:
        half = (1 - data.identity_fraction) / 2
        data = replace(data, sim_sim_fraction=half, sim_real_fraction=half, true_twin_fraction=0.0)
    unseen = tuple(part for part in parts if part in get_args(Unseen))
    return replace(config, data=data, network=replace(config.network, unseen=unseen))


def train_relight(
    config: RelightTrainConfig, data: RelightData, session: Session, start: Path | None = None
) -> tuple[RelitNet | PaperNet, int]:
    """The network, and the number of steps done.

    Args:
        start: weights to go on from, where there is no checkpoint.

    Raises:
        ArtefactError: the checkpoint belongs to another network, or the start is damaged.
        InputError: the start belongs to another network.
    """
    device = choose_device(session.device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = make_network(config.network) if start is None else _read(config.network, start)
    network = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    adam = torch.optim.AdamW(network.parameters(), config.rate, weight_decay=config.weight_decay)
    perceptual = Perceptual().to(device)
    count = session.processes.count

    def losses(step: int, draw: int) -> Iterator[Loss]:
        total, terms = _loss(network, batches.get(draw).on(device), perceptual, config, draw)
        yield "network", total, terms

    data = data.on(device)
    with Ahead(
        lambda draw: data.batch(draw, config.seed),
        config.workers if data.device.type == "cpu" else 0,
        count,
        count * config.loop.steps,
    ) as batches:
        learners = {"network": Learner(network, (adam,), is_averaged=True)}
        done = run_training(learners, losses, config.loop, session, "train relighting")
    return network, done


def _read(config: RelitNetConfig | PaperNetConfig, start: Path) -> RelitNet | PaperNet:
    """The network of this config among those of a file, whose pictures may be averaged."""
    network = network_of(read_weights(start), all_kinds())
    for one in network.alone() if isinstance(network, RelitNet) else [network]:
        if one.config == config:
            return one
    raise InputError(
        "these are weights of another network",
        where=start,
        got=network.config,
        expected=config,
        remedy="Train from random weights, or give others for --start.",
    )


def _loss(
    network: RelitNet | PaperNet,
    batch: RelightBatch,
    perceptual: Perceptual,
    config: RelightTrainConfig,
    draw: int,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Of the weights in `config`; the paper's network minimises squares."""
    count = len(batch.truth)
    few = slice(config.perception_crops)
    shift_px = (1 + draw % _MOST_PX, 1 + draw // _MOST_PX % _MOST_PX)
    found = network(_with_moved(batch.planes, few, shift_px) if config.stability else batch.planes)
    is_paper = isinstance(found, Tensor)
    pictures = found if is_paper else shown(srgb_of(found.picture))
    made, moved = pictures[:count], pictures[count:]
    weight = batch.weight
    terms = picture_terms(
        made, batch.truth, weight, perceptual, config.perception_crops, config.edge_pixels_px
    )
    if config.stability:
        inside = (..., slice(_MOST_PX, -_MOST_PX), slice(_MOST_PX, -_MOST_PX))
        back = moved.roll([-px for px in shift_px], (-2, -1))
        terms["stability"] = colour_loss(back[inside], made[few][inside], weight[few][inside])
    if is_paper:
        total = terms["colour"].square() + config.edges * terms["edges"].square()
    else:
        terms["error"] = error_loss(found.log_error[:count], made, batch.truth, weight)
        colour = terms["colour"]
        if config.knee is not None:
            # Twice: at the knee it pulls as hard as without one.
            colour = terms["even"] = 2 * even_loss(made, batch.truth, weight, config.knee)
        total = colour + config.edges * terms["edges"] + config.error * terms["error"]
        if "target_physical" in batch.planes:
            # Beside what the physical estimate has, a step's colour tells what has been learned.
            physical = shown(srgb_of(batch.planes["target_physical"]))
            terms["physical"] = colour_loss(physical, batch.truth, weight).detach()
    if config.stability:
        total = total + config.stability * terms["stability"]
    return total + config.perception * terms["lpips"], terms


def _with_moved(
    planes: dict[str, Tensor], few: slice, shift_px: tuple[int, int]
) -> dict[str, Tensor]:
    """Some of the samples come again at the end, moved down and to the right."""
    return {
        name: torch.cat(
            [value, value[few] if name.endswith(OF_SKIES) else value[few].roll(shift_px, (-2, -1))]
        )
        for name, value in planes.items()
    }
