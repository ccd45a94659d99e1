"""Where a twin's surface loses its F-score: true surface that it lacks, and what it has too much.

    python benchmarks/surface_faults.py WORK --truth DIR

As in `lightsim evaluate geometry`, at 10 cm. Each material of the true street has its share of the
surface and how much of the whole is wrong; of what is lacking, also how much lies within so many
centimetres of a LiDAR return. What lies further away no surface through the returns can hold: it is
asked for up to 30 cm beyond them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from true_materials import material_names

from lightsim.build.quality.geometry import (
    THRESHOLDS_M,
    GeometryConfig,
    SurfaceSamples,
    sample_distances,
)
from lightsim.build.workspace import Workspace
from lightsim_lab.studies.twin_error import seen_surface
from lightsim_lab.synthetic.reader import read_true_meshes

_WRONG_M = THRESHOLDS_M[-1]
_RETURNS_M = (0.05, 0.10, 0.15)


def main() -> int:
    parser = argparse.ArgumentParser(description="where a surface's F-score is lost")
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work = Workspace(options.work)
    truth = read_true_meshes(options.truth / "scene.npz")["background"]
    names = np.char.rstrip(material_names(truth, options.truth).astype(str), "0123456789")
    seen, rng, config = seen_surface(work.log), np.random.default_rng(0), GeometryConfig()
    made = sample_distances(work.assets.background, truth, config, seen, False, rng)
    true = sample_distances(truth, work.assets.background, config, seen, True, rng)
    # Of what is too much: the material of the nearest true surface.
    at = KDTree(true.points_world).query(made.points_world)[1]
    returns = np.concatenate([s.load().points_world for s in work.log.sweeps])
    away_m = np.asarray(KDTree(returns).query(true.points_world)[0])
    sys.stdout.write(table(true, made, names[true.faces], names[true.faces[at]], away_m))
    return 0


def table(
    true: SurfaceSamples,
    made: SurfaceSamples,
    material: np.ndarray,
    material_made: np.ndarray,
    away_m: np.ndarray,
) -> str:
    """Percent of all true surface, and of all of the twin's in the last column."""
    lacks, excess = true.distance_m >= _WRONG_M, made.distance_m >= _WRONG_M
    near = [lacks & (away_m < reach) for reach in _RETURNS_M]
    heads = [
        "material",
        "share",
        "lacking",
        *(f"return < {100 * r:.0f} cm" for r in _RETURNS_M),
    ]
    lines = [f"| {' | '.join([*heads, 'too much'])} |", "|---|" + "---:|" * (len(heads))]
    for name in [*np.unique(material), "all"]:
        is_own, is_made = ((name == "all") | (of == name) for of in (material, material_made))
        row = [is_own, lacks & is_own, *(n & is_own for n in near)]
        cells = [f"{100 * r.mean():.1f}" for r in row] + [f"{100 * (excess & is_made).mean():.1f}"]
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
