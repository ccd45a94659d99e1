"""How the error that `--method network` expects of each pixel ranks with the true one.

    python benchmarks/expected_error.py WORK --truth DIR

Frames of a synthetic log under all skies of its truth, relit at WORK/scenarios/expected-error.
Rank correlation (Spearman) of expected and true mean absolute error of the codes, over the pixels
of a frame that show surfaces, in parts of 2 x 2; mean over frames. Then the error of the tenth that
is expected to be worst, and of the tenth expected to be best, and the mean expected error over the
mean true one. Markdown.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from lightsim.build.quality.statistics import rank_correlation
from lightsim.build.workspace import Workspace
from lightsim.core.resample import resize_area
from lightsim.progress import terminal_progress
from lightsim.simulation.options import RelightOptions
from lightsim.store.images import read_grey8, read_srgb8
from lightsim_lab.studies.against_truth import relit_folders
from lightsim_lab.studies.true_surfaces import TrueSurfaces


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    options = parser.parse_args()
    workspace = Workspace(options.work, is_stale_allowed=True)
    relighting = RelightOptions(
        name="expected-error",
        method="network",
        weights=options.weights,
        expected_error=True,
        allow_stale=True,
    )
    folders = relit_folders(workspace, options.truth, relighting, terminal_progress())
    surfaces = TrueSurfaces(options.truth / "scene.npz", workspace)
    columns = "rank correlation | worst tenth x 255 | best tenth x 255 | expected over true"
    sys.stdout.write(f"| target | {columns} |\n")
    sys.stdout.write("|---|---:|---:|---:|---:|\n")
    for sky, frames in folders.items():
        found = np.mean([_score(frames, path, surfaces) for path in _made(frames)], axis=0)
        row = " | ".join(f"{x:.{n}f}" for x, n in zip(found, (2, 1, 1, 2), strict=True))
        sys.stdout.write(f"| {sky} | {row} |\n")


def _made(frames: dict[str, Path]) -> list[Path]:
    return sorted(frames["predicted"].glob("*/*.png"))


def _score(
    frames: dict[str, Path], path: Path, surfaces: TrueSurfaces
) -> tuple[float, float, float, float]:
    """Of one frame."""
    camera, stem = path.parent.name, path.stem
    truth = read_srgb8(frames["truth"] / camera / f"{stem}.jpg").astype(np.float32)
    error = np.abs(read_srgb8(path) - truth).mean(axis=-1)
    expected = read_grey8(path.parents[2] / "error" / camera / path.name).astype(np.float32)
    is_surface = surfaces.is_surface(camera, stem).astype(np.float32)
    height, width = error.shape
    planes = np.stack([error, expected, is_surface], axis=-1)
    small = resize_area(planes, height // 2, width // 2)
    error, expected = (small[..., k][small[..., 2] > 0.99] for k in (0, 1))
    low, high = np.quantile(expected, [0.1, 0.9])
    worst, best = error[expected >= high].mean(), error[expected <= low].mean()
    ratio = expected.mean() / error.mean()
    return rank_correlation(error, expected), float(worst), float(best), float(ratio)


if __name__ == "__main__":
    main()
