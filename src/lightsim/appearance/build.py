"""Colour for meshes (paper Sec. 3.1: "simplified textured meshes")."""

from __future__ import annotations

from dataclasses import replace

from lightsim.appearance.bake import bake
from lightsim.appearance.config import AssetConfig
from lightsim.appearance.observe import SkyMatte
from lightsim.core.casting import MakeCaster
from lightsim.core.log import DrivingLog
from lightsim.core.twin import SceneAssets
from lightsim.progress import Progress

__all__ = ["AssetConfig", "build_assets"]


def build_assets(
    log: DrivingLog,
    meshes: SceneAssets,
    config: AssetConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
    sky_matte: SkyMatte | None = None,
) -> SceneAssets:
    """Return the meshes with colour at image resolution, and the RGB gain of each camera.

    Textures and `base_colour` hold the mean observed RADIANCE at this stage (linear, gains
    divided out); `decompose` converts it to base colour once the source light is estimated.
    Held-out frames must be absent from `log`. Pixels that `sky_matte` classifies as sky are not
    sampled.
    """
    actors = {track.actor_id: meshes.actors[track.actor_id].mesh for track in log.actors}
    painted, gains = bake(
        log,
        meshes.background,
        actors,
        config,
        make_caster=make_caster,
        progress=progress,
        sky_matte=sky_matte,
    )
    assets = {
        track.actor_id: replace(meshes.actors[track.actor_id], mesh=mesh)
        for track, mesh in zip(log.actors, painted[1:], strict=True)
    }
    gain_by_name = {name: gains[i] for i, name in enumerate(log.cameras)}
    return SceneAssets(painted[0], assets, gain_by_name, meshes.notes)
