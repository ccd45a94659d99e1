"""What each part of the light's model is worth: left out once, on a synthetic street; Markdown.

    python benchmarks/light_parts.py WORK --truth DIR [--parts gloss exposure]

WORK: a build up to the stage panorama. Sky and base colour are found anew without one part at a
time: light between surfaces ("observed bounce"), published reflectances ("class priors"), labels in
place of rendered shadows ("soft visibility"), one exposure for each camera ("exposure": textures
and panorama are made anew), specular lobes ("gloss"). Errors of sun and level sky in stops, base
colour over the true one (all, ground, facades), spread of its log at the best scale, and base
colour where the sun shone over where it did not (ground, facades).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np

from lightsim.appearance.build import AssetConfig, build_assets
from lightsim.appearance.intrinsic import balance, decompose
from lightsim.build.assemble import roofs_over
from lightsim.build.source_light import IRRADIANCE, SourceLight
from lightsim.build.source_sun import find_source_sun
from lightsim.build.stages.context import Context
from lightsim.build.stages.panorama import make_panorama
from lightsim.build.stages.sky import SkyStageConfig, source_sky
from lightsim.build.stages.twin import TwinConfig
from lightsim.build.workspace import Workspace
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import Panorama, SceneAssets
from lightsim.lighting.panorama.stitch import StitchConfig
from lightsim.lighting.sky.predict import predict_sky
from lightsim.lighting.sun.direction import SunDirection
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.sky import read_panorama
from lightsim_lab.studies.against_truth import base_colours_of
from lightsim_lab.synthetic.reader import true_sky

STAND_INS: dict[str, list[tuple[ModuleType, str, Callable[..., Any]]]] = {
    "class priors": [
        (balance, "class_members", lambda *_: ()),
        (decompose, "materials_of", lambda *_: ()),
    ],
    "soft visibility": [(balance, "infer_labels", lambda observed, light, prior, *_: prior)],
}
"""What stands in for the functions that bring a part in."""
PARTS = (
    "observed bounce",
    "class priors",
    "soft visibility",
    "exposure",
    "gloss",
)


class EqualExposures(Workspace):
    """A work folder as if all cameras had one exposure and white balance."""

    @cached_property
    def assets(self) -> SceneAssets:  # pyright: ignore[reportIncompatibleVariableOverride]
        return build_assets(
            self.training_log,
            self.meshes,
            AssetConfig(has_camera_gains=False),
            make_caster=make_embree_caster,
            progress=SilentProgress(),
            sky_matte=self.sky_matte,
        )

    @cached_property
    def panorama(self) -> Panorama:  # pyright: ignore[reportIncompatibleVariableOverride]
        with tempfile.TemporaryDirectory() as folder:
            context = Context(SilentProgress(), 0, "standard")
            make_panorama(self, StitchConfig(), Path(folder), context)
            return read_panorama(Path(folder))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=PARTS)
    options = parser.parse_args()
    work, truth = Workspace(options.work), true_sky(options.truth)
    silent, equal = SilentProgress(), EqualExposures(options.work)
    sys.stdout.write(
        "| left out | sun | level sky | CPU s | base colour | ground | facades | log RMSE |"
        " lit/shadow, ground | facades |\n|---|" + "---:|" * 9 + "\n"
    )
    for left_out in ("nothing", *options.parts):
        seen = equal if left_out == "exposure" else work
        sun, _ = find_source_sun(
            seen,
            SkyStageConfig().sun,
            seed=0,
            progress=silent,
            prediction=predict_sky(seen.panorama),
        )
        start = time.process_time()
        dome, mesh = _without(left_out, seen, sun)
        seconds = time.process_time() - start
        sun_stops, sky_stops = _stops(dome, truth)
        report = base_colours_of({left_out: mesh}, work, options.truth, silent)
        rows = {row.region: row for row in report.rows}
        sys.stdout.write(
            f"| {left_out} | {sun_stops:+.2f} | {sky_stops:+.2f} | {seconds:.0f} |"
            f" {rows['all'].factor:.2f} | {rows['ground'].factor:.2f} |"
            f" {rows['facades'].factor:.2f} | {rows['all'].si_log_rmse:.3f} |"
            f" {rows['ground'].lit_shadow_ratio:.2f} | {rows['facades'].lit_shadow_ratio:.2f} |\n"
        )
        sys.stdout.flush()


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
    with ExitStack() as stack:
        for module, name, stand_in in STAND_INS.get(part, ()):
            stack.enter_context(mock.patch.object(module, name, stand_in))
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
        done = decompose.decompose(
            background,
            source.on(RigidTransform.identity("world", "world")),
            config.intrinsic,
            np.random.default_rng(0),
            path_world=log.camera_positions_m,
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
