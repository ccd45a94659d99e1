"""`lightsim relight`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from lightsim.cli.options import Verbose, names, say
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class SkyOptions:
    sky: str = "source"
    """A .hdr or .exr file, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO, or source."""
    sky_yaw_deg: float = 0.0
    """Turn the sky, clockwise seen from above."""
    sky_scale: str = "auto"
    """auto: the mean illuminance of the source; none: radiance as stored; or a number."""


@dataclass(frozen=True)
class Relight:
    """Re-render the log's frames under another sky."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    name: str
    """Name of the result: WORK/scenarios/NAME."""
    sky: tyro.conf.OmitArgPrefixes[SkyOptions]
    method: Literal["physical"] = "physical"
    """How pixels are relit: shading ratios of the reconstructed scene."""
    exposure_ev: float = 0.0
    """Exposure of the output, in stops."""
    cameras: str = ""
    """Comma-separated camera names; empty for all."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    image_scale: float | None = None
    """Factor on the log's image size; by default that of the build."""
    linear: bool = False
    """Write linear EXR frames as well."""
    overwrite: bool = False
    """Replace a result of this name that was made with another sky or other settings."""
    allow_stale: bool = False
    """Go on where the recording has changed since the build."""
    seed: int = 0
    """Of the sampling of rays."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Relight, and say where the frames are."""
        from lightsim.simulate import relight as scenarios
        from lightsim.simulate.skies import SkyChoice

        options = scenarios.RelightOptions(
            name=self.name,
            sky=SkyChoice(self.sky.sky, self.sky.sky_yaw_deg, self.sky.sky_scale),
            method=self.method,
            exposure_ev=self.exposure_ev,
            cameras=names(self.cameras),
            frames=self.frames,
            image_scale=self.image_scale,
            is_linear_written=self.linear,
            seed=self.seed,
            is_overwriting=self.overwrite,
            is_stale_allowed=self.allow_stale,
        )
        folder = scenarios.relight(self.work, options, terminal_progress())
        say(f"frames: {folder / 'frames'}")
        say(f"video:  {folder / 'video'}")
        say(f"report: {folder / 'report.html'}")
