"""`lightsim view`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from lightsim.app.options import ViewOptions
from lightsim.cli.options import Verbose, WorkFolder, print_line
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class View:
    """Show a twin in the browser: move the sun, edit actors, look through the cameras."""

    work: WorkFolder
    """Work folder of a finished build."""
    options: Annotated[ViewOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False

    def run(self) -> None:
        """Serve the viewer until Ctrl-C, or write the page."""
        from lightsim.app.start import view

        view(self.work, self.options, terminal_progress(), print_line)
