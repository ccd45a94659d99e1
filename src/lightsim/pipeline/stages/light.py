"""The source sky, and the base colour that it leaves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.appearance.intrinsic.decompose import IntrinsicConfig, decompose, find_balance
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SkyEstimate
from lightsim.lighting.panorama.stitch import StitchConfig, stitch_panorama
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.balance import rebalanced, unseen_part
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sky.shipped import completed_panorama, decoded_sky, predict_sky
from lightsim.lighting.sun.direction import SunDirection
from lightsim.pipeline.assemble import build_twin
from lightsim.pipeline.options import SkyModel
from lightsim.pipeline.source_light import SourceLight, static_returns
from lightsim.pipeline.source_sun import SourceSunConfig, find_source_sun
from lightsim.pipeline.stages.context import Context
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.render.frame_renderer import parked_actor_meshes
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.irradiance import IrradianceConfig
from lightsim.render.transport.matrix import TransportConfig
from lightsim.store.sky import (
    write_completed,
    write_panorama,
    write_panorama_pictures,
    write_sky,
)
from lightsim.store.twin import write_twin

IRRADIANCE = IrradianceConfig(TransportConfig(sky_rays=32, face_rays=8), 0.25)
"""Sun, sky and the light of other surfaces as it was seen; what was not seen is grey."""
LIDAR_RETURNS = 1_500_000
"""LiDAR returns whose intensity is asked."""


@dataclass(frozen=True)
class SkyStageConfig:
    """Direction of the sun, the sky that was seen, and what surfaces say of the light."""

    sun: SourceSunConfig = field(default_factory=SourceSunConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)
    irradiance: IrradianceConfig = field(default_factory=lambda: IRRADIANCE)
    """Light on the patches that say how sun and unseen sky compare."""
    labels: IntrinsicConfig = field(default_factory=IntrinsicConfig)
    """How their shadows are found."""
    model: SkyModel = "analytic"
    """Who makes the dome."""


@dataclass(frozen=True)
class TwinConfig:
    """From observed radiance to base colour."""

    irradiance: IrradianceConfig = field(default_factory=lambda: IRRADIANCE)
    """Light at the vertices."""
    intrinsic: IntrinsicConfig = field(default_factory=IntrinsicConfig)
    """How shadows are found."""


def make_panorama(
    work: Workspace, config: StitchConfig, folder: Path, context: Context
) -> Iterable[str]:
    """What the cameras saw around the ego's place in the middle of the log.

    Depth comes from the static and parked surfaces: moving actors are not in it.
    """
    log, assets = work.training_log, work.assets
    scene = without_actors(
        make_static_scene([assets.background, *parked_actor_meshes(log, assets)])
    )

    def cast_depth(frame: CameraFrame, camera: PinholeCamera) -> Float32[np.ndarray, "h w"]:
        return render_gbuffers(scene, camera, frame).depth_z_m

    def sky_matte(frame: CameraFrame, camera: PinholeCamera) -> Float32[np.ndarray, "h w"]:
        return work.sky_matte(frame)

    panorama = stitch_panorama(
        log, assets.camera_gains, cast_depth, sky_matte, config, progress=context.progress
    )
    write_panorama(folder, panorama)
    return ()


def make_sky(
    work: Workspace, config: SkyStageConfig, folder: Path, context: Context
) -> Iterable[str]:
    """The source sky: the sun is found first, then strengths and dome; notes say from what."""
    predicted = predict_sky(work.panorama)
    sun, _ = find_source_sun(
        work, config.sun, seed=context.seed, progress=context.progress, prediction=predicted
    )
    if config.model == "paper":
        sky = decoded_sky(work.panorama, sun, predicted, config.sky.height_px)
    else:
        sky = source_sky(work, sun, config, predicted, seed=context.seed, progress=context.progress)
    geo = work.training_log.geo
    write_sky(folder, sky, None if geo is None else geo.heading_deg)
    write_panorama_pictures(folder, work.panorama)
    write_completed(folder, completed_panorama(work.panorama)[0])
    return sky.notes


def source_sky(
    work: Workspace,
    sun: SunDirection,
    config: SkyStageConfig,
    prediction: SkyPrediction | None,
    *,
    seed: int,
    progress: Progress,
) -> SkyEstimate:
    """The dome of a log whose sun was found: first what the sky tells, then with what shadows and
    materials on its surfaces say of the sun and of the sky that no camera saw."""
    log = work.training_log
    estimate, freedom = estimate_sky(
        work.panorama, sun, config.sky, progress=progress, prediction=prediction
    )
    source = SourceLight(
        log,
        work.assets,
        work.inferred,
        estimate.dome,
        config.irradiance,
        seed,
        unseen_part(estimate.dome, freedom),
    )
    rng = np.random.default_rng(seed)
    balance = find_balance(
        work.assets.background,
        source.on(RigidTransform.identity("world", "world")),
        freedom,
        np.array([frame.world_from_camera.translation_m for frame in log.frames]),
        config.labels,
        rng,
        returns=static_returns(log, LIDAR_RETURNS, rng),
    )
    if np.isinf(balance.sun_log_std):
        return estimate
    on_sun, on_unseen_sky = (
        f"({', '.join(f'{value:.2f}' for value in factor)}), log std {log_std:.2f}"
        for factor, log_std in (
            (balance.sun, balance.sun_log_std),
            (balance.unseen_sky, balance.unseen_sky_log_std),
        )
    )
    note = (
        f"{balance.pair_count} lit/shadowed pairs of patches and known materials: sun times"
        f" {on_sun}; unseen sky times {on_unseen_sky}"
    )
    return rebalanced(
        estimate,
        freedom,
        balance.sun,
        balance.unseen_sky,
        sun_log_std=balance.sun_log_std,
        unseen_log_std=balance.unseen_sky_log_std,
        note=note,
    )


def make_twin(work: Workspace, config: TwinConfig, folder: Path, context: Context) -> Iterable[str]:
    """Find and remove the source light, mesh by mesh, and write the twin."""
    assets, inferred, log = work.assets, work.inferred, work.training_log
    source = SourceLight(log, assets, inferred, work.sky.dome, config.irradiance, context.seed)
    rng = np.random.default_rng(context.seed)
    identity = RigidTransform.identity("world", "world")
    street = decompose(
        assets.background,
        source.on(identity),
        config.intrinsic,
        rng,
        returns=static_returns(log, LIDAR_RETURNS, rng),
    )
    tracks = {track.actor_id: track for track in log.actors}
    actors = {}
    for actor in context.progress.track(assets.actors.values(), "base colour", len(assets.actors)):
        trajectory = tracks[actor.actor_id].trajectory
        pose = trajectory.at(int(trajectory.times_ns[len(trajectory) // 2]))
        done = decompose(actor.mesh, source.on(pose), config.intrinsic, rng)
        actors[actor.actor_id] = replace(actor, mesh=done.mesh)
    if len(inferred.faces):
        found = decompose(inferred, source.on(identity), config.intrinsic, rng)
        inferred = found.mesh
    assets = replace(assets, background=street.mesh, actors=actors)
    write_twin(folder, build_twin(work.log, assets, work.sky), inferred)
    return street.notes
