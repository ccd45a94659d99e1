"""Version 2 of the data set: a folder with one Parquet file for each component and segment.

Names of columns are those of waymo_open_dataset/v2 (github.com/waymo-research/
waymo-open-dataset).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.datasets.lenses import Lens
from lightsim.datasets.waymo.range_image import shaped
from lightsim.datasets.waymo.segment import (
    Box,
    Camera,
    Frame,
    Laser,
    Picture,
    RangeImages,
    Segment,
    decode_picture,
    make_box,
    make_camera,
    make_picture,
    time_ns,
    transform,
)
from lightsim.datasets.waymo.table import Row, Table
from lightsim.datasets.waymo.wire import broken
from lightsim.store.reading import is_file

PICTURES = "camera_image"
"""Folder of the component with pictures, which every segment has."""
_NEEDED = (PICTURES, "camera_calibration", "vehicle_pose")
_OPTIONAL = ("lidar", "lidar_calibration", "lidar_pose", "lidar_box", "stats")
_TIME, _CAMERA, _LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
_OBJECT = "key.laser_object_id"
_INTRINSIC = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_CALIBRATION = "[CameraCalibrationComponent]."
_IMAGE = "[CameraImageComponent]."
_SHUTTER = f"{_IMAGE}rolling_shutter_params."
_TIMES = (
    f"{_IMAGE}pose_timestamp",
    *(f"{_SHUTTER}{n}" for n in ("shutter", "camera_trigger_time", "camera_readout_done_time")),
)
_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_BEAMS = "[LiDARCalibrationComponent].beam_inclination."
_LASER_POSE = "[LiDARCalibrationComponent].extrinsic.transform"
_BOX = "[LiDARBoxComponent]."
_BOX_NUMBERS = (
    *(f"{_BOX}box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"),
    f"{_BOX}box.heading",
)
_SPEEDS = (f"{_BOX}speed.x", f"{_BOX}speed.y")
_RETURNS = ("[LiDARComponent].range_image_return1", "[LiDARComponent].range_image_return2")
_PIXEL_POSE = "[LiDARPoseComponent].range_image_return1"
_LOCATION = "[StatsComponent].location"


def scene_files(source: Path, scene: str) -> list[Path]:
    """Return the files of a segment that exist."""
    paths = [source / part / f"{scene}.parquet" for part in (*_NEEDED, *_OPTIONAL)]
    return [path for path in paths if is_file(path)]


def read_parquet(source: Path, scene: str) -> Segment:
    """Read a segment; pictures and range images are read on demand.

    Raises:
        InputError: a file is missing or damaged.
        MissingDependencyError: pyarrow is not installed.
    """

    def path(part: str) -> Path:
        return source / part / f"{scene}.parquet"

    def rows(part: str, columns: tuple[str, ...]) -> list[Row]:
        is_there = part in _NEEDED or is_file(path(part))
        return Table(path(part), columns).rows if is_there else []

    columns = (*(f"{_CALIBRATION}intrinsic.{name}" for name in _INTRINSIC),
               *(f"{_CALIBRATION}{name}" for name in ("extrinsic.transform", "width", "height",
                                                      "rolling_shutter_direction")))  # fmt: skip
    cameras = {
        r.whole(_CAMERA): _camera(r) for r in rows("camera_calibration", (_CAMERA, *columns))
    }
    beams = (_LASER, _LASER_POSE, *(f"{_BEAMS}{name}" for name in ("min", "max", "values")))
    lasers = {row.whole(_LASER): _laser(row) for row in rows("lidar_calibration", beams)}
    poses = {row.whole(_TIME): row for row in rows("vehicle_pose", (_TIME, _POSE))}
    pictures = _pictures(path(PICTURES), cameras)
    boxes: dict[int, list[Box]] = {}
    for row in rows("lidar_box", (_TIME, _OBJECT, f"{_BOX}type", *_BOX_NUMBERS, *_SPEEDS)):
        boxes.setdefault(row.whole(_TIME), []).append(_box(row))
    sweeps = _sweeps(path("lidar"), path("lidar_pose"))
    frames = tuple(
        Frame(
            time_ns(time_us / 1e6, row.where),
            transform("world", "ego", row.numbers(_POSE), row.where),
            tuple(pictures.get(time_us, ())),
            sweeps.get(time_us, {}),
            tuple(boxes.get(time_us, ())),
        )
        for time_us, row in sorted(poses.items())
    )
    lost = pictures.keys() - poses.keys()
    if lost:
        raise broken(path("vehicle_pose"), f"no pose at {min(lost)}", f"those of {path(PICTURES)}")
    stats = rows("stats", (_LOCATION,))
    return Segment(scene, stats[0].text(_LOCATION) if stats else "", cameras, lasers, frames)


def _camera(row: Row) -> Camera:
    intrinsic = [row.number(f"{_CALIBRATION}intrinsic.{name}") for name in _INTRINSIC]
    matrix = row.numbers(f"{_CALIBRATION}extrinsic.transform")
    size = row.whole(f"{_CALIBRATION}width"), row.whole(f"{_CALIBRATION}height")
    direction = row.whole(f"{_CALIBRATION}rolling_shutter_direction")
    pose = transform("ego", "waymo camera", matrix, row.where)
    return make_camera(intrinsic, pose, size, direction, row.where)


def _laser(row: Row) -> Laser:
    pose = transform("ego", "laser", row.numbers(_LASER_POSE), row.where)
    edges = row.number(f"{_BEAMS}min"), row.number(f"{_BEAMS}max")
    return Laser(pose, tuple(row.numbers(f"{_BEAMS}values")), edges)


def _pictures(path: Path, cameras: Mapping[int, Camera]) -> dict[int, list[Picture]]:
    """Return the pictures by the time of their frame."""
    columns = (_TIME, _CAMERA, f"{_IMAGE}pose.transform", *_TIMES)
    table = Table(path, columns, (f"{_IMAGE}image",))
    found: dict[int, list[Picture]] = {}
    for i, row in enumerate(table.rows):
        camera = cameras.get(row.whole(_CAMERA))
        if camera is None:
            raise broken(row.where, f"camera {row.whole(_CAMERA)} without calibration")
        pose = transform("world", "ego", row.numbers(f"{_IMAGE}pose.transform"), row.where)
        pose_s, shutter_s, trigger_s, done_s = (row.number(name) for name in _TIMES)
        load = partial(_load_picture, table, i, camera.lens, row.where)
        times_s = pose_s, shutter_s, trigger_s, done_s
        picture = make_picture(row.whole(_CAMERA), times_s, pose, load, row.where)
        found.setdefault(row.whole(_TIME), []).append(picture)
    return found


def _load_picture(table: Table, i: int, lens: Lens, where: str) -> UInt8[np.ndarray, "h w 3"]:
    data = table.cells(i)[f"{_IMAGE}image"].as_py()
    if not isinstance(data, bytes):
        raise broken(where, type(data).__name__, "a JPEG")
    return decode_picture(data, lens, where)


def _box(row: Row) -> Box:
    numbers = [row.number(name) for name in _BOX_NUMBERS]
    speed = math.hypot(*(row.number_or_zero(name) for name in _SPEEDS))
    return make_box(row.text(_OBJECT), row.whole(f"{_BOX}type"), numbers, speed, row.where)


_Sweeps = dict[int, dict[int, partial[RangeImages]]]


def _sweeps(path: Path, pose_path: Path) -> _Sweeps:
    """Return what loads range images, by time of the frame and number of the LiDAR."""
    if not is_file(path):
        return {}
    large = tuple(f"{part}.{name}" for part in _RETURNS for name in ("values", "shape"))
    table = Table(path, (_TIME, _LASER), large)
    poses: Table | None = None
    if is_file(pose_path):
        large = (f"{_PIXEL_POSE}.values", f"{_PIXEL_POSE}.shape")
        poses = Table(pose_path, (_TIME, _LASER), large)
    pose_rows = {} if poses is None else {
        (row.whole(_TIME), row.whole(_LASER)): i for i, row in enumerate(poses.rows)
    }  # fmt: skip
    found: _Sweeps = {}
    for i, row in enumerate(table.rows):
        key = row.whole(_TIME), row.whole(_LASER)
        posed = (poses, pose_rows[key]) if poses is not None and key in pose_rows else None
        found.setdefault(key[0], {})[key[1]] = partial(_load_sweep, table, i, posed)
    return found


def _load_sweep(table: Table, i: int, posed: tuple[Table, int] | None) -> RangeImages:
    images = [_image(table, i, part, 2) for part in _RETURNS]
    poses = None if posed is None else _image(*posed, _PIXEL_POSE, 6)
    returns = tuple(image for image in images if image is not None)
    if not returns:
        raise broken(f"{table.path}, row {i}", "no range image")
    return RangeImages(returns, None if poses is None else poses[..., :6])


def _image(table: Table, i: int, part: str, channels: int) -> Float32[np.ndarray, "h w c"] | None:
    cells, where = table.cells(i), f"{table.path}, row {i}"
    values, dims = cells[f"{part}.values"], cells[f"{part}.shape"].as_py()
    if not values.is_valid or dims is None:
        return None
    if not isinstance(dims, list):
        raise broken(where, f"a shape of {dims!r:.40}", "rows, columns and channels")
    return shaped(table.array(values, where), dims, channels, where)
