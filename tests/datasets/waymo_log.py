"""A small drive in both forms of the Waymo Open Dataset, for tests; its truth is in closed form.

Four frames; two cameras of 64x48 px; the top LiDAR with a pose for each pixel, and the front one
with a virtual range image. The vehicle drives at 15 m/s, with constant roll, pitch and yaw. Returns
are of the ground and of a wall; a car drives past a parked one.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

NAME = "1234567890_000_020_000"
START_US = 1_553_735_853_462_203
START_S = START_US * 1e-6
N_FRAMES, PERIOD_S, TURN_S = 4, 0.1, 0.1
WIDTH_PX, HEIGHT_PX = 64, 48
INTRINSIC = (60.0, 60.0, 31.0, 25.0, 0.04, -0.03, 0.001, -0.002, 0.0)
SHUTTER_S, READOUT_S, POSE_LATE_S = 0.002, 0.044, 0.0015
YAW_DEG = {1: 0.0, 4: 90.0}
"""Azimuth of each camera on the vehicle."""
SPEED_M_S, OTHER_SPEED_M_S = 15.0, 9.0
ROLL_PITCH_YAW = np.radians([1.0, -2.0, 33.0])
ORIGIN = np.array([-251.0, 424.0, -16.0])
ATTITUDE = Rotation.from_euler("ZYX", ROLL_PITCH_YAW[::-1]).as_matrix()
LIDAR_YAW, LIDAR_EGO = np.radians(148.0), np.array([1.43, 0.0, 2.184])
INCLINATIONS = np.radians([-20.0, -11.0, -6.0, -3.0, -1.0, 1.5])
COLUMNS = 90
ROW_DELAY_S = 0.0004
GROUND_M, WALL_M = -16.1, 60.0
"""Height of the ground, and distance of a cylindrical wall around `ORIGIN`."""
BOX_LWH = (4.4, 1.8, 1.5)


def ego_at(time_s: np.ndarray | float) -> np.ndarray:
    """Position of the vehicle in the world; its attitude is constant."""
    ahead = ATTITUDE[:, 0] * SPEED_M_S
    return ORIGIN + np.multiply.outer(np.asarray(time_s) - START_S, ahead)


def car_at(time_s: float) -> np.ndarray:
    """Centre of the moving car in the world, which drives north-west."""
    return (
        ORIGIN
        + np.array([14.0, 9.0, 0.7])
        + np.array([-0.6, 0.8, 0.0]) * OTHER_SPEED_M_S * (time_s - START_S)
    )


PARKED = ORIGIN + np.array([17.0, 14.0, 0.7])


def start_s(frame: int) -> float:
    return START_S + PERIOD_S * frame


def pose_s(frame: int) -> float:
    """Time of the frame's pose: that of the front picture."""
    return middle_s(frame, 1) + POSE_LATE_S


def middle_s(frame: int, camera: int) -> float:
    """Middle of the exposure of a picture: when the LiDAR points where the camera looks."""
    return start_s(frame) + TURN_S * (180.0 - YAW_DEG[camera]) / 360.0


def matrix_at(time_s: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ATTITUDE, ego_at(time_s)
    return matrix


def scanned_s(frame: int, place: Any) -> float:
    """Time at which the LiDAR points at an actor, whose place depends on time."""
    time_s = pose_s(frame)
    for _ in range(20):
        x, y, _ = ATTITUDE.T @ (place(time_s) - ego_at(pose_s(frame)))
        time_s = start_s(frame) + TURN_S * (np.pi - np.arctan2(y, x)) / (2 * np.pi)
    return time_s


def picture_bytes(frame: int) -> bytes:
    """A JPEG whose red and green grow with u and v."""
    rows, columns = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX]
    pixels = np.stack([60 + 2 * columns, 60 + 2 * rows, np.full_like(rows, 20 * frame)], axis=-1)
    out = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(out, "JPEG", quality=97, subsampling=0)
    return out.getvalue()


