"""What each stage of the build does: load, call one function, save. Order: pipeline.py."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.align.build import align_log
from lightsim.align.config import AlignConfig
from lightsim.assemble.build import build_twin
from lightsim.assets.build import AssetConfig, build_assets
from lightsim.assets.colour import colour_of_nearest
from lightsim.assets.delight import DelightConfig, delight
from lightsim.assets.mesh_config import MeshConfig
from lightsim.assets.mesh_scene import mesh_scene
from lightsim.assets.simplify import simplify_planar
from lightsim.assets.surface import background_levels, extract_surface
from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import SceneFields
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SceneAssets, SkyEstimate
from lightsim.ingest.sky_mask import SkyMaskConfig, sky_mattes
from lightsim.lighting.estimate import SkyConfig, estimate_sky
from lightsim.lighting.evidence import EvidenceConfig, Surroundings, collect_evidence
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.stitch import StitchConfig, stitch_panorama
from lightsim.lighting.sun import SunDirection
from lightsim.progress import Progress
from lightsim.reconstruct.extrude import ExtrudeConfig, infer_tall_structures
from lightsim.reconstruct.facades import FacadeConfig, complete_facades
from lightsim.reconstruct.far_field import FarFieldConfig, build_far_field
from lightsim.reconstruct.flatten import FlattenConfig, flatten_walls
from lightsim.reconstruct.fuse_config import FuseConfig
from lightsim.reconstruct.neural_config import NeuralConfig
from lightsim.reconstruct.ray_pool import PriorSurfaces
from lightsim.reconstruct.tsdf import fuse_log
from lightsim.render.embree import make_embree_caster
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.irradiance import IrradianceConfig
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport import TransportConfig
from lightsim.scene_setup import parked_actor_meshes
from lightsim.sky_networks import predict_sky
from lightsim.source_light import SourceLight, static_returns
from lightsim.source_sun import SourceSunConfig, find_source_sun
from lightsim.store.alignment import write_alignment
from lightsim.store.artefact import write_json
from lightsim.store.assets import read_mesh, write_assets, write_mesh
from lightsim.store.checkpoint import FolderJournal, write_weights
from lightsim.store.fields import write_fields
from lightsim.store.images import write_grey8
from lightsim.store.log import LogReading, write_log
from lightsim.store.sky import write_panorama, write_panorama_pictures, write_sky
from lightsim.store.twin import write_twin
from lightsim.workspace import FIELD_CONFIG_NAME, FIELD_NAME, Workspace


@dataclass(frozen=True)
class Context:
    """What every stage gets besides its inputs."""

    progress: Progress
    seed: int
    preset: str
    device: str = "auto"


@dataclass(frozen=True)
class GeometryConfig:
    """From fields to meshes, measured and inferred."""

    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Measured surfaces."""
    walls: FlattenConfig = field(default_factory=FlattenConfig)
    """Their bumps on walls."""
    facades: FacadeConfig = field(default_factory=FacadeConfig)
    """Windows and upper facades: visible."""
    far: FarFieldConfig = field(default_factory=FarFieldConfig)
    """What stands beyond the LiDAR's reach: visible."""
    tall: ExtrudeConfig = field(default_factory=ExtrudeConfig)
    """Roofs and rear walls: they only cast shadows."""


@dataclass(frozen=True)
class SkyStageConfig:
    """Direction of the sun, evidence and fit of the source sky."""

    sun: SourceSunConfig = field(default_factory=SourceSunConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)


@dataclass(frozen=True)
class TwinConfig:
    """From observed radiance to base colour."""

    irradiance: IrradianceConfig = field(
        default_factory=lambda: IrradianceConfig(TransportConfig(sky_rays=32, face_rays=8), 0.25)
    )
    """Light at the vertices; one bounce off grey surfaces."""
    delight: DelightConfig = field(default_factory=DelightConfig)
    """How shadows are found."""
    lidar_returns: int = 1_500_000
    """LiDAR returns whose intensity is asked."""


def make_log(work: Workspace, config: LogReading, folder: Path, context: Context) -> Iterable[str]:
    write_log(folder, work.recorded_log, config, work.source_hashes)
    return work.recorded_log.notes


