"""Weights of relighting networks, of any kind, beside each other on streets that they did not
learn from, and the mean of their pictures.

    python benchmarks/relight_weights.py DATA/231 [DATA/232 ...] --weights FILE [FILE ...]
        [--every 1] [--lpips]

DATA: of `lightsim train prepare relight`. PSNR dB (and LPIPS) outside the sky, recorded pictures as
sources, mean over pictures, by kind of target sky; seconds of one processor for each picture.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from lightsim.relighting.network.features import srgb_of
from lightsim.relighting.network.stored import network_of
from lightsim.store.weights import read_weights
from lightsim_lab.metrics.lpips import lpips_features
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_scores import is_judged, made_by, picture_of, scores_of

_OWN = ("low_sun", "high_sun", "overcast", "identity")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("streets", type=Path, nargs="+")
    parser.add_argument("--weights", type=Path, nargs="+", required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--lpips", action="store_true")
    options = parser.parse_args()
    networks = {file.stem: network_of(read_weights(file)).eval() for file in options.weights}
    data = RelightData(options.streets, RelightDataConfig())
    recorded = [k for k, file in enumerate(data.files) if "_under_" not in file.name]
    found: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    spent = dict.fromkeys(networks, 0.0)
    pairs = [(k, sky) for k in recorded for sky in (*data.skies(k), None)][:: options.every]
    for index, sky in pairs:
        batch = data.whole(index, sky)
        pictures = {
            "copy": picture_of(batch.planes["source"]),
            "physical": picture_of(srgb_of(batch.planes["target_physical"])),
        }
        for name, network in networks.items():
            began = time.process_time()
            pictures[name] = made_by(network, batch)[0]
            spent[name] += time.process_time() - began
        if len(networks) > 1:
            pictures["mean"] = np.mean([pictures[name] for name in networks], axis=0)
        truth, is_valid = picture_of(batch.truth), is_judged(batch).numpy()
        features = lpips_features(truth) if options.lpips else None
        kind = "identity" if sky is None else sky if sky in _OWN else "other"
        for name, picture in pictures.items():
            score = scores_of(picture, truth, features, is_valid)
            found[name][kind].append(score)
            if sky is not None:
                found[name]["mean"].append(score)
    kinds = [k for k in (*_OWN[:3], "other", "identity", "mean") if found["copy"][k]]
    sys.stdout.write(f"| weights | {' | '.join(kinds)} | s |\n|---|{'---:|' * (len(kinds) + 1)}\n")
    for name, rows in found.items():
        cells = [_cell(np.mean(rows[kind], axis=0), has_lpips=options.lpips) for kind in kinds]
        seconds = f"{spent[name] / len(pairs):.2f}" if name in spent else "-"
        sys.stdout.write(f"| {name} | {' | '.join(cells)} | {seconds} |\n")


def _cell(score: np.ndarray, *, has_lpips: bool) -> str:
    return f"{score[0]:.2f} / {score[1]:.3f}" if has_lpips else f"{score[0]:.2f}"


if __name__ == "__main__":
    main()
