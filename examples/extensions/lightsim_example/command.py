"""A command: `lightsim sun WORK` prints where the sun of a twin is."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class ShowSun:
    """Print the position of the source sun of a twin."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    in_world: bool = False
    """Print a unit vector in frame world instead of azimuth and elevation."""

    def run(self) -> None:
        """Run the command; heavy packages are imported here, not at the top of the file."""
        from lightsim.build.workspace import Workspace

        sky = Workspace(self.work).sky
        line = f"azimuth {sky.sun_azimuth_deg} elevation {sky.sun_elevation_deg:.2f} degrees"
        if self.in_world and sky.dome.sun is not None:
            line = " ".join(f"{value:.4f}" for value in sky.dome.sun.direction_world)
        sys.stdout.write(f"{line}\n")
