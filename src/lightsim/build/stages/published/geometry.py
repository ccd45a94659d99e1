"""Meshes of the neural field alone: marching cubes and decimation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.geometry.paper_meshes import BaseMaterials, mesh_as_in_paper
from lightsim.store.assets import write_assets
from lightsim.store.rooflines import write_rooflines


def make_geometry(
    work: Workspace, config: BaseMaterials, folder: Path, context: Context
) -> Iterable[str]:
    """Mesh the field by marching cubes and decimation; nothing is inferred beyond it."""
    meshes = mesh_as_in_paper(work.training_log, work.fields, config, progress=context.progress)
    write_assets(folder, meshes)
    write_rooflines(folder / "rooflines.npz", [])
    return meshes.notes
