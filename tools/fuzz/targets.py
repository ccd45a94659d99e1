"""What reads a case, as the commands do; every value that is accepted is checked to be usable."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

from lightsim.api import load_log
from lightsim.build.status import status
from lightsim.build.workspace import FIELD_CONFIG_NAME, FIELD_NAME, Workspace
from lightsim.cli.sky import sun_of_command
from lightsim.core.actors import ActorKind
from lightsim.core.dome import SkyDome
from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.twin import ActorAsset, SceneAssets, SkyEstimate
from lightsim.datasets.fingerprint import hash_recording
from lightsim.errors import LightSimError
from lightsim.geometry.completion.prisms import unobserved_building_parts
from lightsim.lighting.sky.image_sky import panorama_from_image
from lightsim.lighting.target_sky import scale_to_source
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field.config import config_from_json
from lightsim.render.casters.embree import make_embree_caster
from lightsim.simulation import relight as scenarios
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.skies import resolve_sky, sky_without_log
from lightsim.store.alignment import read_alignment
from lightsim.store.artefact import read_json
from lightsim.store.assets import read_assets, read_mesh, write_assets
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.fields import read_fields
from lightsim.store.images import read_grey8_alpha, read_srgb8_alpha
from lightsim.store.log import read_reading, write_log
from lightsim.store.rooflines import read_rooflines
from lightsim.store.sky import read_estimate, read_panorama
from lightsim.store.twin import read_twin_assets
from lightsim.store.weights import read_record, read_weights

_MAX_PICTURES, _MAX_SWEEPS = 6, 3


def read_whole_log(folder: Path) -> None:
    """A log with its first pictures and sweeps, and what a build writes of it first."""
    log = load_log(LogReading(source=str(folder / "log"), image_scale=1.0))
    use_log(log)
    out = folder / "out"
    out.mkdir()
    write_log(out, log, LogReading(source=str(folder / "log"), image_scale=1.0, hold_out=4), {})
    cube = TriMesh(
        "actor", np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
    )  # fmt: skip
    actors = {a.actor_id: ActorAsset(a.actor_id, a.kind, cube) for a in log.actors}
    write_assets(out, SceneAssets(cube, actors, {}))


def read_nuscenes_log(folder: Path) -> None:
    """A data set with nuScenes tables; the cache stays in the case's folder."""
    with mock.patch.dict(os.environ, {"LIGHTSIM_CACHE": str(folder / "cache")}):
        reading = LogReading(source=str(folder / "log"), image_scale=1.0)
        use_log(load_log(reading))
        hash_recording(reading)


def use_log(log: DrivingLog) -> None:
    """Load the first pictures and sweeps, and ask where things are."""
    for camera in log.cameras.values():
        _require_finite(camera.fx, camera.fy, camera.cx, camera.cy)
    for frame in log.frames[:_MAX_PICTURES]:
        camera = log.cameras[frame.camera_name]
        picture = frame.load_srgb8()
        _require(picture.shape == (camera.height_px, camera.width_px, 3), "a picture's size")
        _require_finite(frame.world_from_camera.matrix)
        corner = np.array([[0.5, 0.5]])
        _require_finite(*frame.pixel_rays(camera, corner))
        log.actors_at(frame.time_ns)
    for sweep in log.sweeps[:_MAX_SWEEPS]:
        points = sweep.load()
        _require(len(points.points_world) > 0, "a sweep without points")
        _require_finite(points.points_world, points.origins_world, points.intensity)
        _require_finite(points.time_offset_s)
    for actor in log.actors:
        _require_finite(actor.size_lwh_m, actor.trajectory.matrices)


def read_sky_file(folder: Path) -> None:
    """`--sky FILE`: read, found usable, turned and scaled to another sky."""
    path = next(folder.glob("sky.*"))
    dome = sky_without_log(SkyChoice(str(path), 0.0)).dome
    use_dome(dome)
    source = SkyDome(np.full((16, 32, 3), 0.3, np.float32), None)
    scaled, factor = scale_to_source(dome.rotated(33.0), source, "auto")
    _require_finite(factor)
    use_dome(scaled)


