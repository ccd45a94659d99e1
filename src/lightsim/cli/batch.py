"""`lightsim batch`."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeAlias, Union

import tyro

from lightsim.cli.options import CommandGroup, Verbose, print_line
from lightsim.errors import ArtefactError, InputError
from lightsim.fleet.batch import BatchOptions, BatchResult
from lightsim.fleet.lines import BatchCommand
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class BatchRun:
    """A command over many logs."""

    command: ClassVar[BatchCommand]
    list: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="LIST")]]
    """Text file, one log a line: the words that follow the command, such as
    pandaset/001 --work works/001. # starts a comment."""
    options: Annotated[BatchOptions, tyro.conf.arg(name="")]
    words: str = ""
    """Options for all logs, in one quoted text: --words="--preset draft --hold-out 8"."""
    verbose: Verbose = False

    def run(self) -> None:
        """Run the unfinished commands and report failures."""
        from lightsim.fleet.batch import run_batch
        from lightsim.fleet.lines import read_list

        # Common options follow those of the line, as on a command line.
        lines = [(*line, *shlex.split(self.words)) for line in read_list(self.list)]
        result = run_batch(self.command, lines, self.options, terminal_progress())
        report(result, self.options.out)


@dataclass(frozen=True)
class BatchStatus:
    """Show the lines of a batch that are done, failed or waiting, and their cost."""

    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Folder --out of the batch."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print one line per record, the sums, and the failures by error."""
        from lightsim.fleet.lines import read_records

        records = read_records(self.out)
        if not records:
            raise InputError(
                "the folder has no records of a batch",
                where=self.out,
                got="a folder without them" if self.out.is_dir() else "no such folder",
                expected="the folder --out of a lightsim batch that has started",
            )
        for path, record in records.items():
            cost = f"{record.seconds:9.1f} s{record.peak_memory_mb:7d} MB"
            print_line(f"{record.state:8s}{cost}  {record.host:12s} {path.stem}")
        hours = sum(record.cpu_seconds for record in records.values()) / 3600
        counts = Counter(record.state for record in records.values())
        print_line(
            ", ".join(f"{state}: {n}" for state, n in counts.items()) + f"; {hours:.2f} core hours"
        )
        failed = {p: record for p, record in records.items() if record.state == "failed"}
        _print_failures({p.with_suffix(".log"): r.last_line for p, r in failed.items()})


@dataclass(frozen=True)
class BatchPlan:
    """Show what an experiment of several steps makes and costs, and run it with --start."""

    plan: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="PLAN.yaml")]]
    """YAML file such as examples/fleet/paper.yaml (needs the extra `fleet`)."""
    options: Annotated[BatchOptions, tyro.conf.arg(name="")]
    set: tuple[str, ...] = ()
    """NAME=VALUE: values in place of those of the plan, such as items="001 002"."""
    start: bool = False
    """Run the unfinished lines."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print a line per step with the measured cost; with --start, run the steps."""
        from lightsim.fleet.plan import cost_of, read_plan, run_plan

        steps = read_plan(self.plan, self.set)
        costs = [cost_of(step, self.options.out) for step in steps]
        print_line("command      lines   done  pictures  core s a line         core hours left")
        for cost in costs:
            pictures = "all frames" if cost.pictures is None else f"{cost.pictures or '-'}"
            origin = "measured here" if cost.is_measured else "of the plan"
            print_line(
                f"{cost.command:12}{cost.lines:6}{cost.done:7}{pictures:>10}"
                f"{cost.core_seconds:10.1f} {origin:14}{cost.core_hours_left:9.2f}"
            )
        print_line(f"core hours left: {sum(cost.core_hours_left for cost in costs):.2f}")
        if self.start:
            report(run_plan(steps, self.options, terminal_progress()), self.options.out)


_COMMANDS: Mapping[BatchCommand, str] = {
    "check": "Check many logs",
    "synthesize": "Make many synthetic logs",
    "build": "Build many logs",
    "train": "Train on many twins",
    "relight": "Relight many logs",
    "simulate": "Simulate many scenarios",
    "render": "Render buffers of many twins, or of parts of their frames",
    "evaluate": "Evaluate many results",
    "export": "Export many scenarios",
}


def _runs() -> Any:
    """Return the union of the sub-commands: one for each command, with the same options."""
    kinds: dict[str, type[Any]] = {
        name: type(
            f"Batch{name.title()}",
            (BatchRun,),
            {"command": name, "__doc__": f"{text}: a process each, resumable."},
        )
        for name, text in _COMMANDS.items()
    }
    kinds |= {"plan": BatchPlan, "status": BatchStatus}
    named = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items())
    return tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Union[named]]]  # noqa: UP007


if TYPE_CHECKING:
    Runs: TypeAlias = Any
else:
    Runs = _runs()


@dataclass(frozen=True)
class BatchGroup(CommandGroup):
    """A command over many logs, on this machine or on Ray: a process each, resumable."""

    do: Runs


def report(result: BatchResult, out: Path) -> None:
    """Print the outcome of a batch, failures by error.

    Raises:
        ArtefactError: a line failed.
    """
    done = result.run - len(result.failed)
    print_line(f"done: {done}, finished before: {result.kept}, failed: {len(result.failed)}")
    _print_failures(result.failed)
    if result.failed:
        raise ArtefactError(
            f"{len(result.failed)} of {result.run} commands failed",
            where=out,
            remedy="See the logs; the same command runs what failed again.",
        )


def _print_failures(last_lines: Mapping[Path, str]) -> None:
    from lightsim.fleet.lines import grouped

    for paths in grouped(last_lines).values():
        print_line(f"failed {len(paths)} times: {last_lines[paths[0]]}")
        for path in paths:
            print_line(f"  {path}")
