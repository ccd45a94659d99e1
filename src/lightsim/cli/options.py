"""What the commands share: options, words, and how results are shown."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Protocol, runtime_checkable

import tyro

Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"])]


@runtime_checkable
class Report(Protocol):
    """A measurement that can be shown."""

    def to_table(self) -> str:
        """Aligned text for a terminal."""
        ...

    def to_json(self) -> str:
        """The same figures as a JSON text."""
        ...


def say(text: str) -> None:
    """A line on standard output, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def program() -> str:
    """Return how this program is started again: `lightsim` where the PATH leads to it, else the
    path by which it was started, such as .venv/bin/lightsim."""
    started = Path(sys.argv[0])
    if started.name != "lightsim":
        return f"{shlex.quote(sys.executable)} -m lightsim"
    found = shutil.which("lightsim")
    is_found = found is not None and Path(found).resolve() == started.resolve()
    return "lightsim" if is_found else shlex.quote(str(started))


def names(text: str) -> tuple[str, ...]:
    """ "a, b" -> ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def show(report: Report, out: Path | None) -> None:
    """The table on standard output, and the numbers as JSON where a file is named."""
    say(report.to_table())
    if out is not None:
        from lightsim.store.artefact import write_text

        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, report.to_json() + "\n")
