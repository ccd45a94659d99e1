"""`lightsim export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, print_line
from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.simulation.options import ExportOptions


@dataclass(frozen=True, kw_only=True)
class ExportReading(LogReading):
    """Options of reading a recording, at full size by default."""

    source: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="SOURCE")]]
    """Folder of a finished scenario; or a recording, to which the options of reading apply."""
    image_scale: float = 1.0
    """Factor on the image size."""
    hold_out: Annotated[int, tyro.conf.Suppress] = 0


@dataclass(frozen=True)
class Export:
    """Write a finished scenario, or a recording, in the format of a data set.

    SOURCE is WORK/scenarios/NAME, or WORK/scenarios/NAME/<sky> of a scenario with several skies; or
    a recording for --format lightsim.
    """

    reading: ExportReading
    """Options of reading a recording; scenarios have none."""
    out: Path
    """Folder to write; it appears whole or not at all. The same command continues an interrupted
    export of a scenario."""
    options: Annotated[ExportOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False

    def run(self) -> None:
        """Write the export and print its folder."""
        from lightsim.simulation.finished import find_scenario

        where = find_scenario(Path(self.reading.source))
        if where is None:
            self._export_recording()
            return
        from lightsim.simulation.export import export_scenario

        if self.reading != ExportReading(source=self.reading.source):
            raise InputError(
                "a scenario has no options of reading",
                where=self.reading.source,
                expected="the frames, cameras and image size with which the scenario was made",
                remedy="Omit these options, or make a scenario with them.",
            )
        print_line(f"export: {export_scenario(where, self.out, self.options, terminal_progress())}")

    def _export_recording(self) -> None:
        from lightsim.api import load_log
        from lightsim.export.lightsim.log import write_lightsim_log
        from lightsim.simulation.finished import finished_scenarios

        source = Path(self.reading.source)
        finished = finished_scenarios(source)
        if finished:
            raise InputError(
                "the folder is not one scenario",
                where=source,
                expected=f"one of {', '.join(map(str, finished))}",
            )
        if self.options.format != "lightsim":
            raise InputError(
                "recordings are written in the format lightsim only",
                where=f"--format {self.options.format}",
                got=f"{self.reading.source}, which is not a scenario",
                expected="WORK/scenarios/NAME of a work folder",
                remedy="Build the recording and make a scenario with lightsim relight.",
            )
        log = load_log(self.reading)
        write_lightsim_log(log, self.out, terminal_progress())
        print_line(f"export: {self.out} ({len(log.frames)} pictures, {len(log.sweeps)} sweeps)")
