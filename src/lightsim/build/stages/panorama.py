"""Panorama stage: the radiance around the ego, stitched from all cameras."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import parked_actor_meshes
from lightsim.lighting.panorama.stitch import StitchConfig, stitch_panorama
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.store.sky import (
    write_panorama,
)


def make_panorama(
    work: Workspace, config: StitchConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Stitch the panorama around the ego's position in the middle of the log.

    Depth comes from static and parked surfaces; moving actors are left out.
    """
    log, assets = work.training_log, work.assets
    # Moving actors have no place that is valid for all frames; the stitching masks their boxes.
    scene = without_actors(
        make_static_scene([assets.background, *parked_actor_meshes(log, assets)])
    )

    def cast_depth(frame: CameraFrame, camera: PinholeCamera) -> Float32[np.ndarray, "h w"]:
        return render_gbuffers(scene, camera, frame).depth_z_m

    def sky_matte(frame: CameraFrame, camera: PinholeCamera) -> Float32[np.ndarray, "h w"]:
        # The matte has the size of the build's images; the stitching resizes it to `camera`.
        return work.sky_matte(frame)

    panorama = stitch_panorama(
        log, assets.camera_gains, cast_depth, sky_matte, config, progress=context.progress
    )
    write_panorama(folder, panorama)
    return ()
