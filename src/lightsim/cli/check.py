"""`lightsim check`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, print_line
from lightsim.core.reading import LogReading
from lightsim.errors import InputError


@dataclass(frozen=True)
class Check:
    """Show what a recording contains and lacks, with LiDAR and boxes drawn on its pictures."""

    reading: Annotated[LogReading, tyro.conf.arg(name="")]
    out: Path = Path("check")
    """Folder of the page, which is created."""
    verbose: Verbose = False

    def run(self) -> None:
        """Write the page, print the findings, and fail if the recording cannot be built."""
        from lightsim.build.log_check import check_log, write_check
        from lightsim.datasets.reader import read_log
        from lightsim.datasets.scale import at_scale

        log = at_scale(read_log(self.reading), self.reading.image_scale)
        check = check_log(log, self.reading)
        self.out.mkdir(parents=True, exist_ok=True)
        page = write_check(self.out, check, self.reading)
        print_line(f"{log.name}: {len(log.frames)} pictures, {len(log.sweeps)} sweeps, "
            f"{len(log.actors)} actors")  # fmt: skip
        for finding in check.findings:
            print_line(f"  {finding.what}: {finding.cost}")
        print_line(f"page: {page}")
        if check.fatal:
            raise InputError(
                "the recording cannot be built",
                where=self.reading.source,
                got=check.fatal[0].what,
                remedy=check.fatal[0].cost,
            )
