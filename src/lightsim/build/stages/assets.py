"""Meshes coloured with the observed radiance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from lightsim.appearance.build import AssetConfig, build_assets
from lightsim.build.assemble import roofs_over
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import SceneAssets
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.assets import write_assets, write_mesh


def make_assets(
    work: Workspace, config: AssetConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Colour the meshes with observed radiance, and estimate the camera gains with them.

    Inferred casters, which no image shows, receive the colour of the nearest background.
    """
    assets = build_assets(
        work.training_log,
        work.meshes,
        config,
        make_caster=make_embree_caster,
        progress=context.progress,
        sky_matte=work.sky_matte,
    )
    # The texture is made in any case: colours at vertices are means of it.
    if config.colour != "texture":
        assets = _vertex_coloured(work, assets, config)
    write_assets(folder, assets)
    write_mesh(folder / "inferred.npz", roofs_over(assets.background, work.initial_rooflines))
    return ()


def _vertex_coloured(work: Workspace, assets: SceneAssets, config: AssetConfig) -> SceneAssets:
    """Return assets with colours at vertices alone: means of the texture, or k_d of the neural
    field."""

    def plain(mesh: TriMesh, actor: int) -> TriMesh:
        mesh = replace(mesh, texture=None)
        if field is None:
            return mesh
        return replace(mesh, base_colour=vertex_radiance(field, mesh, actor))

    # The field was trained with camera gains of its own; its colours are valid with these only.
    gains = assets.camera_gains
    field = None
    if config.colour == "field":
        from lightsim.reconstruct.field.refine import vertex_radiance

        field = work.scene_field
        gains = field.radiance_gains()
    number_by_actor = work.training_log.number_by_actor
    actors = {
        actor_id: replace(actor, mesh=plain(actor.mesh, number_by_actor[actor_id]))
        for actor_id, actor in assets.actors.items()
    }
    return replace(
        assets, background=plain(assets.background, -1), actors=actors, camera_gains=gains
    )
