"""Common parts of the commands: options, groups, and printing of results."""

from __future__ import annotations

import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import tyro

from lightsim.fleet.staging import shown

Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"], help="Show the stack trace of an error.")]
WorkFolder = tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="WORK")]]
Profiled = Annotated[
    bool,
    tyro.conf.arg(
        help="Measure processor time, wall time and memory by stage and module; print them at the "
        "end, and add them to the report."
    ),
]


@runtime_checkable
class Report(Protocol):
    """A measurement that can be printed or stored."""

    def to_table(self) -> str:
        """Return aligned text for a terminal."""
        ...

    def to_json(self) -> str:
        """Return the figures as JSON text."""
        ...


@dataclass(frozen=True)
class CommandGroup:
    """A command with sub-commands, one of which is chosen in its field `do`."""

    do: Any

    def run(self) -> None:
        """Run the chosen sub-command."""
        self.do.run()


def print_line(text: str) -> None:
    """Print a line on standard output, with URLs in place of staged paths."""
    sys.stdout.write(shown(text) + "\n")
    # Lines of long commands must appear at once, also in a log file.
    sys.stdout.flush()


def program() -> str:
    """Return the shell words that start this program again: `lightsim` if it is on the PATH, else
    the path with which it was started, such as .venv/bin/lightsim."""
    # `python -m lightsim` starts a file of another name.
    started = Path(sys.argv[0])
    if started.name != "lightsim":
        return f"{shlex.quote(sys.executable)} -m lightsim"
    found = shutil.which("lightsim")
    is_found = found is not None and Path(found).resolve() == started.resolve()
    return "lightsim" if is_found else shlex.quote(str(started))


def show(report: Report, out: Path | None) -> None:
    """Print a report's table, and write its figures as JSON if a file is given."""
    print_line(report.to_table())
    if out is not None:
        # Imported here, so that `lightsim --help` is fast.
        from lightsim.store.artefact import write_text

        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, report.to_json() + "\n")
