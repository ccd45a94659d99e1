"""Relit frames of any method, scored as `lightsim train relight --validation` scores networks: the
same frames, pixels and measures, so that all stand in one table.

    lightsim relight WORK --name NAME --method METHOD --sky-scale none --frames 3:8:4
        --sky TRUTH/skies/low_sun.exr TRUTH/skies/high_sun.exr TRUTH/skies/overcast.exr
    python benchmarks/relit_against_samples.py WORK/scenarios/NAME DATA/5021
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from lightsim.build.quality.metrics import psnr
from lightsim.core.colour import srgb_from_linear
from lightsim.store.images import read_srgb8
from lightsim_lab.metrics.lpips import lpips_features, lpips_of_features
from lightsim_lab.training.relight_cache import read_sample


def score(scenario: Path, street: Path) -> None:
    """Print PSNR and LPIPS by sky, outside the sky that the matte knows, of the frames that are
    there, and of copy and physical estimate in the same views."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for path in sorted(street.glob("*.npz")):
        camera, _, stem = path.stem.rpartition("_")
        if "_under_" in path.stem:
            continue
        sample = read_sample(path)
        is_valid = (sample.scene["valid"][0] > 0) & (sample.scene["matte"][0] < 0.5)
        for sky, target in sample.targets.items():
            file = scenario / sky / "frames" / camera / f"{stem}.png"
            if target.truth is None or not file.is_file():
                continue
            truth = _picture(target.truth) / np.float32(255)
            features = lpips_features(truth)
            pictures = {
                "frames": read_srgb8(file).astype(np.float32) / np.float32(255),
                "physical": srgb_from_linear(_picture(target.planes["target_physical"])),
                "copy": _picture(sample.scene["source"]),
            }
            for name, made in pictures.items():
                filled = np.where(is_valid[..., None], made, truth)
                distance = lpips_of_features(lpips_features(filled), features, is_valid)
                found[sky, name].append((psnr(made, truth, is_valid), distance))
    for (sky, name), scores in sorted(found.items()):
        decibels, distance = np.mean(scores, axis=0)
        line = f"{sky}, {name}: {decibels:.2f} dB, LPIPS {distance:.3f}, {len(scores)} views"
        sys.stdout.write(line + "\n")


def _picture(plane: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(plane, 0, -1)).astype(np.float32)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenario", type=Path)
    parser.add_argument("street", type=Path)
    options = parser.parse_args()
    score(options.scenario, options.street)
