"""Fields to meshes without colour: the static scene and every actor."""

from __future__ import annotations

from lightsim.assets.complete import actor_surface, ground_patches
from lightsim.assets.mesh_config import MeshConfig
from lightsim.assets.surface import background_levels, drop_floaters, smooth
from lightsim.core.casting import MakeCaster
from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.progress import Progress


def mesh_scene(
    log: DrivingLog,
    fields: SceneFields,
    config: MeshConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
) -> SceneAssets:
    """Background and actors as black meshes; no gains yet (assets.build.build_assets)."""
    background = mesh_background(fields, config, make_caster)
    actors, notes = {}, list(fields.notes)
    for track in progress.track(log.actors, "mesh the actors", len(log.actors)):
        grid = fields.actors.get(track.actor_id)
        mesh = actor_surface(track, grid, config)
        actors[track.actor_id] = ActorAsset(track.actor_id, track.kind, mesh)
        if grid is None:
            notes.append(f"actor {track.actor_id} ({track.kind}): default shape, too few returns")
    return SceneAssets(background, actors, {}, tuple(notes))


def mesh_background(fields: SceneFields, config: MeshConfig, make_caster: MakeCaster) -> TriMesh:
    """All levels of the static scene in one mesh, ground closed; black."""
    levels = [
        smooth(drop_floaters(level, config.min_piece_m2), config.smoothing_rounds)
        for level in background_levels(fields, config.min_weight)
    ]
    surface = concatenate_meshes(levels)
    patches = ground_patches(surface, fields.ground, fields.path_m, config, make_caster)
    return concatenate_meshes([surface, patches])
