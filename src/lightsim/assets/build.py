"""Fields to coloured meshes (paper Sec. 3.1: "simplified textured meshes")."""

from __future__ import annotations

from lightsim.assets.colour import mean_radiance, paint
from lightsim.assets.complete import actor_surface, ground_patches
from lightsim.assets.config import AssetConfig, draft, paper, standard
from lightsim.assets.gains import solve_gains
from lightsim.assets.observe import collect_samples
from lightsim.assets.surface import background_levels, drop_floaters, smooth
from lightsim.core.casting import MakeCaster
from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.progress import Progress

__all__ = ["AssetConfig", "build_assets", "draft", "paper", "standard"]


def build_assets(
    log: DrivingLog,
    fields: SceneFields,
    config: AssetConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
) -> SceneAssets:
    """Background and actors as meshes, with the gain of each camera.

    `base_colour` holds the mean observed RADIANCE at this stage (linear, gains divided out);
    `delight.base_colour_from_radiance` turns it into albedo once the source light is known.
    Frames that must not influence colours are simply left out of `log`.
    """
    background = mesh_background(fields, config, make_caster)
    actors, notes = {}, list(fields.notes)
    for track in progress.track(log.actors, "mesh the actors", len(log.actors)):
        grid = fields.actors.get(track.actor_id)
        actors[track.actor_id] = actor_surface(track, grid, config)
        if grid is None:
            notes.append(f"actor {track.actor_id} ({track.kind}): default shape, too few returns")
    samples = collect_samples(
        log, background, actors, config, make_caster=make_caster, progress=progress
    )
    gains = solve_gains(
        samples.colours, samples.weights, samples.cameras, len(log.cameras), config.gain_strength
    )
    radiance, is_seen = mean_radiance(samples, gains, config.outlier_ratio)
    painted = paint([background, *actors.values()], radiance, is_seen)
    assets = {
        track.actor_id: ActorAsset(track.actor_id, track.kind, mesh)
        for track, mesh in zip(log.actors, painted[1:], strict=True)
    }
    gain_by_name = {name: gains[i] for i, name in enumerate(log.cameras)}
    return SceneAssets(painted[0], assets, gain_by_name, tuple(notes))


def mesh_background(fields: SceneFields, config: AssetConfig, make_caster: MakeCaster) -> TriMesh:
    """All levels of the static scene in one mesh, ground closed; black."""
    levels = [
        smooth(drop_floaters(level, config.min_piece_m2), config.smoothing_rounds)
        for level in background_levels(fields, config.min_weight)
    ]
    surface = concatenate_meshes(levels)
    patches = ground_patches(surface, fields.ground, fields.path_m, config, make_caster)
    return concatenate_meshes([surface, patches])
