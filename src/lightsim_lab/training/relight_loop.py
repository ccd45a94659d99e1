"""Settings and training loop that the relighting networks and their baselines have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import nn

from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim_lab.training.prefetch import Prefetcher
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_pairs import RelightBatch


@dataclass(frozen=True, kw_only=True)
class FrameTrainConfig:
    """Settings of a training on frames; the defaults are those of `--preset small`."""

    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            steps=20000, warm_up_steps=300, average_decay=0.999, is_mixed_on_cpu=True
        )
    )
    """Number of steps, and averaging of the weights."""
    rate: float = 1e-3
    """Highest learning rate of AdamW."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW."""
    perception: float
    """Weight of LPIPS; the weight of the colour loss is 1."""
    edges: float = 0.5
    """Weight of the edge loss."""
    perception_crops: int
    """Number of crops per step that LPIPS is evaluated on."""
    seed: int = 0
    """Seed of the initial weights and of the batches."""
    workers: int = 0
    """Threads that prepare batches in advance."""
    data: RelightDataConfig = field(default_factory=RelightDataConfig)
    """Cropping and augmentation of the frames."""


def learner_of(network: nn.Module, config: FrameTrainConfig, device: torch.device) -> Learner:
    """Move a network to a device, and return it with AdamW and averaged weights."""
    # Channels-last storage is the fast layout of convolutions in mixed precision.
    moved = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    adam = torch.optim.AdamW(moved.parameters(), config.rate, weight_decay=config.weight_decay)
    return Learner(moved, (adam,), is_averaged=True)


def train_on_frames(
    learners: Mapping[str, Learner],
    losses: Callable[[RelightBatch, int], Iterator[Loss]],
    data: RelightData,
    config: FrameTrainConfig,
    session: Session,
    label: str,
) -> int:
    """Train networks on batches of frames; return the number of steps done.

    Args:
        learners: networks on the session's device, by name.
        losses: losses of a batch on the device and its draw number.
        label: text of the progress bar.

    Raises:
        ArtefactError: the checkpoint belongs to another network.
    """
    device, count = choose_device(session.device), session.processes.count
    data = data.on(device)

    def of_draw(_: int, draw: int) -> Iterator[Loss]:
        return losses(batches.get(draw).on(device), draw)

    with Prefetcher(
        lambda draw: data.batch(draw, config.seed),
        # Frames in CUDA memory are cropped on the GPU, so no CPU threads are used.
        config.workers if data.device.type == "cpu" else 0,
        count,
        count * config.loop.steps,
    ) as batches:
        return run_training(learners, of_draw, config.loop, session, label)
