"""`lightsim doctor`."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.cli.options import Verbose, say


@dataclass(frozen=True)
class Doctor:
    """Say what this machine has, what is missing, and what will be slow."""

    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Print the diagnosis."""
        from lightsim.cli.diagnosis import diagnose

        say(diagnose().to_table())
