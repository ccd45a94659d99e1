"""`lightsim actors`."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.cli.options import Verbose, WorkFolder, print_line


@dataclass(frozen=True)
class Actors:
    """List the actors that a scenario can remove or move, with pictures."""

    work: WorkFolder
    """Work folder of a finished build."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print a table of the actors and the path of the page with pictures."""
        from lightsim.simulation.harvest import COLUMNS, write_actors_page

        page, table = write_actors_page(self.work)
        rows = [[str(cell) for cell in row] for row in table]
        # Columns are as wide as their widest cell.
        widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
        for row in (COLUMNS, *rows):
            print_line(
                "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            )
        print_line(f"pictures: {page}")
