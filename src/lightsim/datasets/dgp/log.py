"""Reader of scenes in TRI's DGP format: DDAD (Guizilini et al. 2020, arXiv:1905.02693).

Layout: scene_<hash>.json, calibration/, rgb/<camera>/, point_cloud/<lidar>/, bounding_box_3d/,
ontology/; a data set has one folder for each scene. A datum's pose is `world_from_sensor` at the
datum's own time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.dgp.boxes import box_path, ontology_path, read_actors
from lightsim.datasets.dgp.points import CloudSource, intensity_scale, read_columns
from lightsim.datasets.dgp.rig import Calibration, read_calibration, read_lens, road_height_m
from lightsim.datasets.dgp.scene import (
    Datum,
    Scene,
    chosen_folder,
    is_dgp,
    other_place,
    read_scene,
)
from lightsim.datasets.geo import Located
from lightsim.datasets.pictures import check_size, image_size, load_image
from lightsim.datasets.plausible import check_poses, check_rigid
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import RecordedCamera, RecordedLog, RecordedPicture, RecordedSweep
from lightsim.errors import InputError

_LICENCE = "CC BY-NC-SA 4.0"
# World +x is east in the two scenes that were checked: one against a street map; in DGP's test
# scene the sun of pictures alone is 5 degrees from the ephemeris. DGP does not state it, so the
# standard deviation is wide: shadows outweigh it.
_EAST_DEG = 90.0
# Standard deviation of that azimuth, in degrees. Chosen.
_NORTH_STD_DEG = 15.0
# Clouds from which the road's height and the scale of intensities are measured.
_MEASURED = 3
# LiDARs are on the roof. Lower positions are the origin of the vehicle's frame, in which merged
# clouds are stored.
_LOWEST_LIDAR_M = 0.5
# Largest angle between the vehicle's z axis and world z, as its cosine: 45 degrees.
_UPRIGHT = 0.7


def read_dgp(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a DGP scene; pictures and clouds are loaded on demand.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    scene = read_scene(chosen_folder(reading))
    if not scene.pictures:
        raise InputError(
            "the scene has no pictures", where=scene.path, expected="data of one camera or more"
        )
    calibration = read_calibration(scene.calibration_path)
    reference = _reference(scene)
    road_m, scale, notes = _measured(scene, calibration)
    ego_from_vehicle = _raised(-road_m)
    ego = _ego_path(reference, calibration, ego_from_vehicle, scene.path)
    cameras, camera_notes = _cameras(scene, calibration, ego_from_vehicle, ego)
    sweeps, sweep_notes = _sweeps(scene, calibration, ego_from_vehicle, scale)
    actors, actor_notes = read_actors(scene, _labelled(scene))
    north_note = ("north is assumed: world +x is east in two scenes that were checked; if shadows"
                  " disagree, give its azimuth with --heading-deg")  # fmt: skip
    recorded = RecordedLog(
        scene.folder.resolve().name,
        cameras,
        ego,
        sweeps,
        actors,
        Located(world_x_azimuth_deg=_EAST_DEG, azimuth_std_deg=_NORTH_STD_DEG),
        notes=(*scene.notes, *notes, *camera_notes, *sweep_notes, *actor_notes)
        + (() if reading.heading_deg is not None else (north_note,)),
        licence=_LICENCE,
    )
    return assemble(recorded, reading, find_ego_vehicle)


def _files(reading: LogReading) -> Iterator[Path]:
    """Yield the files of the chosen scene that are read."""
    scene = read_scene(chosen_folder(reading))
    every = [d for part in (scene.clouds, scene.pictures) for data in part.values() for d in data]
    boxes = (box_path(scene, datum) for datum in _labelled(scene))
    paths = (scene.path, scene.calibration_path, ontology_path(scene), *boxes)
    yield from (path for path in paths if path is not None and path.is_file())
    yield from (datum.path for datum in every)


READER = LogReader(is_dgp, read_dgp, other_place, _files)


def _labelled(scene: Scene) -> tuple[Datum, ...]:
    """Return the clouds of the first LiDAR; boxes of other sensors repeat its boxes."""
    return scene.clouds[min(scene.clouds)] if scene.clouds else ()


def _reference(scene: Scene) -> tuple[Datum, ...]:
    """Return the data whose poses are the path of the vehicle.

    Only one sensor's: in DDAD, poses of pictures are those of 5 to 6 ms after their stamps
    [measured], so that a path through poses of cameras and LiDAR would go back and forth.
    """
    part = scene.clouds or scene.pictures
    return part[max(sorted(part), key=lambda name: len(part[name]))]


def _measured(scene: Scene, calibration: Calibration) -> tuple[float, float, tuple[str, ...]]:
    """Return height of the road in frame `vehicle`, largest intensity, and notes."""
    clouds: list[Float64[np.ndarray, "n 3"]] = []
    scales = [1.0]
    for sensor, data in scene.clouds.items():
        mounting = calibration.mounting(sensor)
        picked = sorted({0, len(data) // 2, len(data) - 1})[:_MEASURED]
        for datum in (data[i] for i in picked):
            columns = read_columns(datum)
            scales.append(intensity_scale(datum, columns))
            points = mounting.apply(columns[:, :3])
            clouds.append(points[np.isfinite(points).all(axis=1)])
    height_m = road_height_m(clouds)
    if height_m is None:
        note = "the road below the vehicle was not found: its height is that of the vehicle's frame"
        return 0.0, max(scales), (note,)
    note = f"the road is {height_m:+.3f} m from the vehicle frame's origin, as returns show"
    return height_m, max(scales), (note,)


def _raised(height_m: float) -> RigidTransform:
    """Return `ego_from_vehicle`: the same axes, with the origin on the road."""
    return RigidTransform.from_rotation("ego", "vehicle", np.eye(3), np.array([0, 0, height_m]))


def _ego_path(
    data: tuple[Datum, ...],
    calibration: Calibration,
    ego_from_vehicle: RigidTransform,
    path: Path,
) -> Trajectory:
    sensor_from_ego = (ego_from_vehicle @ calibration.mounting(data[0].sensor)).inverse()
    matrices = np.stack([(d.world_from_sensor @ sensor_from_ego).matrix for d in data])
    if not (matrices[:, 2, 2] > _UPRIGHT).all():
        raise InputError(
            "the vehicle is not upright",
            where=path,
            got=f"its z axis at a cosine of {matrices[:, 2, 2].min():.2f} to world z",
            expected="extrinsics in a frame of the vehicle: x forward, y left, z up",
        )
    return _checked_path(path / data[0].sensor / "pose", "ego", data, matrices)


def _checked_path(
    where: Path, name: str, data: tuple[Datum, ...], matrices: Float64[np.ndarray, "n 4 4"]
) -> Trajectory:
    """Return `world_from_<name>` at the times of the data.

    Raises:
        InputError: it jumps.
    """
    times_ns = np.array([datum.time_ns for datum in data], dtype=np.int64)
    # Positions from the first one: coordinates of scenes differ by kilometres (DDAD issue 10).
    near = matrices.copy()
    near[:, :3, 3] -= matrices[0, :3, 3]
    check_poses(where, Trajectory("world", name, times_ns, near))
    return Trajectory("world", name, times_ns, matrices)


def _cameras(
    scene: Scene, calibration: Calibration, ego_from_vehicle: RigidTransform, ego: Trajectory
) -> tuple[tuple[RecordedCamera, ...], list[str]]:
    cameras: list[RecordedCamera] = []
    notes: list[str] = []
    for name, data in scene.pictures.items():
        size = image_size(data[0].path)
        for datum in data[1:]:
            check_size(datum.path, size, "the camera's other pictures")
        lens, lens_notes = read_lens(calibration, name, size)
        notes += lens_notes
        if lens is None:
            continue
        pictures = tuple(
            RecordedPicture(d.time_ns, d.path, partial(load_image, d.path, *size), _camera_pose(d))
            for d in data
        )
        where = scene.path / name / "pose"
        matrices = np.stack([d.world_from_sensor.matrix for d in data])
        notes += check_rigid(where, ego, _checked_path(where, name, data, matrices))
        mounting = (ego_from_vehicle @ calibration.mounting(name)).matrix
        ego_from_camera = RigidTransform("ego", "camera", mounting)
        cameras.append(RecordedCamera(name, lens, ego_from_camera, pictures))
    return tuple(cameras), notes


def _camera_pose(datum: Datum) -> RigidTransform:
    return RigidTransform("world", "camera", datum.world_from_sensor.matrix)


def _sweeps(
    scene: Scene, calibration: Calibration, ego_from_vehicle: RigidTransform, scale: float
) -> tuple[Mapping[str, tuple[RecordedSweep, ...]], list[str]]:
    # Beams that start on the road would carve vehicles and kerbs: of the returns of the sample, 16
    # to 40 % would lie behind nearer ones from there, but 2 % from the cameras, which
    # are beside the LiDARs on the roof [measured].
    heads = [ego_from_vehicle @ calibration.mounting(name) for name in scene.pictures]
    roof_ego = np.mean([pose.translation_m for pose in heads], axis=0)
    sweeps: dict[str, tuple[RecordedSweep, ...]] = {}
    notes: list[str] = []
    for name, data in scene.clouds.items():
        ego_from_sensor = ego_from_vehicle @ calibration.mounting(name)
        origin_ego = ego_from_sensor.translation_m
        if origin_ego[2] < _LOWEST_LIDAR_M:
            origin_ego = roof_ego
            notes.append(f"{name}: merged cloud without positions of its LiDARs: beams start at the"
                         f" mean position of the cameras, {roof_ego[2]:.2f} m high")  # fmt: skip
        notes.append(f"{name}: returns have no times of their own; that of the sweep is used")
        sources = [CloudSource(d, ego_from_sensor, origin_ego, scale) for d in data]
        sweeps[name] = tuple(RecordedSweep(s.datum.time_ns, s.datum.path, s.load) for s in sources)
    return sweeps, notes
