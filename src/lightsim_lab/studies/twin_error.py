"""Errors of a built twin against the ground truth of a synthetic log: geometry and sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.build.measures import lidar_error
from lightsim.build.quality.geometry import (
    GeometryConfig,
    GeometryReport,
    SeenSurface,
    evaluate_surface,
)
from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.lighting.sun.direction import find_sun_blob
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster
from lightsim_lab.metrics.sky import SkyReport, evaluate_sky
from lightsim_lab.synthetic.reader import read_true_meshes, true_sky


def geometry(
    workspace: Workspace,
    truth: Path | None,
    progress: Progress,
    config: GeometryConfig | None = None,
) -> tuple[GeometryReport, bool]:
    """Return LiDAR errors and, with `truth`, F-scores of the background near LiDAR returns.

    LiDAR errors are measured on held-out sweeps if there are any, which the flag indicates.

    Args:
        truth: truth/ folder of a synthetic log; None omits the F-scores.
    """
    rng = np.random.default_rng(0)
    lidar, is_held_out = lidar_error(workspace, progress, rng)
    if truth is None:
        return GeometryReport(lidar), is_held_out
    seen = seen_surface(workspace.log)
    true_background = read_true_meshes(truth / "scene.npz")["background"]
    background, config = workspace.assets.background, config or GeometryConfig()
    surface = evaluate_surface(background, true_background, config, seen=seen, rng=rng)
    return GeometryReport(lidar, surface), is_held_out


def seen_surface(log: DrivingLog) -> SeenSurface:
    """Return the surface visible to the LiDAR, by its positions and every seventh return."""
    loaded = [s.load() for s in log.sweeps]
    return SeenSurface(
        np.concatenate([sweep.points_world[::7] for sweep in loaded]).astype(np.float64),
        np.stack([sweep.origins_world.mean(axis=0) for sweep in loaded]).astype(np.float64),
        make_embree_caster,
    )


def sky(workspace: Workspace, truth: Path | None) -> SkyReport:
    """Measure the source sky against ephemeris, the sun in the panorama, and a true source sky."""
    estimate, geo = workspace.sky, workspace.log.geo
    frames = workspace.log.frames
    middle_ns = frames[len(frames) // 2].time_ns
    ephemeris = None if geo is None else geo.direction_at(middle_ns)
    # Searched near the estimated sun, so that bright reflections elsewhere are ignored.
    near = None if estimate.dome.sun is None else estimate.dome.sun.direction_world
    blob = find_sun_blob(workspace.panorama, near)
    return evaluate_sky(
        estimate,
        truth=None if truth is None else true_sky(truth),
        ephemeris_world=ephemeris,
        observed_sun_world=None if blob is None else blob.direction_world,
    )
