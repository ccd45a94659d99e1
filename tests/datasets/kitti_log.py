"""Small logs in the layouts of KITTI raw and KITTI-360, with closed-form truth.

The ego drives at `SPEED_M_S` on a straight line. The scanner turns clockwise and sees points 10 m
away at all azimuths; a car drives ahead of the ego at its speed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
DRIVE360 = "2013_05_28_drive_0000_sync"
SPEED_M_S = 15.0
YAW_RAD = 0.6
"""Heading of the ego, counter-clockwise from east."""
LATITUDE_DEG, LONGITUDE_DEG = 49.0, 8.4
ORIGIN360_M = np.array([1200.0, -3400.0, 115.0])
WIDTH_PX, HEIGHT_PX = 64, 48
N_FRAMES = 4
PERIOD_NS = 103_000_000
START_NS = 1_317_043_079_287_000_000
"""Local time of the first frame: 2011-09-26 13:17:59.287."""
BEFORE = 0.45
"""Part of a revolution of KITTI's sweeps before the scanner faces forward."""
IMU_ABOVE_ROAD_M = 0.93
CAR_SIZE_LWH_M = (4.2, 1.8, 1.5)
CAR_VELO_M, CAR_YAW_RAD = np.array([12.0, 1.5, -1.0]), 0.1
"""Centre and heading of the car in frame `velo`."""
_FOCAL_PX, _CX, _CY = 60.0, 31.5, 23.5


def _matrix(rotation: np.ndarray, translation: list[float] | np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def _turn(*degrees: float) -> np.ndarray:
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


# Camera axes (right, down, forward) in axes forward, left, up.
_CAMERA_FROM_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
VELO_FROM_IMU = _matrix(_turn(0.8, 0.1, -0.1), [-0.8, 0.3, -0.8])
CAM0_FROM_VELO = _matrix(_CAMERA_FROM_FORWARD @ _turn(0.0, 0.5, -0.4), [0.0, -0.08, -0.27])
RECT_FROM_CAM0 = _matrix(_turn(0.2, 0.6, -0.5), [0.0, 0.0, 0.0])
BASELINE_M = {"image_02": np.array([0.06, 0.0, 0.003]), "image_03": np.array([-0.47, 0.003, 0.0])}
"""Translation of `camera_from_rect`."""
EGO_FROM_IMU = _matrix(np.eye(3), [0.0, 0.0, IMU_ABOVE_ROAD_M])
EGO_FROM_VELO = EGO_FROM_IMU @ np.linalg.inv(VELO_FROM_IMU)
# KITTI-360: axes of the unit are forward, right and down.
EGO_FROM_IMU360 = _matrix(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, IMU_ABOVE_ROAD_M])
IMU_FROM_CAM360 = {
    "image_00": _matrix(np.diag([1, -1, -1]) @ _CAMERA_FROM_FORWARD.T, [1.6, 0.0, -0.65]),
    "image_01": _matrix(np.diag([1, -1, -1]) @ _CAMERA_FROM_FORWARD.T, [1.6, 0.6, -0.65]),
    "image_02": _matrix(
        np.diag([1, -1, -1]) @ _turn(0, 0, 90) @ _CAMERA_FROM_FORWARD.T, [0.7, -0.8, -0.9]
    ),
    "image_03": _matrix(
        np.diag([1, -1, -1]) @ _turn(0, 0, -90) @ _CAMERA_FROM_FORWARD.T, [0.7, 0.8, -0.9]
    ),
}
RECT_FROM_CAM360 = _matrix(_turn(0.3, -0.7, 0.4), [0.0, 0.0, 0.0])
VELO_FROM_CAM360 = _matrix(_CAMERA_FROM_FORWARD.T @ _turn(0.4, 0.2, 0.1), [0.8, 0.3, -0.2])
EGO_FROM_VELO360 = EGO_FROM_IMU360 @ IMU_FROM_CAM360["image_00"] @ np.linalg.inv(VELO_FROM_CAM360)


def frame_ns(number: int) -> int:
    """Time of a frame."""
    return START_NS + number * PERIOD_NS


def world_from_ego(time_ns: int, origin_m: np.ndarray) -> np.ndarray:
    way_m = SPEED_M_S * (time_ns - START_NS) * 1e-9
    step = way_m * np.array([np.cos(YAW_RAD), np.sin(YAW_RAD), 0.0])
    return _matrix(Rotation.from_euler("z", YAW_RAD).as_matrix(), origin_m + step)


def azimuths(before: float) -> np.ndarray:
    """Azimuths of the points in the order of time, which start where the revolution does."""
    turns = (np.arange(400) + 0.5) / 400 - before
    return -2 * np.pi * turns


def points_velo(before: float) -> np.ndarray:
    angle = azimuths(before)
    return np.stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(400, -1.7)], axis=1)


def offsets_s(before: float) -> np.ndarray:
    return ((np.arange(400) + 0.5) / 400 - before) * PERIOD_NS * 1e-9


