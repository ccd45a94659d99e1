"""Colour for meshes (paper Sec. 3.1: "simplified textured meshes")."""

from __future__ import annotations

from lightsim.assets.colour import mean_radiance, paint
from lightsim.assets.config import AssetConfig, draft, paper, standard
from lightsim.assets.gains import solve_gains
from lightsim.assets.observe import collect_samples
from lightsim.core.casting import MakeCaster
from lightsim.core.log import DrivingLog
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.progress import Progress

__all__ = ["AssetConfig", "build_assets", "draft", "paper", "standard"]


def build_assets(
    log: DrivingLog,
    meshes: SceneAssets,
    config: AssetConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
) -> SceneAssets:
    """The same meshes with colour, and the gain of each camera.

    `base_colour` holds the mean observed RADIANCE at this stage (linear, gains divided out);
    `delight.base_colour_from_radiance` turns it into albedo once the source light is known.
    Frames that must not influence colours are simply left out of `log`.
    """
    background = meshes.background
    actors = {track.actor_id: meshes.actors[track.actor_id].mesh for track in log.actors}
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
    return SceneAssets(painted[0], assets, gain_by_name, meshes.notes)
