"""Checks of the folder that an export is written to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from lightsim.errors import ArtefactError, InputError
from lightsim.store.artefact import RECORD_NAME, ArtefactKey, read_record
from lightsim.store.atomic import unwritable


def check_place(folder: Path, taken: Sequence[Path], option: str) -> None:
    """Check that a folder is outside of folders whose files are counted, and create its parent.

    Args:
        taken: folders of the recording and of scenarios.
        option: name of the option that gives the folder.

    Raises:
        InputError: the folder is inside one of them or inside an artefact.
        ArtefactError: its parent cannot be created.
    """
    # A log inside such a folder would change its hash.
    paths = {path.resolve() for path in taken}
    is_taken = [p for p in folder.parents if p in paths or (p / RECORD_NAME).is_file()]
    around = [folder, *is_taken] if folder in paths else is_taken
    if around:
        raise InputError(
            "the log would be written into a folder of a recording or an artefact",
            where=folder,
            expected=f"a folder outside of {around[0]}",
            remedy=f"Choose another {option}.",
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error


def check_export(folder: Path, artefact_key: ArtefactKey, option: str) -> None:
    """Check that a folder is missing, empty, or the same export, which is complete then.

    Raises:
        InputError: the folder contains other files.
    """
    if not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir())):
        return
    found = "other files"
    try:
        record = read_record(folder) if folder.is_dir() else None
    except ArtefactError:
        record = None
    if record is not None and record["stage"] == artefact_key.stage:
        if record["key"] == artefact_key.key:
            return
        found = "an export of other frames, of other options or by another LightSim"
    raise InputError(
        "the folder is not empty",
        where=folder,
        got=found,
        expected="no folder, an empty one, or the same export",
        remedy=f"Delete the folder, or choose another {option}.",
    )
