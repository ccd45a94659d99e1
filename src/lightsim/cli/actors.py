"""`lightsim actors`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from lightsim.cli.options import Verbose, say


@dataclass(frozen=True)
class Actors:
    """List the actors that a scenario can remove or move, with pictures."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """The table, and where the page with the pictures is."""
        from lightsim.simulation.harvest import COLUMNS, write_actors_page

        page, table = write_actors_page(self.work)
        rows = [[str(cell) for cell in row] for row in table]
        widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
        for row in (COLUMNS, *rows):
            say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)))
        say(f"pictures: {page}")