def points_world(number: int, before: float, from_velo: np.ndarray, origin_m: np.ndarray):
    """Positions of a sweep's points in the world, each from the scanner's pose at its time."""
    found = []
    for point, offset_s in zip(points_velo(before), offsets_s(before), strict=True):
        pose = world_from_ego(frame_ns(number) + round(offset_s * 1e9), origin_m) @ from_velo
        found.append(pose[:3, :3] @ point + pose[:3, 3])
    return np.array(found)


def world_from_car(time_ns: int, from_velo: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
    car = _matrix(Rotation.from_euler("z", CAR_YAW_RAD).as_matrix(), CAR_VELO_M)
    return world_from_ego(time_ns, origin_m) @ from_velo @ car


def write_kitti(folder: Path, n_frames: int = N_FRAMES) -> Path:
    """Write the calibration and one drive of KITTI raw; return the drive."""
    date = folder / DATE
    drive = date / DRIVE
    for name in ("image_02", "image_03"):
        _write_pictures(drive / name, "data", (WIDTH_PX, HEIGHT_PX), n_frames)
    _write_calibration(date)
    points = drive / "velodyne_points"
    _write_sweeps(points, points_velo(BEFORE), n_frames)
    for name, part in (("start", -BEFORE), ("end", 1 - BEFORE)):
        _write_times(points / f"timestamps_{name}.txt", n_frames, round(part * PERIOD_NS))
    _write_times(drive / "oxts" / "timestamps.txt", n_frames, 4_000_000)
    (drive / "oxts" / "data").mkdir()
    for number in range(n_frames):
        record = _oxts_record(frame_ns(number) + 4_000_000)
        path = drive / "oxts" / "data" / f"{number:010d}.txt"
        path.write_text(" ".join(repr(float(value)) for value in record))
    (drive / "tracklet_labels.xml").write_text(_tracklets(n_frames))
    return drive


def _write_calibration(date: Path) -> None:
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for name, baseline in BASELINE_M.items():
        k = np.array([[_FOCAL_PX, 0, _CX], [0, _FOCAL_PX, _CY], [0, 0, 1]])
        p = np.column_stack([k, k @ baseline])
        lines.append(f"S_rect_{name[-2:]}: {WIDTH_PX:.6e} {HEIGHT_PX:.6e}")
        lines.append(f"P_rect_{name[-2:]}: {_words(p)}")
    lines.append(f"R_rect_00: {_words(RECT_FROM_CAM0[:3, :3])}")
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, matrix in (("velo_to_cam", CAM0_FROM_VELO), ("imu_to_velo", VELO_FROM_IMU)):
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {_words(matrix[:3, :3])}\n"
        (date / f"calib_{name}.txt").write_text(f"{text}T: {_words(matrix[:3, 3])}\n")


def _words(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.9e}" for number in numbers.ravel())


def _write_pictures(folder: Path, data: str, size: tuple[int, int], n_frames: int) -> None:
    (folder / data).mkdir(parents=True)
    for number in range(n_frames):
        Image.new("RGB", size, (20 * number, 90, 60)).save(folder / data / f"{number:010d}.png")
    _write_times(folder / "timestamps.txt", n_frames, 0)


def _write_times(path: Path, n_frames: int, after_ns: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = [np.datetime64(frame_ns(n) + after_ns, "ns") for n in range(n_frames)]
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps))


def _write_sweeps(folder: Path, points: np.ndarray, n_frames: int) -> None:
    (folder / "data").mkdir(parents=True)
    table = np.column_stack([points, np.full(len(points), 0.3)])
    # Stored by laser, not by time.
    table = np.concatenate([table[::2], table[1::2]])
    for number in range(n_frames):
        (folder / "data" / f"{number:010d}.bin").write_bytes(table.astype("<f4").tobytes())
    _write_times(folder / "timestamps.txt", n_frames, 0)


def _oxts_record(time_ns: int) -> np.ndarray:
    east, north, up = world_from_ego(time_ns, np.array([0.0, 0.0, 100.0]))[:3, 3]
    # WGS 84: radii of curvature at the first record's latitude.
    e2, a = 6.69437999014e-3, 6378137.0
    w = 1 - e2 * np.sin(np.radians(LATITUDE_DEG)) ** 2
    latitude = LATITUDE_DEG + np.degrees(north / (a * (1 - e2) / w**1.5))
    longitude = LONGITUDE_DEG + np.degrees(
        east / (a / np.sqrt(w) * np.cos(np.radians(LATITUDE_DEG)))
    )
    record = np.zeros(30)
    record[:6] = latitude, longitude, up + IMU_ABOVE_ROAD_M, 0.0, 0.0, YAW_RAD
    return record


