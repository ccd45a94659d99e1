"""`lightsim render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, WorkFolder, print_line
from lightsim.progress import terminal_progress
from lightsim.simulation.options import RenderOptions


@dataclass(frozen=True)
class Render:
    """Write geometry and light buffers of the twin as EXR files."""

    work: WorkFolder
    """Work folder of a finished build."""
    out: Path
    """Folder for DIR/<what>/<camera>/<frame>.exr, or DIR/<sky>/<what>/... with several skies;
    existing files are not rewritten, so the same command continues an interrupted run."""
    options: Annotated[RenderOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False

    def run(self) -> None:
        """Render the buffers and print the number of frames."""
        from lightsim.simulation.buffers import render

        done = render(self.work, self.out, self.options, terminal_progress())
        complete = done.frames - done.rendered
        print_line(
            f"buffers: {self.out} ({done.rendered} frames rendered, {complete} were complete)"
        )
