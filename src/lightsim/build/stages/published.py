"""Stages that do what the paper describes and nothing else (`lightsim build --preset paper`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightsim.appearance.config import AssetConfig
from lightsim.build.assemble import build_twin
from lightsim.build.options import GpsUse
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, add_sun, split_sun
from lightsim.core.mesh import TriMesh
from lightsim.core.solar import azimuth_elevation
from lightsim.geometry.plain import BaseMaterials, mesh_plainly
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.shipped import completed_panorama, decoded_sky, predict_sky
from lightsim.lighting.sun.direction import SunDirection, sun_from_geo
from lightsim.reconstruct.field.occupied_fields import occupied_fields
from lightsim.reconstruct.fusion.config import OccupiedConfig
from lightsim.store.assets import write_assets, write_mesh
from lightsim.store.fields import write_fields
from lightsim.store.rooflines import write_rooflines
from lightsim.store.sky import (
    write_completed,
    write_panorama_pictures,
    write_sky,
)
from lightsim.store.twin import empty_mesh, write_twin

_WHITE_SUN = "the sun is white: the decoder's weights know how strong it is, not its colour"


@dataclass(frozen=True)
class DecodedSkyConfig:
    """The sky that the decoder draws (paper, Sec. 3.2)."""

    height_px: int = 256
    """Rows of the dome; it is twice as wide."""
    gps: GpsUse = "all"
    """Whether place, time and heading say where the sun is; else the network does."""


def make_fields(
    work: Workspace, config: OccupiedConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Where the field will be read out; nothing is fused."""
    fields = occupied_fields(work.training_log, config, progress=context.progress)
    write_fields(folder, fields)
    return fields.notes


def make_geometry(
    work: Workspace, config: BaseMaterials, folder: Path, context: Context
) -> Iterable[str]:
    """Marching cubes and decimation; no wall, roof, pole, pane or far field is inferred."""
    meshes = mesh_plainly(work.training_log, work.fields, config, progress=context.progress)
    write_assets(folder, meshes)
    write_rooflines(folder / "rooflines.npz", [])
    return meshes.notes


def make_assets(
    work: Workspace, config: AssetConfig, folder: Path, context: Context
) -> Iterable[str]:
    """The same meshes with the field's k_d at their vertices."""
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
    write_mesh(folder / "inferred.npz", empty_mesh())
    return ()


def make_sky(
    work: Workspace, config: DecodedSkyConfig, folder: Path, context: Context
) -> Iterable[str]:
    """The decoder's dome under the sun of GPS and time, else under the encoder's own."""
    log, panorama = work.training_log, work.panorama
    predicted = predict_sky(panorama)
    geo, middle_ns = log.geo, log.frames[len(log.frames) // 2].time_ns
    if geo is None or geo.enu_from_world is None or config.gps != "all":
        sun = _encoded_sun(predicted)
    else:
        sun = sun_from_geo(geo, middle_ns)
    sky = decoded_sky(panorama, sun, predicted, config.height_px)
    sky = replace(sky, dome=_with_white_sun(sky.dome), notes=(*sky.notes, _WHITE_SUN))
    write_rooflines(folder / "rooflines.npz", [])
    write_sky(folder, sky, None if geo is None else geo.heading_deg)
    write_panorama_pictures(folder, panorama)
    write_completed(folder, completed_panorama(panorama)[0])
    return sky.notes


def _with_white_sun(dome: SkyDome) -> SkyDome:
    """f_int is one number, and the shipped decoder never learned the sun's colour: on every log it
    is the same saturated green."""
    rest, sun = split_sun(dome)
    if sun is None:
        return dome
    white = np.full(3, luminance(sun.irradiance), dtype=np.float32)
    return add_sun(rest, replace(sun, irradiance=white))


def _encoded_sun(predicted: SkyPrediction) -> SunDirection:
    """f_dir as the encoder gives it."""
    direction = predicted.sun_direction.astype(np.float64)
    return SunDirection(
        direction,
        None,
        azimuth_elevation(direction).elevation_deg,
        "network",
        float(np.degrees(1 / np.sqrt(predicted.concentration))),
        ("the sun is where the network sees it: GPS and heading were not asked",),
    )


def make_twin(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Base colour is k_d as it was learned, with the light of the recording in it."""
    write_twin(folder, build_twin(work.log, work.assets, work.sky), empty_mesh())
    return ("base colour is the field's k_d: shadows and light of the recording are baked in",)
