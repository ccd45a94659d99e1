"""What each part of the light's model is worth: left out once, on a synthetic street; Markdown.

    python benchmarks/light_parts.py WORK --truth DIR

WORK: a build up to the stage panorama. Sky and base colour are found anew without one part at a
time: light between surfaces ("observed bounce"), published reflectances ("class priors"), labels in
place of rendered shadows ("soft visibility"), specular lobes ("gloss"). Errors of sun and level sky
in stops, base colour over the true one (all, ground, facades), spread of its log at the best scale,
and base colour where the sun shone over where it did not (ground, facades).
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from lightsim.appearance.intrinsic import balance, decompose
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.lighting.sky.shipped import predict_sky
from lightsim.lighting.sun.direction import SunDirection
from lightsim.pipeline.assemble import roofs_over
from lightsim.pipeline.source_light import SourceLight, static_returns
from lightsim.pipeline.source_sun import find_source_sun
from lightsim.pipeline.stages.light import (
    IRRADIANCE,
    LIDAR_RETURNS,
    SkyStageConfig,
    TwinConfig,
    source_sky,
)
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import SilentProgress
from lightsim.simulation.against_truth import base_colours_of
from lightsim.synthetic.reader import true_sky

PARTS = ("observed bounce", "class priors", "soft visibility", "gloss")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work, truth = Workspace(options.work), true_sky(options.truth)
    silent = SilentProgress()
    prediction = predict_sky(work.panorama)
    sun, _ = find_source_sun(
        work, SkyStageConfig().sun, seed=0, progress=silent, prediction=prediction
    )
    meshes: dict[str, TriMesh] = {}
    light: dict[str, str] = {}
    for left_out in ("nothing", *PARTS):
        start = time.process_time()
        dome, meshes[left_out] = _without(left_out, work, sun)
        sun_stops, sky_stops = _stops(dome, truth)
        seconds = time.process_time() - start
        light[left_out] = f"{sun_stops:+.2f} | {sky_stops:+.2f} | {seconds:.0f}"
    report = base_colours_of(meshes, work, options.truth, silent)
    lines = [
        "| left out | sun | level sky | CPU s | base colour | ground | facades | log RMSE |"
        " lit/shadow, ground | facades |",
        "|---|" + "---:|" * 9,
    ]
    for name, cells in light.items():
        rows = {row.region: row for row in report.rows if row.method == name}
        lines.append(
            f"| {name} | {cells} | {rows['all'].factor:.2f} | {rows['ground'].factor:.2f} |"
            f" {rows['facades'].factor:.2f} | {rows['all'].si_log_rmse:.3f} |"
            f" {rows['ground'].lit_shadow_ratio:.2f} | {rows['facades'].lit_shadow_ratio:.2f} |"
        )
    sys.stdout.write("\n".join(lines) + "\n")


def _without(part: str, work: Workspace, sun: SunDirection) -> tuple[SkyDome, TriMesh]:
    """Sky and base colour of the background without one part."""
    irradiance = IRRADIANCE
    if part == "observed bounce":
        irradiance = replace(irradiance, unseen_albedo=None)
    if part == "gloss":
        irradiance = replace(irradiance, transport=replace(irradiance.transport, glossy_rays=0))
    config = TwinConfig(irradiance=irradiance)
    if part == "soft visibility":
        config = replace(config, intrinsic=replace(config.intrinsic, method="divide"))
    with (
        mock.patch.object(
            balance,
            "class_members",
            balance.class_members if part != "class priors" else lambda *_: (),
        ),
        mock.patch.object(
            decompose,
            "materials_of",
            decompose.materials_of if part != "class priors" else lambda *_: (),
        ),
        mock.patch.object(
            balance,
            "infer_labels",
            balance.infer_labels if part != "soft visibility" else lambda o, f, prior, *_: prior,
        ),
    ):
        estimate, rooflines = source_sky(
            work,
            sun,
            SkyStageConfig(irradiance=irradiance),
            predict_sky(work.panorama),
            seed=0,
            progress=SilentProgress(),
        )
        background, log = work.assets.background, work.training_log
        casters = roofs_over(background, rooflines)
        source = SourceLight(log, work.assets, casters, estimate.dome, irradiance, 0)
        rng = np.random.default_rng(0)
        done = decompose.decompose(
            background,
            source.on(RigidTransform.identity("world", "world")),
            config.intrinsic,
            rng,
            returns=static_returns(log, LIDAR_RETURNS, rng),
        )
    return estimate.dome, done.mesh


def _stops(found: SkyDome, truth: SkyDome) -> tuple[float, float]:
    """Of the sun's irradiance, and of the sky's on level ground without it, over the true ones."""

    def parts(dome: SkyDome) -> tuple[float, float]:
        assert dome.sun is not None
        sun = float(dome.sun.irradiance @ LUMINANCE_WEIGHTS)
        level = float(dome.horizontal_irradiance() @ LUMINANCE_WEIGHTS)
        return sun, level - sun * max(float(dome.sun.direction_world[2]), 0.0)

    logs = np.log2(parts(found)) - np.log2(parts(truth))
    return float(logs[0]), float(logs[1])


if __name__ == "__main__":
    main()
