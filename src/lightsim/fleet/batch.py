"""One command over many logs: a process for each log, finished logs are skipped, failures are
reported at the end."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from lightsim.core.checks import check_number
from lightsim.errors import InputError
from lightsim.fleet.lines import BatchCommand, Line, Record, Request, line_of, read_records
from lightsim.fleet.process import run_here
from lightsim.progress import Progress

Engine = Literal["local", "ray"]
# Cores that a line without a record requests: those of the machine of the benchmarks.
_FIRST_CORES = 2
# Memory that it requests, in MB: the peak of a standard build at half size is 2.3 GB
# (docs/benchmarks/throughput.md).
_FIRST_MEMORY_MB = 3000
# Margin on measured memory, chosen: lines of one command differ in frames and actors.
_MEMORY_MARGIN = 1.3


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of a batch over logs."""

    out: Path
    """Folder for the commands' output (<log>.log) and for the record of each line (<log>.json)."""
    jobs: int = 1
    """local: processes at a time; each uses OMP_NUM_THREADS cores, by default an equal part of
    all."""
    only: int = 0
    """Run the I-th line of the list alone, counted from 1, as a task of a Slurm array; 0 runs
    all."""
    engine: Engine = "local"
    """local: processes on this machine; ray: on a Ray cluster (needs the extra `fleet`)."""
    address: str = ""
    """ray: address of the cluster, such as auto; by default Ray is started on this machine."""
    cores: int = 0
    """ray: cores of a line; 0 takes those that earlier lines of the command used, at first 2."""
    memory_gb: float = 0.0
    """ray: memory of a line; 0 takes 1.3 times that of earlier lines, at first 3."""
    gpus_per_log: float = 0.0
    """ray: GPUs of a line, or a fraction of one."""

    def __post_init__(self) -> None:
        check_number("--jobs", self.jobs, 1, 1024)
        check_number("--only", self.only, 0)
        check_number("--cores", self.cores, 0, 1024)
        check_number("--memory-gb", self.memory_gb, 0.0, 1e5)
        check_number("--gpus-per-log", self.gpus_per_log, 0.0, 64.0)


@dataclass(frozen=True)
class BatchResult:
    """Outcome of a batch.

    Args:
        run: number of lines that were run.
        kept: number of lines that had been finished before.
        failed: last line of each failed command's output, by its output file.
    """

    run: int
    kept: int
    failed: Mapping[Path, str]


def run_batch(
    command: BatchCommand,
    lines: Sequence[tuple[str, ...]],
    options: BatchOptions,
    progress: Progress,
) -> BatchResult:
    """Run `lightsim COMMAND LINE` for each line that is not finished.

    A line is finished when its command succeeded with these words in this version. A failed or
    interrupted line is run again, and resumes if its command can.

    Raises:
        InputError: there are no lines, or no line of the number `only`.
        MissingDependencyError: Ray is not installed.
    """
    _check_lines(lines, options.only)
    chosen = lines[options.only - 1 : options.only] if options.only else lines
    options.out.mkdir(parents=True, exist_ok=True)
    # Repeated lines would write the same files at the same time.
    jobs = [line_of((command, *words), options.out) for words in dict.fromkeys(chosen)]
    pending = [job for job in jobs if not job.is_done()]
    for job in pending:
        if job.read() is None:
            job.write(Record(job.words))
    failed: dict[Path, str] = {}
    with closing(_run(command, pending, options)) as running:
        for job, record in progress.track(running, command, len(pending)):
            # Written last: a crash leaves the line unfinished.
            job.write(record)
            if record.state == "failed":
                failed[job.log] = record.last_line
    return BatchResult(len(pending), len(jobs) - len(pending), failed)


def log_of(command: BatchCommand, line: tuple[str, ...], out: Path) -> Path:
    """Return the output file of a line."""
    return line_of((command, *line), out).log


def _check_lines(lines: Sequence[tuple[str, ...]], only: int) -> None:
    if not lines:
        raise InputError("the list contains no log", expected="one or more lines")
    if only > len(lines):
        raise InputError(
            "the list has no such line",
            where=f"--only {only}",
            expected=f"a number from 1 to {len(lines)}",
        )


def _run(
    command: BatchCommand, lines: Sequence[Line], options: BatchOptions
) -> Generator[tuple[Line, Record]]:
    if options.engine == "local":
        return run_here(lines, options.jobs)
    from lightsim.fleet.on_ray import run_on_ray

    known = [
        record
        for record in read_records(options.out).values()
        if record.words[0] == command and record.state == "done"
    ]
    requests = {line: request_of(line, known, options) for line in lines}
    return run_on_ray(requests, options.address)


def request_of(line: Line, known: Sequence[Record], options: BatchOptions) -> Request:
    """Return the resources of a line: from the options, otherwise from its last run, otherwise the
    largest of other lines of its command.

    Args:
        known: records of lines of the command that succeeded.
    """
    own = [record for record in known if record.words == line.words] or list(known)
    used = [math.ceil(record.cpu_seconds / record.seconds) for record in own if record.seconds > 0]
    first = Request(_FIRST_CORES, _FIRST_MEMORY_MB, options.gpus_per_log)
    measured = replace(
        first,
        cores=max(1, *used) if used else first.cores,
        memory_mb=max(
            (round(_MEMORY_MARGIN * record.peak_memory_mb) for record in own),
            default=first.memory_mb,
        ),
    )
    return replace(
        measured,
        cores=options.cores or measured.cores,
        memory_mb=round(1000 * options.memory_gb) or measured.memory_mb,
    )
