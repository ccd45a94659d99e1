"""Meshes with the neural field's colour at their vertices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from lightsim.appearance.config import AssetConfig
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.mesh import TriMesh
from lightsim.store.assets import write_assets, write_mesh
from lightsim.store.twin import empty_mesh


def make_assets(
    work: Workspace, config: AssetConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Write the meshes with k_d of the field at their vertices."""
    from lightsim.reconstruct.field.refine import vertex_radiance

    assert config.colour == "field"
    field, meshes = work.scene_field, work.meshes
    numbers = work.training_log.number_by_actor

    def coloured(mesh: TriMesh, actor: int) -> TriMesh:
        return replace(mesh, base_colour=vertex_radiance(field, mesh, actor))

    actors = {
        actor_id: replace(actor, mesh=coloured(actor.mesh, numbers[actor_id]))
        for actor_id, actor in meshes.actors.items()
    }
    assets = replace(
        meshes,
        background=coloured(meshes.background, -1),
        actors=actors,
        camera_gains=field.radiance_gains(),
    )
    write_assets(folder, assets)
    # Empty, because the published system infers no roofs, but later stages read the file.
    write_mesh(folder / "inferred.npz", empty_mesh())
    return ()
