"""Processor seconds of a training step of a relighting network; a Markdown row.

    OMP_NUM_THREADS=1 python benchmarks/training_step.py DATA/STREET ... [--network network|paper]

Medians over steps of `lightsim train relight` on the CPU, after the first ones, which open the
files: what reads and cuts the samples, and the rest (network, losses, optimiser).
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.networks.loop import Session
from lightsim.progress import SilentProgress
from lightsim_lab.training.relight import RelightTrainConfig, paper, train_relight
from lightsim_lab.training.relight_data import RelightData
from lightsim_lab.training.relight_pairs import RelightBatch

_FIRST = 5


class TimedData(RelightData):
    """Notes when each batch was asked for, and when it was made."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.times_s: list[tuple[float, float]] = []

    def batch(self, draw: int, seed: int) -> RelightBatch:
        started = time.process_time()
        made = super().batch(draw, seed)
        self.times_s.append((started, time.process_time()))
        return made


class NoCheckpoints:
    """Nothing is kept."""

    def load(self) -> None:
        return None

    def save(self, state: dict[str, Any]) -> None:
        pass

    def record(self, metrics: dict[str, float]) -> None:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--network", choices=("network", "paper"), default="network")
    parser.add_argument("--steps", type=int, default=20)
    options = parser.parse_args()
    config = RelightTrainConfig()
    if options.network == "paper":
        config = paper(config)
    # The last step ends when one more batch is asked for.
    config = replace(config, loop=replace(config.loop, steps=_FIRST + options.steps + 1))
    data = TimedData(options.folders, config.data)
    train_relight(config, data, Session(NoCheckpoints(), SilentProgress(), device="cpu"))
    started, made = np.array(data.times_s[_FIRST:]).T
    reading, rest = np.median(made - started), np.median(started[1:] - made[:-1])
    sys.stdout.write("| network | samples | reading s | rest s |\n|---|---:|---:|---:|\n")
    sys.stdout.write(f"| {options.network} | {len(data)} | {reading:.3f} | {rest:.3f} |\n")


if __name__ == "__main__":
    main()
