"""State of the artefacts of a work folder: `lightsim status`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from lightsim.build.pipeline import artefact_keys, read_options
from lightsim.datasets.fingerprint import hash_recording
from lightsim.errors import ArtefactError
from lightsim.store.artefact import (
    ArtefactKey,
    State,
    find_damage,
    hash_names,
    read_record,
    state_of,
)
from lightsim.store.reading import is_folder
from lightsim.store.staleness import explain_staleness

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class StageStatus:
    """One line of `lightsim status`.

    Args:
        name: of the stage.
        state: of its artefact.
        seconds: that the stage took; None where it is not recorded.
        peak_memory_mb: largest memory of the process until then; None where it is not recorded.
        reasons: why the artefact is stale, or what is damaged.
    """

    name: str
    state: State
    seconds: float | None
    peak_memory_mb: int | None
    reasons: tuple[str, ...]


def status(work: Path, *, is_hashed: bool = False) -> list[StageStatus]:
    """State of every artefact against the options that the last build of `work` used, and against
    the recording, where that is still in its place.

    Args:
        is_hashed: read every file and compare its bytes, not only its size.

    Raises:
        ArtefactError: `work` holds no build.
    """
    options = read_options(work)
    by_stage = artefact_keys(options, _source_key(work, Path(options.reading.source)))
    return [
        _status_of(work / name, artefact_key, is_hashed) for name, artefact_key in by_stage.items()
    ]


def _source_key(work: Path, source: Path) -> str:
    """Hash of the recording; where it is gone, of what the build found."""
    if is_folder(source):
        return hash_names(hash_recording(source))
    logger.warning("%s: the recording is gone; changes in it cannot be told", source)
    record = read_record(work / "log")
    return "" if record is None else record["inputs"].get("source", "")


def _status_of(folder: Path, artefact_key: ArtefactKey, is_hashed: bool) -> StageStatus:
    state = state_of(folder, artefact_key)
    try:
        record = read_record(folder)
    except ArtefactError as error:
        return StageStatus(folder.name, state, None, None, (error.what,))
    if record is None:
        return StageStatus(folder.name, state, None, None, ())
    reasons = find_damage(folder, record, is_hashed=is_hashed)
    if reasons and state == "made":
        state = "broken"
    if state == "stale":
        reasons = (*explain_staleness(record, artefact_key), *reasons)
    return StageStatus(folder.name, state, record["seconds"], record["peak_memory_mb"], reasons)
