"""How relighting networks bear pictures and surfaces that are darker or brighter than those that
taught them.

    python benchmarks/relight_exposures.py WORK --truth S/truth [--weights FILE ...]

Frames of a street with true pictures, shown to the networks at other exposures; what they make is
brought back and scored as recorded: PSNR dB outside sky and clipped pixels, mean over target skies.
The network looks at every frame at one exposure: what differs there is what clips.
Then the same street with all surfaces so many times as light, which light's linearity gives
exactly; in brackets what the physical estimate has there.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from lightsim.progress import terminal_progress
from lightsim.relighting.network.features import srgb_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for
from lightsim_lab.studies.relight_samples import write_samples
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_pairs import RelightBatch, exposed

STOPS = (-3, -2, -1, 0, 1)
PAINTS = (0.6, 1.6)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--weights", type=Path, nargs="*", default=[None])
    options = parser.parse_args()
    with TemporaryDirectory() as made:
        folder = Path(made)
        write_samples(options.work, options.truth, folder, terminal_progress(), true_sources=0)
        data = RelightData([folder], RelightDataConfig())
        columns = [*(f"{ev:+d} EV" for ev in STOPS), "physical", *(f"x {k}" for k in PAINTS)]
        sys.stdout.write(f"| weights | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}\n")
        for path in options.weights:
            network = network_for(RelitNet, path).eval()
            cells = [f"{value:.2f}" for value in score(network, data)]
            for paint in PAINTS:
                found, physical = score_painted(network, data, paint)
                cells.append(f"{found:.2f} ({physical:.2f})")
            sys.stdout.write(f"| {path or 'shipped'} | {' | '.join(cells)} |\n")


def score(network: RelitNet, data: RelightData) -> list[float]:
    """PSNR at each of STOPS, and of the physical estimate."""

    def pictures(batch: RelightBatch) -> list[Tensor]:
        physical = srgb_of(batch.planes["target_physical"])
        return [*(at_exposure(network, batch, 2.0**ev) for ev in STOPS), physical]

    return psnr_of(pictures, data, 1.0)


def score_painted(network: RelitNet, data: RelightData, paint: float) -> list[float]:
    """PSNR of network and physical estimate where all surfaces are so many times as light, lighter
    ones in so much less light."""

    def pictures(batch: RelightBatch) -> list[Tensor]:
        return [at_exposure(network, batch, 1.0), srgb_of(batch.planes["target_physical"])]

    return psnr_of(pictures, data, paint)


def psnr_of(
    pictures: Callable[[RelightBatch], list[Tensor]], data: RelightData, paint: float
) -> list[float]:
    """Of each picture, mean over target skies."""
    errors: dict[str, list[list[float]]] = defaultdict(list)
    for index in range(len(data)):
        for sky in data.skies(index):
            batch = data.whole(index, sky)
            if paint != 1:
                batch = exposed(batch, 1 / max(paint, 1.0), np.full(3, paint))
            errors[sky].append([mean_square(picture, batch) for picture in pictures(batch)])
    by_sky = [-10 * np.log10(np.mean(rows, axis=0)) for rows in errors.values()]
    return np.mean(by_sky, axis=0).tolist()


def at_exposure(network: RelitNet, batch: RelightBatch, factor: float) -> Tensor:
    with torch.inference_mode():
        return srgb_of(network(exposed(batch, factor).planes).picture / factor)


def mean_square(picture: Tensor, batch: RelightBatch) -> float:
    planes = batch.planes
    is_valid = (batch.weight > 0) & (planes["matte"] < 0.5) & (planes["clipped"] < 0.5)
    return float(((picture.clamp(0, 1) - batch.truth)[0][:, is_valid[0, 0]] ** 2).mean())


if __name__ == "__main__":
    main()
