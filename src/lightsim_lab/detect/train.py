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
from lightsim_lab.detect.boxes import Detections
from lightsim_lab.detect.config import DetectorConfig
from lightsim_lab.detect.model import Detector
from lightsim_lab.detect.pictures import Sample
from lightsim_lab.detect.targets import decode, encode, loss_of
from lightsim_lab.detect.trunk import Trunk, load_trunk

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
        # A random trunk is the same for all seeds, because its features are computed once.
        torch.manual_seed(0)
        made = Trunk()
        torch.manual_seed(seed)
        network = Detector(config, made)
    if trunk is not None:
        load_trunk(made, trunk)
    return network.to(choose_device(device))


def train_detector(
    network: Detector,
    sources: tuple[Sequence[Sample], Sequence[Sample]],
    seed: int,
    session: Session,
    label: str,
) -> int:
    """Train a detector in place on batches of equal parts of two sources; return the steps done.

    The pictures of a step depend on its seed and number alone, so that all rows of the experiment
    see the same recorded pictures.

    Args:
        sources: recorded pictures, and others such as relit ones, or the recorded ones again.
    """
    config = network.config
    adam = torch.optim.AdamW(network.groups(), weight_decay=config.weight_decay)

    def losses(_: int, draw: int) -> Iterator[Loss]:
        rng = np.random.default_rng([seed, draw])
        batch = [s for source in sources for s in _drawn(source, config.batch // 2, rng)]
        focal, values = _loss(network, batch)
        yield "detector", focal + values, {"focal": focal, "values": values}

    learner = Learner(network, (adam,))
    return run_training({"detector": learner}, losses, config.loop, session, label)


def _drawn(samples: Sequence[Sample], count: int, rng: np.random.Generator) -> list[Sample]:
    chosen = [samples[k] for k in rng.integers(len(samples), size=count)]
    flips = rng.integers(2, size=count)
    return [s.mirrored if flip else s for s, flip in zip(chosen, flips, strict=True)]


def _loss(network: Detector, samples: Sequence[Sample]) -> tuple[Tensor, Tensor]:
    inputs, projections = batch_of(samples, device_of(network))
    maps = [encode(s.view.boxes, s.view.ignored, network.config) for s in samples]
    target = torch.from_numpy(np.stack(maps)).to(inputs.device)
    return loss_of(network(inputs, projections), target)


def batch_of(
    samples: Sequence[Sample], device: torch.device
) -> tuple[Tensor, Float[Tensor, "n 3 4"]]:
    """Return inputs and projections of a batch on a device."""
    inputs = torch.from_numpy(np.stack([s.inputs[0] for s in samples]))
    projections = np.stack([s.view.projection for s in samples]).astype(np.float32)
    return inputs.to(device), torch.from_numpy(projections).to(device)


@torch.no_grad()
def detect(network: Detector, samples: Sequence[Sample], progress: Progress) -> list[Detections]:
    """Return the detections of every sample."""
    network.eval()
    found: list[Detections] = []
    starts = range(0, len(samples), _TESTED_AT_ONCE)
    for start in progress.track(starts, "test", len(starts)):
        part = samples[start : start + _TESTED_AT_ONCE]
        maps = network(*batch_of(part, device_of(network))).float().cpu().numpy()
        found += [decode(one, network.config) for one in maps]
    return found


def seconds_per_step(network: Detector, samples: Sequence[Sample]) -> float:
    """Return the duration of a training step without that of the optimiser's update."""
    rng, start = np.random.default_rng(0), 0.0
    for k in range(1 + _TIMED):
        # The first step, which allocates memory, does not count.
        start = time.perf_counter() if k == 1 else start
        focal, values = _loss(network, _drawn(samples, network.config.batch, rng))
        (focal + values).backward()
    return (time.perf_counter() - start) / _TIMED