def _tracklets(n_frames: int) -> str:
    length, width, height = CAR_SIZE_LWH_M
    x, y, z = CAR_VELO_M
    pose = (
        f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z - height / 2}</tz><rx>0</rx><ry>0</ry>"
        f"<rz>{CAR_YAW_RAD}</rz><state>2</state></item>"
    )
    return f"""<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
<count>1</count>
<item_version>1</item_version>
<item class_id="1" tracking_level="0" version="1">
  <objectType>Car</objectType><h>{height}</h><w>{width}</w><l>{length}</l>
  <first_frame>0</first_frame>
  <poses class_id="2" tracking_level="0" version="0"><count>{n_frames}</count>
  <item_version>2</item_version>{pose * n_frames}</poses>
  <finished>1</finished>
</item>
</tracklets>
</boost_serialization>
"""


def write_kitti360(root: Path, n_frames: int = N_FRAMES) -> Path:
    """Write one drive of KITTI-360 with three cameras; return the root."""
    images = root / "data_2d_raw" / DRIVE360
    _write_pictures(images / "image_00", "data_rect", (WIDTH_PX, HEIGHT_PX), n_frames)
    _write_pictures(images / "image_01", "data_rect", (WIDTH_PX, HEIGHT_PX), n_frames)
    _write_pictures(images / "image_02", "data_rgb", (64, 64), n_frames)
    calibration = root / "calibration"
    calibration.mkdir()
    rig = "".join(f"{name}: {_words(m[:3])}\n" for name, m in IMU_FROM_CAM360.items())
    (calibration / "calib_cam_to_pose.txt").write_text(rig)
    (calibration / "calib_cam_to_velo.txt").write_text(_words(VELO_FROM_CAM360[:3]))
    k = np.array([[_FOCAL_PX, 0, _CX, 0], [0, _FOCAL_PX, _CY, 0], [0, 0, 1, 0]])
    lines = [
        f"S_rect_{n}: {WIDTH_PX} {HEIGHT_PX}\nR_rect_{n}: {_words(RECT_FROM_CAM360[:3, :3])}\n"
        f"P_rect_{n}: {_words(k)}\n"
        for n in ("00", "01")
    ]
    (calibration / "perspective.txt").write_text("".join(lines))
    for name in ("image_02", "image_03"):
        (calibration / f"{name}.yaml").write_text(_fisheye(name))
    points = root / "data_3d_raw" / DRIVE360 / "velodyne_points"
    _write_sweeps(points, points_velo(0.5), n_frames)
    poses = root / "data_poses" / DRIVE360
    poses.mkdir(parents=True)
    rows = []
    for number in range(n_frames):
        pose = world_from_ego(frame_ns(number), ORIGIN360_M) @ EGO_FROM_IMU360
        rows.append(f"{number} {_words(pose[:3])}\n")
    (poses / "poses.txt").write_text("".join(rows))
    labels = root / "data_3d_bboxes" / "train" / f"{DRIVE360}.xml"
    labels.parent.mkdir(parents=True)
    labels.write_text(_boxes360(n_frames))
    return root


def _fisheye(name: str) -> str:
    return f"""%YAML:1.0
---
model_type: MEI
camera_name: {name}
image_width: 64
image_height: 64
mirror_parameters:
   xi: 2.2
distortion_parameters:
   k1: 1.6e-02
   k2: 1.6e+00
   p1: 4.3e-04
   p2: 1.3e-04
projection_parameters:
   gamma1: 61.0
   gamma2: 61.0
   u0: 32.2
   v0: 31.8
"""


def _boxes360(n_frames: int) -> str:
    moving = [
        _record360(
            number + 1, "car", 7, number, world_from_car(frame_ns(number), EGO_FROM_VELO360,
                                                         ORIGIN360_M), n_frames,
        )
        for number in range(n_frames)
    ]  # fmt: skip
    parked = _record360(50, "car", 8, -1, _matrix(np.eye(3), ORIGIN360_M + [8, -3, 0.8]), n_frames)
    house = _record360(51, "building", 9, -1, _matrix(np.eye(3), ORIGIN360_M + 20), n_frames)
    body = "\n".join([*moving, parked, house])
    return f'<?xml version="1.0"?>\n<opencv_storage>\n{body}\n</opencv_storage>\n'


def _record360(
    index: int, label: str, instance: int, frame: int, pose: np.ndarray, n_frames: int
) -> str:
    scaled = pose.copy()
    scaled[:3, :3] *= np.array(CAR_SIZE_LWH_M)
    corners = np.array([[x, y, z] for x in (0.5, -0.5) for y in (0.5, -0.5) for z in (0.5, -0.5)])
    return (
        f"<object{index}><index>{index}</index><label>{label}</label>"
        f"<semanticId>13</semanticId><instanceId>{instance}</instanceId>"
        f"<start_frame>0</start_frame><end_frame>{n_frames - 1}</end_frame>"
        f"<timestamp>{frame}</timestamp><dynamic>{int(frame >= 0)}</dynamic>"
        f'<transform type_id="opencv-matrix"><rows>4</rows><cols>4</cols><dt>f</dt><data>\n'
        f"{_words(scaled)}</data></transform>"
        f'<vertices type_id="opencv-matrix"><rows>8</rows><cols>3</cols><dt>f</dt><data>\n'
        f"{_words(corners)}</data></vertices></object{index}>"
    )
