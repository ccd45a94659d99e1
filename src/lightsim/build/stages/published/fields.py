"""Cells in which the field of the paper is evaluated."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.reconstruct.field.occupied_fields import occupied_fields
from lightsim.reconstruct.fusion.config import OccupiedConfig
from lightsim.store.fields import write_fields


def make_fields(
    work: Workspace, config: OccupiedConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Write the occupied cells, in which the field will be evaluated; nothing is fused."""
    fields = occupied_fields(work.training_log, config, progress=context.progress)
    write_fields(folder, fields)
    return fields.notes
