"""Driver of studies: runs the commands of their rows in steps and collects failures."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

from lightsim.fleet.batch import BatchOptions, log_of, run_batch
from lightsim.fleet.lines import BatchCommand
from lightsim.progress import Progress

Row = TypeVar("Row", bound=Hashable)


class Failure(NamedTuple):
    """Failed command of a row: the file of its output, and the last line of that file."""

    row: Hashable
    log: Path
    last_line: str

    def __str__(self) -> str:
        return f"{self.log}: {self.last_line}"


class Study:
    """Runs one step of a study after another: one command per row.

    A repeated study runs only the unfinished commands. The next step processes the rows that `run`
    returns, so that a failed row does not stop the others.

    Args:
        out: folder for the output and the markers of finished commands.
        jobs: number of simultaneous processes.
    """

    def __init__(self, out: Path, jobs: int, progress: Progress) -> None:
        self.failures: list[Failure] = []
        self._batch, self._progress = BatchOptions(out=out, jobs=jobs), progress

    @property
    def notes(self) -> list[str]:
        """Failures of all steps, one line each."""
        return [f"Failed: {failure}" for failure in self.failures]

    def run(self, command: BatchCommand, lines: Mapping[Row, tuple[str, ...]]) -> list[Row]:
        """Run `lightsim COMMAND LINE` for each row; return the rows whose command succeeded."""
        if not lines:
            return []
        failed = run_batch(command, list(lines.values()), self._batch, self._progress).failed
        logs = {row: log_of(command, line, self._batch.out) for row, line in lines.items()}
        self.failures += [
            Failure(row, log, failed[log]) for row, log in logs.items() if log in failed
        ]
        return [row for row, log in logs.items() if log not in failed]
