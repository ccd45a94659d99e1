"""State of the artefacts of a work folder: `lightsim status`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from lightsim.build.pipeline import artefact_keys, read_options
from lightsim.core.reading import LogReading
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
from lightsim.store.staleness import explain_staleness

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class StageStatus:
    """One line of `lightsim status`.

    Args:
        name: name of the stage.
        state: state of its artefact.
        seconds: wall time of the stage; None if not recorded.
        peak_memory_mb: largest memory of the process until its end; None if not recorded.
        reasons: reasons why the artefact is stale, or its damaged files.
    """

    name: str
    state: State
    seconds: float | None
    peak_memory_mb: int | None
    reasons: tuple[str, ...]


def status(work: Path, *, is_hashed: bool = False) -> list[StageStatus]:
    """Compare every artefact with the options of the last build, and with the recording if it still
    exists.

    Args:
        is_hashed: read every file and compare its bytes, not only its size.

    Raises:
        ArtefactError: `work` contains no build.
    """
    options = read_options(work)
    by_stage = artefact_keys(options, _source_key(work, options.reading))
    return [
        _status_of(work / name, artefact_key, is_hashed) for name, artefact_key in by_stage.items()
    ]


def _source_key(work: Path, reading: LogReading) -> str:
    """Return the hash of the recording; if it is gone, the hash that the build stored."""
    if Path(reading.source).exists():
        return hash_names(hash_recording(reading))
    logger.warning(
        "%s: the recording no longer exists, so changes in it are unknown", reading.source
    )
    record = read_record(work / "log")
    return "" if record is None else record["inputs"].get("source", "")


def _status_of(folder: Path, artefact_key: ArtefactKey, is_hashed: bool) -> StageStatus:
    # The state compares sizes only; contents are hashed below on request, as that reads all files.
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
    # A stale artefact stays stale if it is damaged, too: either way it is made again.
    if state == "stale":
        reasons = (*explain_staleness(record, artefact_key), *reasons)
    return StageStatus(folder.name, state, record["seconds"], record["peak_memory_mb"], reasons)