def top_images(frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and second returns, and poses of pixels, of the top LiDAR."""
    row, column = np.mgrid[0 : len(INCLINATIONS), 0:COLUMNS]
    azimuth = np.pi - 2 * np.pi * (column + 0.5) / COLUMNS
    inclination = INCLINATIONS[::-1][row]
    time_s = start_s(frame) + TURN_S * (column + 0.5) / COLUMNS + ROW_DELAY_S * row
    ego = ego_at(time_s)
    origin = ego + ATTITUDE @ LIDAR_EGO
    rays = _rays(azimuth, inclination) @ ATTITUDE.T
    first = np.zeros((*row.shape, 4), dtype=np.float32)
    first[..., 0] = _distance(origin, rays)
    first[..., 1] = np.where(column % 7 == 0, 2.5e4, 0.25)
    second = np.full_like(first, -1.0)
    second[::2, ::3] = first[::2, ::3] + (3.0, 0.0, 0.0, 0.0)
    poses = np.concatenate([np.broadcast_to(ROLL_PITCH_YAW, ego.shape), ego], axis=-1)
    poses[0, 5] = 0.0  # A pixel without a pose.
    return first, second, poses.astype(np.float32)


def front_image(frame: int) -> np.ndarray:
    """Virtual range image of the front LiDAR: of the ground, from the frame's pose."""
    row, column = np.mgrid[0:8, 0:24]
    azimuth = np.pi - 2 * np.pi * (column + 0.5) / 24
    inclination = np.radians(-90.0 + 120.0 * (7 - row + 0.5) / 8)
    image = np.zeros((8, 24, 4), dtype=np.float32)
    origin = ego_at(pose_s(frame)) + ATTITUDE @ np.array([4.07, 0.0, 0.7])
    distance = _distance(origin, _rays(azimuth, inclination) @ ATTITUDE.T)
    image[..., 0] = np.where(distance < 20.0, distance, 0.0)
    image[..., 1] = 0.5
    return image


def _rays(azimuth: np.ndarray, inclination: np.ndarray) -> np.ndarray:
    flat = np.cos(inclination)
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination)], axis=-1)


def _distance(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance to the ground or to the wall, whichever is nearer."""
    down = np.where(rays[..., 2] < -1e-9, (GROUND_M - origin[..., 2]) / rays[..., 2], np.inf)
    flat, out = rays[..., :2], (origin - ORIGIN)[..., :2]
    a, b = (flat**2).sum(-1), (flat * out).sum(-1)
    c = (out**2).sum(-1) - WALL_M**2
    return np.minimum(down, (-b + np.sqrt(b * b - a * c)) / a)


def camera_matrix(camera: int) -> np.ndarray:
    """vehicle_from_camera, x forward."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZY", [YAW_DEG[camera], 4.0], degrees=True).as_matrix()
    matrix[:3, 3] = [1.5, 0.1 * camera, 2.1]
    return matrix


def laser_matrix(number: int) -> np.ndarray:
    matrix = np.eye(4)
    yaw = LIDAR_YAW if number == 1 else 0.0
    matrix[:3, :3] = Rotation.from_euler("Z", yaw).as_matrix()
    matrix[:3, 3] = LIDAR_EGO if number == 1 else [4.07, 0.0, 0.7]
    return matrix


def labels(frame: int) -> list[dict[str, Any]]:
    """Boxes as Waymo labels them: in the vehicle's frame at the frame's pose."""
    found = []
    heading = {"car": np.arctan2(0.8, -0.6), "parked": 0.0}
    for name, place, speed in (
        ("car", car_at, OTHER_SPEED_M_S),
        ("parked", lambda _: PARKED, 0.0),
    ):
        centre = ATTITUDE.T @ (place(scanned_s(frame, place)) - ego_at(pose_s(frame)))
        found.append(
            {"id": name, "centre": centre, "heading": heading[name] - ROLL_PITCH_YAW[2],
             "speed": (-0.6 * speed, 0.8 * speed)}
        )  # fmt: skip
    return found


def picture_times(frame: int, camera: int) -> tuple[float, float, float, float]:
    """pose_timestamp, shutter, camera_trigger_time, camera_readout_done_time."""
    middle = middle_s(frame, camera)
    half = (SHUTTER_S + READOUT_S) / 2
    return middle + POSE_LATE_S, SHUTTER_S, middle - half, middle + half


# Version 1: protocol buffers in a TFRecord file.


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def whole(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)


def double(number: int, value: float) -> bytes:
    return varint(number << 3 | 1) + struct.pack("<d", value)


