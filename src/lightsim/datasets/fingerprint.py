"""Hashes of a recording's files, which reveal changes after the build."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from lightsim.datasets.pandaset.rig import calibration_path
from lightsim.errors import InputError
from lightsim.store.artefact import hash_file, hash_files
from lightsim.store.reading import is_folder

# Number of files that a message lists.
_SHOWN = 3


def hash_recording(source: Path) -> dict[str, str]:
    """Return the hash of every file of the log, by its path from the log's folder.

    The name of the folder is not included: a recording may be moved and renamed.

    Raises:
        InputError: the folder does not exist, or a file cannot be read.
    """
    if not is_folder(source):
        raise InputError(
            "the recording does not exist",
            where=source,
            remedy="Move it back, or run lightsim build with its new path.",
        )
    try:
        found = hash_files(source)
        # The calibration may lie beside the logs, but determines the ego path.
        calibration = calibration_path(source)
        if calibration is not None and calibration.parent != source:
            found[f"../{calibration.name}"] = hash_file(calibration)
    except OSError as error:
        raise InputError(
            "a file of the recording cannot be read",
            where=error.filename or source,
            got=error.strerror,
            remedy="Check the permissions and the disk.",
        ) from error
    return found


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
