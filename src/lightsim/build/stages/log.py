"""The recording as a log: its reading, a summary and hashes of its files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.store.log import write_log


def make_log(work: Workspace, config: LogReading, folder: Path, context: Context) -> Iterable[str]:
    """The reading, a summary and the hashes of the recording's files; no pixel is copied."""
    write_log(folder, work.recorded_log, config, work.source_hashes)
    return work.recorded_log.notes
