"""`lightsim doctor`."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.cli.options import Verbose, print_line


@dataclass(frozen=True)
class Doctor:
    """Check this machine: packages, processor, memory, disk, GPU, renderers and weights."""

    verbose: Verbose = False

    def run(self) -> None:
        """Print the findings with advice."""
        from lightsim.cli.diagnosis import diagnose

        print_line(diagnose().to_table())