def block(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def pose_field(number: int, matrix: np.ndarray) -> bytes:
    return block(number, b"".join(double(1, value) for value in matrix.ravel()))


def matrix_bytes(array: np.ndarray) -> bytes:
    """A compressed MatrixFloat."""
    shape = b"".join(whole(1, size) for size in array.shape)
    return zlib.compress(block(1, array.astype("<f4").tobytes()) + block(2, shape))


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x82F63B78 * (crc & 1)
    return crc ^ 0xFFFFFFFF


def record(data: bytes) -> bytes:
    def masked(part: bytes) -> bytes:
        crc = crc32c(part)
        return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)

    length = struct.pack("<Q", len(data))
    return length + masked(length) + data + masked(data[:64])


def frame_bytes(frame: int, location: str = "location_sf") -> bytes:
    """A message `Frame`."""
    cameras = b"".join(
        block(
            2,
            whole(1, number)
            + b"".join(double(2, value) for value in INTRINSIC)
            + pose_field(3, camera_matrix(number))
            + whole(4, WIDTH_PX)
            + whole(5, HEIGHT_PX)
            + whole(6, 2),
        )
        for number in YAW_DEG
    )
    top = block(2, struct.pack(f"<{len(INCLINATIONS)}d", *INCLINATIONS)) + double(3, -0.4)
    front = double(3, -np.pi / 2) + double(4, np.pi / 6)
    lasers = b"".join(
        block(3, whole(1, number) + beams + pose_field(5, laser_matrix(number)))
        for number, beams in ((2, front), (1, top))
    )
    stats = block(4, block(2, b"Day") + block(3, location.encode()))
    first, second, poses = (matrix_bytes(image) for image in top_images(frame))
    images = b"".join(
        block(
            4,
            whole(1, number)
            + block(2, picture_bytes(frame))
            + pose_field(3, matrix_at(picture_times(frame, number)[0]))
            + b"".join(double(5 + i, t) for i, t in enumerate(picture_times(frame, number))),
        )
        for number in YAW_DEG
    )
    sweeps = block(
        5, whole(1, 1) + block(2, block(2, first) + block(4, poses)) + block(3, block(2, second))
    ) + block(5, whole(1, 2) + block(2, block(2, matrix_bytes(front_image(frame)))))
    boxes = b""
    for label in labels(frame):
        x, y, z = label["centre"]
        length, width, height = BOX_LWH
        numbers = (x, y, z, width, length, height, label["heading"])
        box = b"".join(double(1 + i, float(value)) for i, value in enumerate(numbers))
        speed = b"".join(double(1 + i, value) for i, value in enumerate(label["speed"]))
        boxes += block(6, block(1, box) + block(2, speed) + whole(3, 1)
                       + block(4, label["id"].encode()))  # fmt: skip
    context = block(1, NAME.encode()) + cameras + lasers + stats
    return (
        block(1, context)
        + whole(2, START_US + round(PERIOD_S * 1e6) * frame)
        + pose_field(3, matrix_at(pose_s(frame)))
        + images + sweeps + boxes
    )  # fmt: skip


def write_tfrecord(path: Path, location: str = "location_sf") -> Path:
    """Write version 1."""
    path.write_bytes(b"".join(record(frame_bytes(i, location)) for i in range(N_FRAMES)))
    return path


# Version 2: Parquet.


def write_parquet(folder: Path, name: str = NAME, rows_in_group: int = 3) -> Path:
    """Write version 2."""
    for part, columns in parquet_columns().items():
        write_component(folder, part, columns, name, rows_in_group)
    return folder


