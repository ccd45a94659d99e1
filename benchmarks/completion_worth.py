"""What each step of the completion is worth: the scene with all steps, and with each left out.

    python benchmarks/completion_worth.py WORK --truth DIR [--steps NAME ...]

Processor seconds of the completion, F-score at 10 cm, and IoU of shadows under suns at 20 and 45
degrees (as in `target_shadows.py`, with roofs before the recorded shadows are asked). The worth of
a step in relit pictures: `lightsim build --no-complete NAME`, relight, `lightsim evaluate relit`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from target_shadows import score

from lightsim.build.assemble import roofs_over
from lightsim.build.quality.geometry import THRESHOLDS_M, GeometryConfig, evaluate_surface
from lightsim.build.stages.context import Context
from lightsim.build.stages.geometry import completion_inputs, measured_scene
from lightsim.build.workspace import Workspace
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.table import STEPS, complete
from lightsim.progress import SilentProgress
from lightsim_lab.studies.twin_error import seen_surface
from lightsim_lab.synthetic.reader import read_true_meshes


def main() -> int:
    parser = argparse.ArgumentParser(description="what the steps of the completion are worth")
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--steps", nargs="*", default=[step.name for step in STEPS])
    options = parser.parse_args()
    work, context = Workspace(options.work), Context(SilentProgress(), 0, "standard")
    inputs = completion_inputs(work, context)
    _, whole = measured_scene(work, inputs, context)
    on_levels = {step.name for step in STEPS if step.on_level is not None}
    sys.stdout.write("| without | seconds | F@10 | 20 degrees | 45 degrees |\n")
    sys.stdout.write("|---|---:|---:|---:|---:|\n")
    for name in ("", *options.steps):
        without, start = (name,) if name else (), whole
        if name in on_levels:
            _, start = measured_scene(work, inputs, context, without)
        before_s = time.process_time()
        scene, _ = complete(inputs, start, without)
        seconds = time.process_time() - before_s
        figures = " | ".join(f"{f:.4f}" for f in _scores(work, scene, options.truth))
        sys.stdout.write(f"| {name or '(nothing)'} | {seconds:.0f} | {figures} |\n")
        sys.stdout.flush()
    return 0


def _scores(work: Workspace, scene: Scene, truth: Path) -> tuple[float, ...]:
    """F-score and IoU of shadows by elevation."""
    true = read_true_meshes(truth / "scene.npz")["background"]
    surface = evaluate_surface(
        scene.background,
        true,
        GeometryConfig(),
        seen=seen_surface(work.log),
        rng=np.random.default_rng(0),
    )
    casters = roofs_over(scene.background, scene.rooflines)
    shadows = score(work, truth, scene.background, casters)
    f_score = next(s.f_score for s in surface if s.threshold_m == THRESHOLDS_M[-1])
    return f_score, *(found.iou for found in shadows.values())


if __name__ == "__main__":
    sys.exit(main())
