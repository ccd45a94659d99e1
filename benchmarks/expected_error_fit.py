"""The powers of `relighting.network.expected_error`: least squares of the log of the true error.

    python benchmarks/expected_error_fit.py DATA/SEED DATA/SEED ...

Folders of samples (`lightsim train prepare relight`) of streets that the network has not learned
from. Means of frames are taken out: which pixels of a frame are worse is asked for. Prints the
powers, the constant that makes the mean of all expected errors the true one, and the rank
correlation within frames on each street with powers fitted on the others, as a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from lightsim.build.quality.statistics import rank_correlation
from lightsim.core.resample import resize_area
from lightsim.relighting.network.expected_error import error_cues
from lightsim.relighting.network.features import srgb_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig

_FLOOR = 0.01
"""Of codes: added to the true error before the log."""
Frame = tuple[np.ndarray, np.ndarray]
"""True errors of n places, and their n x 4 cues."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("streets", type=Path, nargs="+")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--every", type=int, default=2, help="take every N-th frame")
    options = parser.parse_args()
    network = network_for(RelitNet, options.weights)
    frames = {path.name: [*_frames(network, path, options.every)] for path in options.streets}
    rows = ["| street | frames | rank correlation |", "|---|---:|---:|"]
    for name, own in frames.items():
        others = [frame for other, found in frames.items() if other != name for frame in found]
        powers, _ = _fit(others or own)
        mean = np.mean([rank_correlation(error, cues @ powers) for error, cues in own])
        rows.append(f"| {name} | {len(own)} | {mean:.3f} |")
    powers, constant = _fit([frame for found in frames.values() for frame in found])
    told = ", ".join(f"{power:.2f}" for power in powers)
    sys.stdout.write("\n".join([*rows, "", f"powers {told}; constant {constant:.2f}"]) + "\n")


def _frames(network: RelitNet, folder: Path, every: int) -> Iterator[Frame]:
    """Recorded frames under each of their skies."""
    data = RelightData([folder], RelightDataConfig())
    numbers = [i for i, path in enumerate(data.files) if "_under_" not in path.stem]
    for number in numbers[::every]:
        for sky in data.skies(number):
            one = data.whole(number, sky)
            with torch.inference_mode():
                found = network(one.planes)
                cues = error_cues(found, one.planes)[0].numpy()
            code = srgb_of(found.picture).clamp(0, 1)
            error = (code - one.truth).abs().mean(1)[0].numpy()
            counts = one.planes["surface"][0, 0] * (1 - one.planes["matte"][0, 0])
            counts = (counts * (one.weight[0, 0] > 0)).numpy()
            rows, columns = (size // 2 for size in error.shape)
            small = resize_area(np.stack([error, counts], axis=-1), rows, columns)
            is_used = small[..., 1] > 0.99
            yield small[..., 0][is_used], cues[:, :rows, :columns][:, is_used].T.astype(np.float64)


def _fit(frames: list[Frame]) -> tuple[np.ndarray, float]:
    """Powers and constant."""
    wanted = np.concatenate([_centred(np.log(error + _FLOOR)) for error, _ in frames])
    cues = np.concatenate([_centred(cues) for _, cues in frames])
    powers = np.linalg.lstsq(cues, wanted, rcond=None)[0]
    expected = np.concatenate([np.exp(cues @ powers) for _, cues in frames])
    true = np.concatenate([error for error, _ in frames])
    return powers, float(np.log(true.mean() / expected.mean()))


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean(axis=0)


if __name__ == "__main__":
    main()
