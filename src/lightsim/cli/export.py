"""`lightsim export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.simulation.options import ExportOptions


@dataclass(frozen=True)
class Export:
    """Write a finished scenario in the format of a data set."""

    source: tyro.conf.Positional[Path]
    """WORK/scenarios/NAME, or WORK/scenarios/NAME/<sky> of a scenario with several skies."""
    out: Path
    """Folder to write; it must be new or empty. The same command continues an interrupted
    export."""
    options: Annotated[ExportOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False

    def run(self) -> None:
        """Write the export and print its folder."""
        from lightsim.simulation.export import export_scenario
        from lightsim.simulation.finished import find_scenario

        where = find_scenario(self.source)
        if where is None:
            raise InputError(
                "the folder is not that of a scenario",
                where=self.source,
                expected="WORK/scenarios/NAME of a work folder",
                remedy="Make one with lightsim relight or lightsim simulate.",
            )
        folder = export_scenario(where, self.out, self.options, terminal_progress())
        say(f"export: {folder}")
