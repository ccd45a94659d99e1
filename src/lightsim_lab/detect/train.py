"""Training and test of a detector on samples."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lightsim.networks.devices import choose_device, device_of
from lightsim.networks.loop import Learner, Loss, Session, run_training
from lightsim.progress import Progress
from lightsim_lab.detect.config import DetectorConfig
from lightsim_lab.detect.model import Detector
from lightsim_lab.detect.pictures import Sample
from lightsim_lab.detect.targets import decode, encode, loss_of
from lightsim_lab.detect.trunk import load_trunk

# Pictures per batch of a test.
_TESTED_AT_ONCE = 16
# Number of steps whose time is measured.
_TIMED = 3


def make_detector(config: DetectorConfig, seed: int, trunk: Path | None, device: str) -> Detector:
    """Return a detector with random weights, and those of the trunk from a file if one is given.

    Raises:
        InputError: the file is not that of EfficientNet-Lite0, or there is no such device.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Detector(config)
    if trunk is not None:
        load_trunk(network.trunk, trunk)
    return network.to(choose_device(device))


def train_detector(
    network: Detector,
    recorded: Sequence[Sample],
    added: Sequence[Sample],
    seed: int,
    session: Session,
    label: str,
) -> int:
    """Train a detector in place on batches of equal parts of two sources; return the steps done.

    Pictures of a step depend on its seed and number alone, so that all methods see the same
    recorded pictures.

    Args:
        added: pictures of the second source, such as relit ones, or the recorded ones again.
    """
    config = network.config
    adam = torch.optim.AdamW(network.groups(), weight_decay=config.weight_decay)

    def losses(_: int, draw: int) -> Iterator[Loss]:
        rng = np.random.default_rng([seed, draw])
        half = config.batch // 2
        batch = [*_drawn(recorded, half, rng, config), *_drawn(added, half, rng, config)]
        focal, values = _loss(network, batch)
        yield "detector", focal + values, {"focal": focal, "values": values}

    return run_training(
        {"detector": Learner(network, (adam,))}, losses, config.loop, session, label
    )


def _drawn(
    samples: Sequence[Sample], count: int, rng: np.random.Generator, config: DetectorConfig
) -> list[Sample]:
    chosen = [samples[k] for k in rng.integers(len(samples), size=count)]
    flips = rng.integers(2, size=count)
    width = config.picture_px[0]
    return [s.mirrored(width) if flip else s for s, flip in zip(chosen, flips, strict=True)]


def _loss(network: Detector, samples: Sequence[Sample]) -> tuple[Tensor, Tensor]:
    inputs, projections = batch_of(samples, device_of(network))
    labels = [(s.boxes, s.ignored) for s in samples]
    target = torch.from_numpy(np.stack([encode(*pair, network.config) for pair in labels]))
    return loss_of(network(inputs, projections), target.to(inputs.device))


def batch_of(
    samples: Sequence[Sample], device: torch.device
) -> tuple[Tensor, Float[Tensor, "n 3 4"]]:
    """Return inputs and projections of a batch on a device."""
    inputs = torch.from_numpy(np.stack([s.inputs[0] for s in samples]))
    projections = np.stack([s.projection for s in samples]).astype(np.float32)
    return inputs.to(device), torch.from_numpy(projections).to(device)


@torch.no_grad()
def detect(
    network: Detector, samples: Sequence[Sample], progress: Progress
) -> list[tuple[Float[np.ndarray, "_ 7"], Float[np.ndarray, " _"]]]:
    """Return boxes and scores of every sample."""
    network.eval()
    found = []
    starts = range(0, len(samples), _TESTED_AT_ONCE)
    for start in progress.track(starts, "test", len(starts)):
        part = samples[start : start + _TESTED_AT_ONCE]
        inputs, projections = batch_of(part, device_of(network))
        maps = network(inputs, projections).float().cpu().numpy()
        found += [decode(one, network.config) for one in maps]
    return found


def seconds_per_step(network: Detector, samples: Sequence[Sample]) -> float:
    """Return the duration of a training step without that of the optimiser's update."""
    rng, start = np.random.default_rng(0), 0.0
    for k in range(1 + _TIMED):
        # The first step, which allocates memory, does not count.
        start = time.perf_counter() if k == 1 else start
        focal, values = _loss(network, _drawn(samples, network.config.batch, rng, network.config))
        (focal + values).backward()
    return (time.perf_counter() - start) / _TIMED
