"""`lightsim relight`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from lightsim.cli.options import Profiled, Verbose, WorkFolder, print_line
from lightsim.progress import terminal_progress
from lightsim.simulation.options import RelightOptions


@dataclass(frozen=True)
class Relight:
    """Re-render the log's frames under other skies."""

    work: WorkFolder
    """Work folder of a finished build."""
    options: Annotated[RelightOptions, tyro.conf.arg(name="")]
    profile: Profiled = False
    verbose: Verbose = False

    def run(self) -> None:
        """Relight the log and print the paths of the results."""
        from lightsim.simulation.relight import relight

        for folder in relight(self.work, self.options, terminal_progress()):
            print_line(f"frames: {folder / 'frames'}")
            print_line(f"video:  {folder / 'video'}")
            print_line(f"report: {folder / 'report.html'}")
