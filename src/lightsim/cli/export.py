"""`lightsim export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.core.checks import check_choice
from lightsim.core.reading import LogReading
from lightsim.progress import terminal_progress

FORMATS = ("lightsim",)
"""Formats of --format."""


@dataclass(frozen=True, kw_only=True)
class ExportReading(LogReading):
    """Options of reading the recording, at full size by default."""

    image_scale: float = 1.0
    """Factor on the image size."""
    hold_out: Annotated[int, tyro.conf.Suppress] = 0


@dataclass(frozen=True)
class Export:
    """Write a recording in another format."""

    reading: Annotated[ExportReading, tyro.conf.arg(name="")]
    out: Path
    """Folder to write; it appears whole or not at all."""
    format: str = "lightsim"
    """Format: lightsim, the folder that docs/reference/lightsim-log.md describes."""
    verbose: Verbose = False

    def __post_init__(self) -> None:
        check_choice("--format", self.format, FORMATS)

    def run(self) -> None:
        """Read the recording and write it."""
        from lightsim.api import load_log
        from lightsim.export.lightsim.log import write_lightsim_log

        log = load_log(self.reading)
        write_lightsim_log(log, self.out, terminal_progress())
        say(f"log: {self.out} ({len(log.frames)} pictures, {len(log.sweeps)} sweeps)")
