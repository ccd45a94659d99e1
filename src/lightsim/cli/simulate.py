"""`lightsim simulate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Profiled, Verbose, WorkFolder, print_line
from lightsim.progress import terminal_progress
from lightsim.simulation.options import SimulateOptions


@dataclass(frozen=True)
class Simulate:
    """Remove, move and insert actors, and change the ego path, under any sky."""

    work: WorkFolder
    """Work folder of a finished build."""
    scenario: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="SCENARIO.json")]]
    """SCENARIO.json: edits of the log (docs/reference/scenario-json.md)."""
    options: Annotated[SimulateOptions, tyro.conf.arg(name="")]
    profile: Profiled = False
    verbose: Verbose = False

    def run(self) -> None:
        """Simulate the scenario and print the paths of the results."""
        from lightsim.simulation.edited import simulate

        for folder in simulate(self.work, self.scenario, self.options, terminal_progress()):
            print_line(f"frames: {folder / 'frames'}")
            print_line(f"video:  {folder / 'video'}")
            print_line(f"report: {folder / 'report.html'}")
        if self.options.write_log is not None:
            print_line(f"log:    {self.options.write_log}")
