"""Held-out frames of a work folder as its other pictures show them, projected through the twin:
what a new ego path looks like, where a camera did stand.

    python benchmarks/novel_views.py WORK [--cameras a,b] [--frames 54:55] [--image-scale .25]

Prints PSNR, SSIM and LPIPS (in the region `masked`: neither sky nor ego vehicle) of the twin's own
radiance, of the nearest picture as it is, and of the projected pictures; with an image scale of the
projected pictures alone.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import UInt8

from lightsim.build.measures import (
    Show,
    held_out_tasks,
    nearest_recorded,
    observed_radiance,
)
from lightsim.build.quality.frames import FramesConfig, score_frames
from lightsim.build.workspace import Workspace
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.selection import FrameSelection
from lightsim.progress import terminal_progress
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image import sky_image
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim.simulation.novel_views import NovelViews
from lightsim_lab.metrics.lpips import Lpips


@dataclass(frozen=True)
class Arguments:
    """Score held-out frames."""

    work: Annotated[Path, tyro.conf.Positional]
    """Built with --hold-out."""
    cameras: str = ""
    """Names, by commas; by default all."""
    frames: str = ""
    """START:STOP[:STEP]; by default all that were held out."""
    image_scale: float | None = None
    """By default that of the build."""
    lpips: bool = False
    """Score LPIPS, too."""


def main(arguments: Arguments) -> None:
    """Print the table."""
    workspace = Workspace(arguments.work, is_stale_allowed=True)
    log = workspace.log_at(arguments.image_scale or workspace.reading.image_scale)
    assets = workspace.twin.assets
    inferred = workspace.unobserved_occluders
    transport = TransportConfig()
    renderer = FrameRenderer(assets.background, inferred, transport, 0, inferred_is_visible=True)
    recorded = replay(replace(workspace.twin, log=log), "held-out", log.frames)
    views = NovelViews(workspace, log, recorded, renderer, workspace.held_out)

    def projected(frame: CameraFrame) -> UInt8[np.ndarray, "h w 3"]:
        camera = log.cameras[frame.camera_name]
        buffers = renderer.geometry(recorded, frame, camera)
        sky = sky_image(workspace.sky.dome, camera, frame)
        twin = np.where(buffers.has_surface[..., None], buffers.base_colour, sky)
        view = views.of(frame, buffers, twin.astype(np.float32))
        return srgb8_from_linear(view.radiance * assets.camera_gains[frame.camera_name])

    methods: dict[str, Show] = {"projected pictures": projected}
    if arguments.image_scale is None:
        methods["twin"] = observed_radiance(workspace)
        methods["nearest picture"] = nearest_recorded(workspace)
    cameras = [n for n in arguments.cameras.split(",") if n] or list(log.cameras)
    asked = FrameSelection.parse(arguments.frames)
    tasks = [
        t
        for t in held_out_tasks(workspace, methods, log)
        if t.camera_name in cameras and asked.holds(int(t.stem))
    ]
    config = FramesConfig(Lpips() if arguments.lpips else None, with_exposure=False)
    report = score_frames(tasks, config, progress=terminal_progress())
    sys.stdout.write(report.to_table() + "\n")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
