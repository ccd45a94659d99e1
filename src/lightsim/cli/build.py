"""`lightsim build`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.build.options import BuildOptions
from lightsim.cli.options import Profiled, Verbose, print_line
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Build:
    """Turn a recorded log into a twin: meshes, base colour and the source sky."""

    work: Path
    """Work folder to create or to continue."""
    options: Annotated[BuildOptions, tyro.conf.arg(name="")]
    until: str = "report"
    """Last stage to make, such as sky or twin; lightsim status lists all stages."""
    profile: Profiled = False
    verbose: Verbose = False

    def run(self) -> None:
        """Make the missing and stale stages of the work folder."""
        from lightsim.build import pipeline as pipeline

        pipeline.build(self.work, self.options, terminal_progress(), self.until)
        if self.until == "report":
            print_line(f"twin:   {self.work / 'twin' / 'twin.json'}")
            print_line(f"report: {self.work / 'report' / 'index.html'}")
        else:
            print_line(f"made up to {self.until}: {self.work}")
