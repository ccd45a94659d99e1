"""`lightsim batch`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.errors import ArtefactError
from lightsim.fleet.batch import BatchCommand, BatchOptions
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Batch:
    """Synthesize, build, train on, relight or evaluate many logs: a process each, resumable."""

    command: tyro.conf.Positional[BatchCommand]
    """Command that runs on each log."""
    list: tyro.conf.Positional[Path]
    """Text file, one log a line: the words that follow the command, such as
    pandaset/001 --work works/001. # starts a comment."""
    options: Annotated[BatchOptions, tyro.conf.arg(name="")]
    words: str = ""
    """Options for all logs, in one quoted text: --words="--preset draft --hold-out 8"."""
    verbose: Verbose = False

    def run(self) -> None:
        """Run the unfinished commands and report failures."""
        from lightsim.fleet.batch import read_list, run_batch

        # Common options follow those of the line, as on a command line.
        lines = [(*line, *shlex.split(self.words)) for line in read_list(self.list)]
        result = run_batch(self.command, lines, self.options, terminal_progress())
        done = result.run - len(result.failed)
        say(f"done: {done}, finished before: {result.kept}, failed: {len(result.failed)}")
        for log, last in result.failed.items():
            say(f"failed: {log}: {last}")
        if result.failed:
            raise ArtefactError(
                f"{len(result.failed)} of {result.run} commands failed",
                where=self.options.out,
                remedy="See the logs; the same command runs what failed again.",
            )
