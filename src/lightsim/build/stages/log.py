"""The recording as a log: its reading, a summary and hashes of its files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.stages.context import Context
from lightsim.build.suitability import check_sweeps, light_notes, motion_notes
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.store.log import write_ego_vehicle, write_log


def make_log(work: Workspace, config: LogReading, folder: Path, context: Context) -> Iterable[str]:
    """Write reading options, a summary and the hashes of the recording's files; no pixel is
    copied."""
    write_ego_vehicle(folder, work.read_recording())
    log = work.recorded_log
    # All sweeps are read once here: a damaged one would stop the build in a later, slow stage.
    check_sweeps(log, context.progress)
    write_log(folder, log, config, work.source_hashes)
    return (*log.notes, *motion_notes(log), *light_notes(log))
