"""Signed-distance grids, fused from LiDAR."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.tsdf import fuse_log
from lightsim.store.fields import write_fields


def make_fields(
    work: Workspace, config: FuseConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Fuse the aligned sweeps into signed-distance grids of background and actors."""
    fields = fuse_log(work.training_log, config, progress=context.progress)
    write_fields(folder, fields)
    return fields.notes
