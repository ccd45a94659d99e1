"""Hashes of a recording's files, which reveal changes after the build."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from lightsim.core.reading import LogReading
from lightsim.datasets.reader import check_layout, reader_of
from lightsim.errors import InputError
from lightsim.store.artefact import hash_file, hash_files

# Number of files that a message lists.
_SHOWN = 3


def hash_recording(reading: LogReading) -> dict[str, str]:
    """Return the hash of every file that determines the log, by its path from SOURCE.

    The name of SOURCE is not included: a recording may be moved and renamed.

    Raises:
        InputError: SOURCE does not exist, is of no known data set, or a file cannot be read.
    """
    source = Path(reading.source)
    if not source.exists():
        raise InputError(
            "the recording does not exist",
            where=source,
            remedy="Move it back, or run lightsim build with its new path.",
        )
    reader = reader_of(check_layout(reading))
    try:
        if reader.files is None:
            return hash_files(source)
        named = {
            Path(os.path.relpath(path, source)).as_posix(): path for path in reader.files(reading)
        }
        named |= reader.derived(reading)
        return {name: hash_file(named[name]) for name in sorted(named)}
    except OSError as error:
        raise InputError(
            "a file of the recording cannot be read",
            where=error.filename or source,
            got=error.strerror,
            remedy="Check the permissions and the disk.",
        ) from error


def describe_change(before: Mapping[str, str], now: Mapping[str, str]) -> str | None:
    """Describe the difference between two states of a recording; None if there is none."""
    changed = [
        f"{name} was changed" for name in before if now.get(name, before[name]) != before[name]
    ]
    changed += [f"{name} is gone" for name in before if name not in now]
    changed += [f"{name} is new" for name in now if name not in before]
    more = len(changed) - _SHOWN
    words = "; ".join(changed[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
    return words or None