def make_alignment(
    work: Workspace, config: AlignConfig, folder: Path, context: Context
) -> Iterable[str]:
    alignment = align_log(
        work.recorded_training_log,
        config,
        rng=np.random.default_rng(context.seed),
        progress=context.progress,
    )
    write_alignment(folder, alignment)
    return alignment.notes


def make_masks(
    work: Workspace, config: SkyMaskConfig, folder: Path, context: Context
) -> Iterable[str]:
    """One matte a frame; those that an interrupted run left are kept."""

    def path_of(frame: CameraFrame) -> Path:
        return folder / frame.camera_name / f"{frame.stem}.png"

    missing = tuple(f for f in work.recorded_log.frames if not path_of(f).exists())
    for camera in work.recorded_log.cameras:
        (folder / camera).mkdir(exist_ok=True)
    wanted = work.recorded_log.with_frames(missing)
    for frame, matte in sky_mattes(wanted, config, context.progress):
        write_grey8(path_of(frame), np.round(matte * 255).astype(np.uint8))
    return ()


def make_fields(
    work: Workspace, config: FuseConfig, folder: Path, context: Context
) -> Iterable[str]:
    fields = fuse_log(work.training_log, config, progress=context.progress)
    write_fields(folder, fields)
    return fields.notes


def make_neural(
    work: Workspace, config: NeuralConfig, folder: Path, context: Context
) -> Iterable[str]:
    """The neural field, trained on images and LiDAR from where the fused LiDAR stands."""
    fused, journal = work.fused, FolderJournal(folder)
    if config.steps == 0:
        write_fields(folder, fused)
        return (*fused.notes, "no neural field was trained; geometry is fused LiDAR alone")
    from lightsim.reconstruct.neural import Training, refine_by_field

    training = Training(
        prior_surfaces(fused),
        work.sky_matte,
        journal,
        context.seed,
        context.device,
    )
    fields, field = refine_by_field(
        work.training_log, fused, config, training, progress=context.progress
    )
    write_fields(folder, fields)
    write_weights(folder / FIELD_NAME, field.state_dict())
    write_json(folder / FIELD_CONFIG_NAME, asdict(config))
    journal.finish()
    return fields.notes


def prior_surfaces(fused: SceneFields) -> PriorSurfaces:
    """Where rays of the neural field are sampled: the meshes of the fused LiDAR."""
    at_origin = RigidTransform.identity("world", "actor")
    return PriorSurfaces(
        make_embree_caster(background_levels(fused, 0.03)),
        {
            actor_id: make_embree_caster([extract_surface(grid, 0.03).moved(at_origin)])
            for actor_id, grid in fused.actors.items()
        },
    )


