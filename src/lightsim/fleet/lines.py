"""Lines of a batch: words of a command, the record of its last run, and its resources."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lightsim.core.version import __version__
from lightsim.errors import ArtefactError, InputError
from lightsim.store.artefact import read_json, write_json
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

BatchCommand = Literal[
    "check", "synthesize", "build", "train", "relight", "simulate", "render", "evaluate", "export"
]
LineState = Literal["waiting", "done", "failed"]


@dataclass(frozen=True)
class Record:
    """Record of a line, OUT/<log>-<hash>.json.

    Args:
        words: the command and its words.
        version: version of LightSim that ran the line.
        state: waiting until the first run ends, then done or failed.
        exit_code: exit code of the process; negative for the signal that killed it.
        seconds: wall time.
        cpu_seconds: processor time, with that of child processes.
        peak_memory_mb: largest resident size of the process or of a child process. Linux counts
            from the size of the process that starts it, here that of `lightsim batch`.
        host: machine of the run.
        last_line: last line of the output.
    """

    words: tuple[str, ...]
    version: str = __version__
    state: LineState = "waiting"
    exit_code: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_memory_mb: int = 0
    host: str = ""
    last_line: str = ""


@dataclass(frozen=True)
class Request:
    """Resources that a line requests from the scheduler."""

    cores: int
    memory_mb: int
    gpus: float


@dataclass(frozen=True)
class Line:
    """A line of a batch: the command with its words, and the file of its output."""

    words: tuple[str, ...]
    log: Path

    @property
    def record_path(self) -> Path:
        """OUT/<log>-<hash>.json."""
        return self.log.with_suffix(".json")

    def read(self) -> Record | None:
        """Return the record; None if there is none, or if it is damaged or of other words."""
        try:
            record = read_record(self.record_path)
        except ArtefactError:
            return None
        return record if record is not None and record.words == self.words else None

    def write(self, record: Record) -> None:
        """Write the record, whole or not at all."""
        write_json(self.record_path, record)

    def is_done(self) -> bool:
        """Return True if the line succeeded with these words in this version."""
        record = self.read()
        return record is not None and (record.state, record.version) == ("done", __version__)


def line_of(words: tuple[str, ...], out: Path) -> Line:
    """Return a line with a file name from its first log and a hash of all its words.

    The name does not depend on the line's position: lists may be reordered, and extended.
    """
    # Short, since it only separates lines with the same first log.
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
    # `evaluate` and `train` have another word, the subject, before the log.
    is_second = words[0] in ("evaluate", "train") and len(words) > 2
    given = list(words[2:] if is_second else words[1:])
    paths = [word for word in given if "/" in word]
    named = Path(given[0] if not given[0].startswith("-") or not paths else paths[0]).name
    safe = re.sub(r"[^\w.-]", "_", named)[:60]
    return Line(words, out / f"{safe}-{digest}.log")


def read_list(path: Path) -> list[tuple[str, ...]]:
    """Return the words of each line of a list of logs.

    A line has the words that follow the command, quoted as in a shell; # starts a comment.

    Raises:
        InputError: the file cannot be read, or a line's quotes do not match.
    """
    lines = []
    text = read_bytes(path, "list of logs", MAX_JSON_BYTES).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        if words := split_words(line, f"{path}:{number}"):
            lines.append(words)
    return lines


def split_words(text: str, where: str) -> tuple[str, ...]:
    """Return the words of a text as a shell splits them.

    Raises:
        InputError: quotes do not match.
    """
    try:
        return tuple(shlex.split(text, comments=True))
    except ValueError as error:
        raise InputError(
            "a line of the list cannot be read",
            where=where,
            got=error,
            expected="words as in a shell",
        ) from error


def read_record(path: Path) -> Record | None:
    """Return a record; None if the file does not exist or is no record of a line.

    Raises:
        ArtefactError: the file is not JSON.
    """
    value: Any = read_json(path) if path.is_file() else None
    try:
        return Record(**{**value, "words": tuple(map(str, value["words"]))})
    except (TypeError, KeyError):
        return None


def read_records(out: Path) -> dict[Path, Record]:
    """Return the records in the folder of a batch, by their files."""
    found = {path: read_record(path) for path in sorted(out.glob("*-*.json"))}
    return {path: record for path, record in found.items() if record is not None}


def grouped(last_lines: Mapping[Path, str]) -> dict[str, list[Path]]:
    """Return the files of failed lines by error, the most frequent error first.

    Errors that differ only in their places (words with a slash, a digit or a colon) are one error.
    """
    groups: dict[str, list[Path]] = {}
    for path, text in last_lines.items():
        groups.setdefault(re.sub(r"\S*[/\d:]\S*", "*", text), []).append(path)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))
