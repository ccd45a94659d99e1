"""Twin stage: base colours, the observed radiance without the light of the recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lightsim.appearance.colour import colour_of_nearest
from lightsim.appearance.intrinsic.decompose import IntrinsicConfig, Road, decompose
from lightsim.build.assemble import build_twin, roofs_over
from lightsim.build.road_roughness import with_measured_road
from lightsim.build.source_light import IRRADIANCE, SourceLight
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.frames import RigidTransform
from lightsim.render.transport.irradiance import IrradianceConfig
from lightsim.store.twin import write_twin


@dataclass(frozen=True)
class TwinConfig:
    """Settings of the decomposition into base colour and light."""

    irradiance: IrradianceConfig = field(default_factory=lambda: IRRADIANCE)
    """Settings of the light at vertices."""
    intrinsic: IntrinsicConfig = field(default_factory=IntrinsicConfig)
    """Settings of the decomposition."""


def make_twin(work: Workspace, config: TwinConfig, folder: Path, context: Context) -> Iterable[str]:
    """Find and remove the source light, mesh by mesh, and write the twin."""
    assets, log = work.assets, work.training_log
    # Roofs anew: the sky stage may have moved roof edges since the assets stage.
    inferred = roofs_over(assets.background, work.rooflines)
    source = SourceLight(log, assets, inferred, work.sky.dome, config.irradiance, context.seed)
    rng = np.random.default_rng(context.seed)
    light_at = source.on(RigidTransform.identity("world", "world"))
    # Before the decomposition, which subtracts reflections by the roughness of the materials.
    background, road_notes = with_measured_road(
        log, assets, work.sky.dome.sun, light_at, context.seed
    )
    street = decompose(
        background,
        light_at,
        config.intrinsic,
        rng,
        path_world=log.camera_positions_m,
        road=Road(work.fields.path_m, work.fields.ground),
    )
    tracks = {track.actor_id: track for track in log.actors}
    actors = {}
    for actor in context.progress.track(assets.actors.values(), "base colour", len(assets.actors)):
        # Colours of moving actors are means over many poses; their light is that of the middle
        # pose, an approximation.
        trajectory = tracks[actor.actor_id].trajectory
        pose = trajectory.at(int(trajectory.times_ns[len(trajectory) // 2]))
        mesh = decompose(
            actor.mesh,
            source.on(pose),
            config.intrinsic,
            rng,
            is_symmetric=actor.kind.is_vehicle,
        ).mesh
        # An estimate of one pose is wrong at all others.
        if tracks[actor.actor_id].is_moving:
            mesh = replace(mesh, sun_visibility=None)
        actors[actor.actor_id] = replace(actor, mesh=mesh)
    # Pictures contain no evidence of shadows on unobserved surfaces.
    inferred = colour_of_nearest(inferred, street.mesh)
    assets = replace(assets, background=street.mesh, actors=actors)
    write_twin(folder, build_twin(work.log, assets, work.sky), inferred)
    return road_notes
