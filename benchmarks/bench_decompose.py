"""Base colour of a synthetic street's twin with parts of the method left out; a Markdown table.

    python benchmarks/bench_decompose.py WORK --truth DIR [--variants "labels,true sky"]

WORK: a build up to the stage sky. Ratio: base colour where the sun shone over where it did not,
against the truth; 1 is free of shadows.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.decompose import decompose
from lightsim.build.source_light import SourceLight
from lightsim.build.stages.twin import TwinConfig
from lightsim.build.workspace import Workspace
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.progress import SilentProgress
from lightsim.simulation.skies import SkyChoice, resolve_sky
from lightsim_lab.studies.against_truth import base_colours_of

DEFAULT = IntrinsicConfig()
VARIANTS: dict[str, IntrinsicConfig] = {
    "labels": DEFAULT,
    "no inferred casters": DEFAULT,
    "true sky": DEFAULT,
    "deep shade divided": replace(DEFAULT, deep_shade=(1e-9, 2e-9)),
    "no islands filtered": replace(DEFAULT, island_m2=0.0),
    "neighbours only": replace(DEFAULT, reach_m=0.5),
    "rendered edges exact": replace(DEFAULT, edge_error_m=0.02, unseen_shadow=0.01),
    "divide": replace(DEFAULT, method="divide"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--variants", default=",".join(VARIANTS))
    options = parser.parse_args()
    workspace = Workspace(options.work)
    meshes: dict[str, TriMesh] = {"radiance": workspace.assets.background}
    for name in options.variants.split(","):
        start = time.monotonic()
        meshes[name] = _without_light(workspace, name, options.truth)
        sys.stderr.write(f"{name}: {time.monotonic() - start:.0f} s\n")
    report = base_colours_of(meshes, workspace, options.truth, SilentProgress())
    sys.stdout.write(report.to_table() + "\n")


def _without_light(workspace: Workspace, name: str, truth: Path) -> TriMesh:
    log, assets, config = workspace.training_log, workspace.assets, TwinConfig()
    inferred = workspace.inferred
    if name == "no inferred casters":
        inferred = replace(inferred, faces=inferred.faces[:0])
    dome = workspace.sky.dome
    if name == "true sky":
        file = truth / "skies" / "source.exr"
        dome = resolve_sky(SkyChoice(str(file), 0.0, "none"), workspace).dome
    source = SourceLight(log, assets, inferred, dome, config.irradiance, 0)
    done = decompose(
        assets.background,
        source.on(RigidTransform.identity("world", "world")),
        VARIANTS[name],
        np.random.default_rng(0),
        path_world=log.camera_positions_m,
    )
    return done.mesh


if __name__ == "__main__":
    main()
