"""`lightsim status`."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.cli.options import Verbose, WorkFolder, print_line


@dataclass(frozen=True)
class Status:
    """Show which artefacts of a work folder are made, stale, broken or missing, and why."""

    work: WorkFolder
    """Work folder."""
    verify: bool = False
    """Read every file and compare its bytes with what was written, not only its size."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print one line per artefact, followed by the reasons if it is stale or damaged."""
        from lightsim.build.status import status

        for line in status(self.work, is_hashed=self.verify):
            took = "" if line.seconds is None else f"{line.seconds:8.1f} s"
            memory = "" if line.peak_memory_mb is None else f"{line.peak_memory_mb:6d} MB"
            print_line(f"{line.name:16s}{line.state:8s}{took:>12s}{memory:>12s}")
            for reason in line.reasons:
                print_line(f"          {reason}")