def write_component(
    folder: Path, part: str, columns: dict[str, Any], name: str = NAME, rows_in_group: int = 3
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({"key.segment_context_name": [name] * len(next(iter(columns.values()))),
                      **columns})  # fmt: skip
    path = folder / part / f"{name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, row_group_size=rows_in_group)


def parquet_columns() -> dict[str, dict[str, Any]]:
    """Columns of every component."""
    frames = range(N_FRAMES)
    times = [START_US + round(PERIOD_S * 1e6) * i for i in frames]
    pairs = [(i, camera) for i in frames for camera in YAW_DEG]
    image, calibration = "[CameraImageComponent].", "[CameraCalibrationComponent]."
    shutter, beams = f"{image}rolling_shutter_params.", "[LiDARCalibrationComponent]."
    stamps = [picture_times(*pair) for pair in pairs]
    images = {i: top_images(i) for i in frames}
    sweeps = [(i, laser) for i in frames for laser in (1, 2)]
    first = [images[i][0] if laser == 1 else front_image(i) for i, laser in sweeps]
    second = [images[i][1] if laser == 1 else None for i, laser in sweeps]
    boxes = [(i, label) for i in frames for label in labels(i)]
    names = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
    box = "[LiDARBoxComponent]."
    return {
        "camera_image": {
            "key.frame_timestamp_micros": [times[i] for i, _ in pairs],
            "key.camera_name": [camera for _, camera in pairs],
            f"{image}image": [picture_bytes(i) for i, _ in pairs],
            f"{image}pose.transform": [matrix_at(t[0]).ravel().tolist() for t in stamps],
            f"{image}pose_timestamp": [t[0] for t in stamps],
            f"{shutter}shutter": [t[1] for t in stamps],
            f"{shutter}camera_trigger_time": [t[2] for t in stamps],
            f"{shutter}camera_readout_done_time": [t[3] for t in stamps],
        },
        "camera_calibration": {
            "key.camera_name": list(YAW_DEG),
            **{
                f"{calibration}intrinsic.{name}": [value] * len(YAW_DEG)
                for name, value in zip(names, INTRINSIC, strict=True)
            },
            f"{calibration}extrinsic.transform": [
                camera_matrix(n).ravel().tolist() for n in YAW_DEG
            ],
            f"{calibration}width": [WIDTH_PX] * len(YAW_DEG),
            f"{calibration}height": [HEIGHT_PX] * len(YAW_DEG),
            f"{calibration}rolling_shutter_direction": [2] * len(YAW_DEG),
        },
        "vehicle_pose": {
            "key.frame_timestamp_micros": times,
            "[VehiclePoseComponent].world_from_vehicle.transform": [
                matrix_at(pose_s(i)).ravel().tolist() for i in frames
            ],
        },
        "lidar": {
            "key.frame_timestamp_micros": [times[i] for i, _ in sweeps],
            "key.laser_name": [laser for _, laser in sweeps],
            **_images("[LiDARComponent].range_image_return1", first),
            **_images("[LiDARComponent].range_image_return2", second),
        },
        "lidar_pose": {
            "key.frame_timestamp_micros": times,
            "key.laser_name": [1] * N_FRAMES,
            **_images("[LiDARPoseComponent].range_image_return1", [images[i][2] for i in frames]),
        },
        "lidar_calibration": {
            "key.laser_name": [1, 2],
            f"{beams}extrinsic.transform": [laser_matrix(n).ravel().tolist() for n in (1, 2)],
            f"{beams}beam_inclination.min": [-0.4, -np.pi / 2],
            f"{beams}beam_inclination.max": [0.0, np.pi / 6],
            f"{beams}beam_inclination.values": [INCLINATIONS.tolist(), None],
        },
        "lidar_box": {
            "key.frame_timestamp_micros": [times[i] for i, _ in boxes],
            "key.laser_object_id": [label["id"] for _, label in boxes],
            f"{box}type": [1] * len(boxes),
            **{
                f"{box}box.center.{axis}": [float(label["centre"][k]) for _, label in boxes]
                for k, axis in enumerate("xyz")
            },
            **{f"{box}box.size.{axis}": [BOX_LWH[k]] * len(boxes) for k, axis in enumerate("xyz")},
            f"{box}box.heading": [float(label["heading"]) for _, label in boxes],
            f"{box}speed.x": [label["speed"][0] for _, label in boxes],
            f"{box}speed.y": [label["speed"][1] for _, label in boxes],
        },
        "stats": {
            "key.frame_timestamp_micros": times,
            "[StatsComponent].location": ["location_sf"] * N_FRAMES,
        },
    }


def _images(prefix: str, images: Sequence[np.ndarray | None]) -> dict[str, Any]:
    import pyarrow as pa

    values = [None if image is None else image.ravel() for image in images]
    shapes = [None if image is None else list(image.shape) for image in images]
    return {
        f"{prefix}.values": pa.array(values, pa.list_(pa.float32())),
        f"{prefix}.shape": pa.array(shapes, pa.list_(pa.int32(), 3)),
    }
