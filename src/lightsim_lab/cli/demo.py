"""Command `lightsim demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightsim.cli.options import Verbose, print_line, program
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Demo:
    """Build and relight the synthetic street that ships with the package."""

    out: Path = Path("out/demo")
    """Folder for all results."""
    full: bool = False
    """Use all cameras and frames, train as long as the preset does, and relight all cameras."""
    seed: int = 0
    """Seed of all random numbers."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Build, relight and measure the shipped street."""
        from lightsim_lab.studies.demo import next_steps, run_demo

        page = run_demo(self.out, self.seed, terminal_progress(), is_full=self.full)
        print_line("try next, on the built street (up to two minutes each):")
        for _, words in next_steps(self.out):
            print_line(f"  {program()} {words}")
        print_line(f"open: {page}")
