"""`lightsim relight`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Profiled, Verbose, say
from lightsim.progress import terminal_progress
from lightsim.simulation.options import RelightOptions


@dataclass(frozen=True)
class Relight:
    """Re-render the log's frames under other skies."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    options: Annotated[RelightOptions, tyro.conf.arg(name="")]
    profile: Profiled = False
    verbose: Verbose = False

    def run(self) -> None:
        """Relight the log and print the paths of the results."""
        from lightsim.simulation.relight import relight

        for folder in relight(self.work, self.options, terminal_progress()):
            say(f"frames: {folder / 'frames'}")
            say(f"video:  {folder / 'video'}")
            say(f"report: {folder / 'report.html'}")