def use_dome(dome: SkyDome) -> None:
    """Light of a dome, in numbers."""
    level = dome.horizontal_irradiance()
    _require_finite(level)
    _require(bool((level >= 0).all()), "negative light")
    if dome.sun is not None:
        _require_finite(dome.sun.direction_world, dome.sun.irradiance)


def read_panorama_picture(folder: Path) -> None:
    """The reading part of `lightsim sky estimate`."""
    picture, alpha = read_srgb8_alpha(folder / "panorama.png")
    panorama = panorama_from_image(picture, alpha > 127)
    _require_finite(panorama.radiance)


def read_artefacts(folder: Path) -> None:
    """Every artefact through its reader, through the workspace, and `lightsim status`.

    One broken artefact must not hide the others, so each is read in its own right; the first of
    our errors is raised at the end.
    """
    work = folder / "work"
    refused: list[LightSimError] = []
    for read in (*_readers(work), lambda: _use_workspace(work), lambda: status(work)):
        try:
            read()
        except LightSimError as error:
            refused.append(error)
    if refused:
        raise refused[0]


def _readers(work: Path) -> tuple[Callable[[], object], ...]:
    return (
        lambda: read_reading(work / "log"),
        lambda: read_alignment(work / "alignment"),
        lambda: _use_fields(read_fields(work / "fields")),
        lambda: _use_fields(read_fields(work / "neural")),
        lambda: config_from_json(read_json(work / "neural" / FIELD_CONFIG_NAME)),
        lambda: read_weights(work / "neural" / FIELD_NAME),
        lambda: read_record(work / "neural" / FIELD_NAME),
        lambda: FolderCheckpointer(work / "neural").load(),
        lambda: _use_assets(read_assets(work / "geometry")),
        lambda: _use_assets(read_assets(work / "assets")),
        lambda: _use_mesh(read_mesh(work / "assets" / "inferred.npz", "world")),
        lambda: _use_roofs(work / "geometry" / "rooflines.npz"),
        lambda: _use_roofs(work / "sky" / "rooflines.npz"),
        lambda: _require_finite(read_panorama(work / "panorama").radiance),
        lambda: _use_estimate(read_estimate(work / "sky")),
        lambda: _use_twin(work / "twin"),
        lambda: [read_grey8_alpha(p) for p in sorted((work / "masks").glob("*/*.png"))],
    )


def _use_workspace(work: Path) -> None:
    workspace = Workspace(work)
    twin = workspace.twin
    use_log(twin.log)
    _use_estimate(twin.sky)
    _use_assets(twin.assets)
    workspace.sky_matte(twin.log.frames[0])
    resolve_sky(SkyChoice("source"), workspace)


def _use_twin(folder: Path) -> None:
    assets, inferred = read_twin_assets(folder)
    _use_assets(assets)
    _use_mesh(inferred)


def _use_assets(assets: SceneAssets) -> None:
    _use_mesh(assets.background)
    for actor in assets.actors.values():
        _use_mesh(actor.mesh)
        _require(
            isinstance(actor.actor_id, str) and isinstance(actor.label, str), "an actor's name"
        )
        _require(isinstance(actor.kind, ActorKind), "an actor's kind")
    for gain in assets.camera_gains.values():
        _require(gain.shape == (3,) and bool((gain > 0).all()), "a camera's gain")
        _require_finite(gain)


def _use_roofs(path: Path) -> None:
    rooflines = read_rooflines(path)
    empty = np.zeros((0, 3), np.float32)
    background = TriMesh("world", empty, np.zeros((0, 3), np.int32), empty)
    _use_mesh(unobserved_building_parts(rooflines, background, make_caster=make_embree_caster))


