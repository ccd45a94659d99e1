"""`lightsim build`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from lightsim.cli.options import Device, Verbose, names, say
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Build:
    """Turn a recorded log into a twin: meshes, base colour and the source sky."""

    source: tyro.conf.Positional[Path]
    """Folder of the recording."""
    work: Path
    """Work folder to make or to go on with."""
    dataset: Literal["auto", "pandaset"] = "auto"
    """Format of the recording."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    cameras: str = ""
    """Comma-separated camera names; empty for all."""
    hold_out: int = 0
    """Keep every n-th frame and sweep from the build, for evaluation; 0 keeps none."""
    preset: Literal["draft", "standard", "paper"] = "standard"
    """Quality of the reconstruction."""
    image_scale: float = 0.5
    """Factor on the image size."""
    colour: Literal["texture", "vertex", "field"] | None = None
    """Colour of the meshes: at image resolution, at vertices, or (the paper's) the neural field's
    at vertices; by default the preset's."""
    no_refine: str = ""
    """Comma-separated physics of the log to leave out: rolling_shutter, point_times,
    own_car_masks, lidar_poses, actor_tracks, camera_poses, camera_gains."""
    heading_deg: float | None = None
    """Azimuth of the world x axis, where the log cannot tell it (clockwise from north)."""
    gps: Literal["all", "place", "none"] = "all"
    """What the sun is found with besides the images: place, time and heading; place and time; or
    nothing."""
    device: Device = "auto"
    """Where the neural field is trained; auto takes CUDA where there is one."""
    neural_steps: int | None = None
    """Training steps of the neural field; by default the preset's; 0 keeps the fused LiDAR."""
    seed: int = 0
    """Of all random numbers."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Make what is missing or stale in the work folder."""
        from lightsim.pipeline import build as pipeline
        from lightsim.store.log import LogReading

        reading = LogReading(
            str(self.source.resolve()),
            self.dataset,
            names(self.cameras),
            self.frames,
            self.heading_deg,
            self.image_scale,
            self.hold_out,
        )
        options = pipeline.BuildOptions(
            reading,
            self.preset,
            self.seed,
            self.neural_steps,
            self.device,
            names(self.no_refine),
            self.colour,
            self.gps,
        )
        pipeline.build(self.work, options, terminal_progress())
        say(f"twin:   {self.work / 'twin' / 'twin.json'}")
        say(f"report: {self.work / 'report' / 'index.html'}")
