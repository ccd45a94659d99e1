"""Where the light's error comes from: the truth put into the balance, part by part; Markdown.

    python benchmarks/light_truth.py WORK --truth DIR

WORK: a build up to the stage panorama. First the sun's irradiance, stops over the truth, that lit
and shadowed neighbours ask for by themselves: under the estimated dome, under the true one, and
with the true visibility of the sun in place of labels. Then base colour over the true one under the
true dome and visibility: what the light's model (Lambert and a lobe, light between surfaces as
seen) leaves, by surface. Patches within 15 cm of a pixel that has exact buffers.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from lightsim.appearance.intrinsic.balance import balance_light
from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.decompose import mesh_surfels
from lightsim.appearance.intrinsic.labels import ObservedSurfels, label_shadows
from lightsim.appearance.intrinsic.light import LightBalance
from lightsim.appearance.intrinsic.shadow_pairs import (
    fit_sun_to_pairs,
    shadow_pairs,
    space_blocks,
)
from lightsim.build.assemble import roofs_over
from lightsim.build.source_light import IRRADIANCE, SourceLight
from lightsim.build.source_sun import SourceSunConfig, find_source_sun
from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.dome import SkyDome, resized
from lightsim.core.frames import RigidTransform
from lightsim.core.twin import parked_actor_meshes
from lightsim.lighting.sky.balance import unseen_part
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sky.predict import predict_sky
from lightsim.progress import SilentProgress
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.sun import sun_visibility
from lightsim.store.exr import read_exr
from lightsim_lab.synthetic.reader import read_true_meshes, true_sky

_BLOCK_M, _LIFT_M, _NEAR_M = 4.0, 0.08, 0.15
_WEIGHTS = LUMINANCE_WEIGHTS.astype(np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work, silent, config = Workspace(options.work), SilentProgress(), IntrinsicConfig()
    prediction = predict_sky(work.panorama)
    sun, _ = find_source_sun(
        work, SourceSunConfig(), seed=0, progress=silent, prediction=prediction
    )
    estimate, freedom = estimate_sky(work.panorama, sun, SkyConfig(), prediction=prediction)
    log, rng = work.training_log, np.random.default_rng(0)
    background = work.assets.background
    path = log.camera_positions_m
    patches = mesh_surfels(background, config, rng, path)
    assert patches is not None
    roofs = roofs_over(background, work.initial_rooflines)

    def with_light(dome: SkyDome) -> ObservedSurfels:
        unseen = unseen_part(dome, freedom)
        source = SourceLight(log, work.assets, roofs, dome, IRRADIANCE, 0, unseen)
        return patches.with_light(source.on(RigidTransform.identity("world", "world")))

    truth = resized(true_sky(options.truth, "source"), estimate.dome.height_px)
    assert truth.sun is not None
    assert estimate.dome.sun is not None
    surfels = patches.surfels
    true_scene = make_static_scene(
        [
            read_true_meshes(options.truth / "scene.npz")["background"],
            *parked_actor_meshes(log, work.assets),
        ]
    )
    lifted = (surfels.position + _LIFT_M * surfels.normal).astype(np.float32)
    visibility = sun_visibility(
        without_actors(true_scene).caster,
        lifted,
        surfels.normal.astype(np.float32),
        truth.sun,
        IRRADIANCE.transport,
    ).astype(np.float64)
    estimated, true = with_light(estimate.dome), with_light(truth)
    balance = balance_light(estimated, freedom, path, config)
    found = label_shadows(estimated.with_reflections(balance, visibility), config).lit
    over = np.log2(estimate.dome.sun.irradiance @ _WEIGHTS / (truth.sun.irradiance @ _WEIGHTS))
    lines = ["| dome | visibility | sun by pairs, stops over truth |", "|---|---|---:|"]
    for name, observed, lit, offset in (
        ("estimated, the unseen sky as completed | labels", estimated, found, over),
        ("true | labels", true, found, 0.0),
        ("true | true", true, visibility, 0.0),
    ):
        shown = observed.with_reflections(LightBalance.unchanged(), lit)
        pairs = shadow_pairs(shown, lit, space_blocks(surfels.position, _BLOCK_M))
        factor, _ = fit_sun_to_pairs(pairs, 1.0)
        lines.append(f"| {name} | {np.log(factor) @ _WEIGHTS / np.log(2) + offset:+.2f} |")
    lines += ["", "| surface | patches | base colour over truth |", "|---|---:|---:|"]
    true_colour = _true_colours(work, options.truth, surfels.position, surfels.normal)
    colour = true.own_light.base_colour(surfels.radiance, visibility) @ _WEIGHTS
    is_usable = (surfels.confidence > 0.5) & (surfels.radiance < 0.9).all(axis=1)
    is_usable &= np.isfinite(true_colour)
    up = surfels.normal[:, 2]
    for name, members in (("ground", up > 0.95), ("facades", np.abs(up) < 0.15)):
        for state, shown in (("lit", visibility > 0.95), ("shadowed", visibility < 0.05)):
            rows = members & shown & is_usable
            median = np.median(colour[rows] / true_colour[rows])
            lines.append(f"| {name}, {state} | {rows.sum()} | {median:.2f} |")
    sys.stdout.write("\n".join(lines) + "\n")


def _true_colours(
    work: Workspace, truth: Path, position: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Luminance of the true base colour around each place, NaN where no buffer shows it."""
    log, parts = work.log_at(1.0), []
    for path in sorted((truth / "base_colour").glob("*/*.exr")):
        frame = next(f for f in log.frames_of(path.parent.name) if f.stem == path.stem)
        camera = log.cameras[path.parent.name]
        colour, depth, actor, facing = (
            read_exr(truth / what / path.parent.name / path.name)
            for what in ("base_colour", "depth_z_m", "actor_index", "normal_world")
        )
        depth, actor = (image.reshape(colour.shape[:2]) for image in (depth, actor))
        is_shown = np.isfinite(depth) & (np.rint(actor) == BACKGROUND)
        rays = camera.directions(camera.pixel_centres()[is_shown])
        points = frame.world_from_camera.apply(rays / rays[:, 2:] * depth[is_shown][:, None])
        parts.append((points, facing[is_shown], colour[is_shown] @ _WEIGHTS))
    points, facing, colour = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    result = np.full(len(position), np.nan)
    near = KDTree(points).query_ball_point(position, _NEAR_M)
    for row, members in enumerate(near):
        alike = [i for i in members if facing[i] @ normal[row] > 0.8]
        if alike:
            result[row] = colour[alike].mean()
    return result


if __name__ == "__main__":
    main()