def _use_mesh(mesh: TriMesh) -> None:
    """Shapes, and the look-ups that rendering makes."""
    n, m = len(mesh.vertices), len(mesh.faces)
    _require(mesh.vertices.shape == (n, 3) and mesh.faces.shape == (m, 3), "a mesh's shape")
    _require(mesh.base_colour.shape == (n, 3), "a colour for each vertex")
    _require_finite(mesh.vertices, mesh.base_colour)
    if mesh.face_material is not None:
        _require(mesh.face_material.shape == (m,), "a material for each face")
        _require(not m or int(mesh.face_material.max()) < len(mesh.materials), "a material")
    if mesh.face_provenance is not None:
        _require(mesh.face_provenance.shape == (m,), "a provenance for each face")
        _require(not m or int(mesh.face_provenance.max()) < len(Provenance), "a provenance")
    for material in mesh.materials:
        _require_finite(material.roughness, material.metallic)
    if mesh.confidence is not None:
        _require(mesh.confidence.shape == (n,), "a confidence for each vertex")
    if m:
        centre = np.full((m, 3), 1 / 3)
        _require_finite(mesh.colour_at(np.arange(m), centre))
    mesh.vertex_normals()


def _use_fields(fields: SceneFields) -> None:
    for grid in (*fields.background, *fields.actors.values()):
        n = len(grid.block_coords)
        _require(grid.block_coords.shape == (n, 3), "block coordinates")
        _require(grid.sdf_m.shape == grid.weight.shape == (n, 8, 8, 8), "blocks")
        _require_finite(grid.origin_m, grid.voxel_m, grid.truncation_m, grid.sdf_m)
    fields.ground.look_up(np.zeros((2, 2)))
    _require(fields.path_m.ndim == 2 and fields.path_m.shape[1] == 3, "a path")


def _use_estimate(sky: SkyEstimate) -> None:
    use_dome(sky.dome)
    _require_finite(sky.sun_elevation_deg, sky.uncertainty_deg, sky.sky_irradiance)
    if sky.sun_azimuth_deg is not None:
        _require_finite(sky.sun_azimuth_deg)


def relight_with_options(
    work: Path,
    name: str,
    sky: str,
    scale: str,
    numbers: tuple[float, float],
    words: tuple[str, str],
) -> None:
    """`lightsim relight` up to the first frame: every option read, the folder made."""
    yaw_deg, image_scale = numbers
    frames, cameras = words
    options = RelightOptions(
        name=name,
        sky=(sky,),
        sky_yaw_deg=yaw_deg,
        sky_scale=scale,
        cameras=tuple(cameras.split(",")) if cameras else (),
        frames=frames,
        image_scale=image_scale,
    )
    with mock.patch.object(scenarios, "make_artefact", _make_folder_only):
        scenarios.relight(work, options, SilentProgress())


def _make_folder_only(folder: Path, artefact_key: object, build: object) -> None:
    del build
    _ = artefact_key.key  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)


def read_with_options(
    log: Path, dataset: str, words: tuple[str, str], heading_deg: float | None, scale: float
) -> None:
    """`lightsim build` up to the log, with any options."""
    frames, cameras = words
    chosen = tuple(cameras.split(",")) if cameras else ()
    use_log(
        load_log(
            LogReading(
                source=str(log),
                dataset=dataset,  # type: ignore[arg-type]
                cameras=chosen,
                frames=frames,
                heading_deg=heading_deg,
                image_scale=scale,
            )
        )
    )


def sky_words(sky: str, numbers: tuple[float, float, float], time: str) -> None:
    """`lightsim sky show WORDS` and the sun options of `sky estimate`."""
    sun_of_command(time, *numbers)
    use_dome(sky_without_log(SkyChoice(sky)).dome)


def _require(is_right: bool, what: str) -> None:
    """Accepted though it is not usable: as bad as a foreign exception."""
    if not is_right:
        raise AssertionError(f"accepted, but wrong: {what}")


def _require_finite(*values: object) -> None:
    for value in values:
        if not np.isfinite(np.asarray(value, dtype=np.float64)).all():
            raise AssertionError("accepted, but not finite")