def make_geometry(
    work: Workspace, config: GeometryConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Everything that has a shape, before it has a colour; casters of shadows apart."""
    log, fields = work.training_log, work.fields
    meshes = mesh_scene(
        log,
        fields,
        config.mesh,
        make_caster=make_embree_caster,
        progress=context.progress,
        calm=partial(flatten_walls, config=config.walls),
    )

    def views() -> Iterable[tuple[CameraFrame, PinholeCamera, Float32[np.ndarray, "h w"]]]:
        return ((f, log.cameras[f.camera_name], work.sky_matte(f)) for f in log.frames)

    background = meshes.background
    facades = complete_facades(
        background,
        views(),
        (sweep.load() for sweep in log.sweeps),
        config.facades,
        make_caster=make_embree_caster,
    )
    background = concatenate_meshes([background, simplify_planar(facades)])
    far = build_far_field(
        background,
        views(),
        fields.ground,
        fields.path_m,
        config.far,
        make_caster=make_embree_caster,
    )
    casters = infer_tall_structures(
        background,
        views(),
        config.tall,
        make_caster=make_embree_caster,
        progress=context.progress,
    )
    background = concatenate_meshes([background, far])
    write_assets(folder, replace(meshes, background=background))
    write_mesh(folder / "inferred.npz", casters)
    return (
        *meshes.notes,
        f"{len(facades.faces)} faces close windows and raise facades, {len(far.faces)} stand "
        f"beyond the LiDAR's reach, {len(casters.faces)} only cast shadows: inferred, not measured",
    )


def make_assets(
    work: Workspace, config: AssetConfig, folder: Path, context: Context
) -> Iterable[str]:
    assets = build_assets(
        work.training_log,
        work.meshes,
        config,
        make_caster=make_embree_caster,
        progress=context.progress,
        sky_matte=work.sky_matte,
    )
    if config.colour != "texture":
        assets = _vertex_coloured(work, assets, config)
    write_assets(folder, assets)
    casters = read_mesh(work.need("geometry") / "inferred.npz", "world")
    write_mesh(folder / "inferred.npz", colour_of_nearest(casters, assets.background))
    return ()


def _vertex_coloured(work: Workspace, assets: SceneAssets, config: AssetConfig) -> SceneAssets:
    """Colours at the vertices alone: means of the texture, or the neural field's k_d."""

    def plain(mesh: TriMesh, actor: int) -> TriMesh:
        mesh = replace(mesh, texture=None)
        if field is None:
            return mesh
        return replace(mesh, base_colour=vertex_radiance(field, mesh, actor))

    gains = assets.camera_gains
    field = None
    if config.colour == "field":
        from lightsim.reconstruct.refine import vertex_radiance

        field = work.scene_field
        gains = field.radiance_gains()
    numbers = {actor.actor_id: number for number, actor in enumerate(work.training_log.actors)}
    actors = {
        actor_id: replace(actor, mesh=plain(actor.mesh, numbers[actor_id]))
        for actor_id, actor in assets.actors.items()
    }
    return replace(
        assets, background=plain(assets.background, -1), actors=actors, camera_gains=gains
    )


def make_panorama(
    work: Workspace, config: StitchConfig, folder: Path, context: Context
) -> Iterable[str]:
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
    said = predict_sky(work.panorama)
    sun, _ = find_source_sun(
        work, config.sun, seed=context.seed, progress=context.progress, prediction=said
    )
    sky = source_sky(work, sun, config, said, seed=context.seed, progress=context.progress)
    write_sky(folder, sky)
    write_panorama_pictures(folder, work.panorama)
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
    """The dome of a log whose sun was found: strengths by lit and shadowed surfaces."""
    log = work.training_log
    evidence = collect_evidence(
        log,
        work.assets,
        make_embree_caster,
        sun.direction_world,
        config.evidence,
        np.random.default_rng(seed),
        around=Surroundings(parked_actor_meshes(log, work.assets), [work.inferred]),
        progress=progress,
    )
    return estimate_sky(
        work.panorama, sun, evidence, config.sky, progress=progress, prediction=prediction
    )


def make_twin(work: Workspace, config: TwinConfig, folder: Path, context: Context) -> Iterable[str]:
    """Find and remove the source light, mesh by mesh, and write the twin."""
    assets, inferred, log = work.assets, work.inferred, work.training_log
    source = SourceLight(log, assets, inferred, work.sky.dome, config.irradiance, context.seed)
    rng = np.random.default_rng(context.seed)
    identity = RigidTransform.identity("world", "world")
    street = delight(
        assets.background,
        source.on(identity),
        config.delight,
        rng,
        returns=static_returns(log, config.lidar_returns, rng),
    )
    tracks = {track.actor_id: track for track in log.actors}
    actors = {}
    for actor in context.progress.track(assets.actors.values(), "base colour", len(assets.actors)):
        trajectory = tracks[actor.actor_id].trajectory
        pose = trajectory.at(int(trajectory.times_ns[len(trajectory) // 2]))
        done = delight(actor.mesh, source.on(pose), config.delight, rng, scales=street.scales)
        actors[actor.actor_id] = replace(actor, mesh=done.mesh)
    if len(inferred.faces):
        found = delight(inferred, source.on(identity), config.delight, rng, scales=street.scales)
        inferred = found.mesh
    assets = replace(assets, background=street.mesh, actors=actors)
    write_twin(folder, build_twin(work.log, assets, work.sky), inferred)
    return street.notes


def make_report(work: Workspace, config: None, folder: Path, context: Context) -> Iterable[str]:
    from lightsim.reports import write_build_report

    write_build_report(folder / "index.html", work)
    return ()
