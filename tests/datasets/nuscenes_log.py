"""A tiny data set with nuScenes tables, for tests: a vehicle drives past a car, straight ahead.

Four key frames 0.5 s apart, pictures and sweeps every 0.25 s, two cameras of 64x48 px, a LiDAR of
32 lasers and 40 columns that sees the road and returns from 20 m in other directions. Everything
has a closed form.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

START_US = 1_532_402_927_647_951
N_KEY_FRAMES = 4
N_TICKS = 2 * N_KEY_FRAMES - 1
PERIOD_S = 0.25
SPEED_M_S = 15.0
YAW_RAD = -1.9
START_M = np.array([411.0, 1180.0, 0.0])
"""World position of the ego vehicle at the first key frame."""
WIDTH_PX, HEIGHT_PX = 64, 48
FOCAL_PX, CENTRE_PX = 50.0, (31.0, 23.0)
COLUMNS, LASERS = 40, 32
REACH_M = 20.0
"""Distance of returns that are not on the road."""
TURN_S = 0.05
LOCATION = "singapore-onenorth"
CAMERA_OFFSET_S = {"CAM_FRONT": -0.035, "CAM_BACK": -0.01}
LIDAR_M = np.array([0.94, 0.0, 1.84])
CAMERA_M = {"CAM_FRONT": np.array([1.7, 0.0, 1.5]), "CAM_BACK": np.array([0.0, 0.1, 1.6])}
# Axes of the sensors in frame ego, as columns. Cameras look forward and backward; the LiDAR's x is
# right and its y is forward.
EGO_FROM = {
    "CAM_FRONT": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "CAM_BACK": np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "LIDAR_TOP": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
QUATERNION = {
    "CAM_FRONT": [0.5, -0.5, 0.5, -0.5],
    "CAM_BACK": [0.5, -0.5, -0.5, 0.5],
    "LIDAR_TOP": [0.5**0.5, 0.0, 0.0, -(0.5**0.5)],
}
CAR_SPEED_M_S = 10.0
CAR_SIZE_WLH = [1.8, 4.2, 1.5]


@dataclass(frozen=True)
class Layout:
    """Names of folders, and what the variants of the format have."""

    tables: str = "v1.0-mini"
    lidar: str = "LIDAR_TOP"
    is_merged: bool = False
    geocoordinates: bool = False
    distortion: tuple[float, ...] = ()


NUSCENES = Layout()
T4 = Layout("annotation", "LIDAR_CONCAT", True, True, (-0.2, 0.05, 0.0, 0.0, 0.0))
LYFT = Layout("data")


def rotation(yaw_rad: float) -> np.ndarray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def ego_m(seconds: np.ndarray | float) -> np.ndarray:
    """World position of the ego vehicle at times after the first key frame."""
    ahead = SPEED_M_S * np.asarray(seconds, dtype=np.float64)
    return START_M + ahead[..., None] * rotation(YAW_RAD)[:, 0]


def car_m(seconds: float) -> np.ndarray:
    """World position of the moving car: 12 m ahead of the ego's start, in the next lane."""
    ahead = np.array([12.0 + CAR_SPEED_M_S * seconds, 3.0, 0.75])
    return START_M + rotation(YAW_RAD) @ ahead


def tick_s(tick: int) -> float:
    return tick * PERIOD_S


def directions() -> np.ndarray:
    """Unit vectors of all beams of a turn in the sensor's frame: clockwise from -x."""
    azimuth = np.pi - 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    elevation = np.radians(np.linspace(-30.0, 10.0, LASERS))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)


def beam_times_s(stamp_s: float) -> np.ndarray:
    """Time of each beam of the sweep with a stamp."""
    return stamp_s - TURN_S * (1 - np.repeat(np.arange(COLUMNS), LASERS) / COLUMNS)


def returns_world(stamp_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns and the sensor's positions in frame world, at the beams' own times."""
    axes = rotation(YAW_RAD) @ EGO_FROM["LIDAR_TOP"]
    origins = ego_m(beam_times_s(stamp_s)) + rotation(YAW_RAD) @ LIDAR_M
    rays = directions() @ axes.T
    down = np.where(rays[:, 2] < 0, -origins[:, 2] / np.minimum(rays[:, 2], -1e-9), np.inf)
    distance_m = np.minimum(REACH_M, down)
    return origins + distance_m[:, None] * rays, origins


def sweep_bytes(stamp_s: float, layout: Layout = NUSCENES) -> bytes:
    """A point file: returns in the sensor's frame at the stamp."""
    points, _ = returns_world(stamp_s)
    in_ego = (points - ego_m(stamp_s)) @ rotation(YAW_RAD)
    stored = np.zeros((len(points), 5), np.float32)
    if layout.is_merged:
        stored[:, :3], stored[:, 4] = in_ego, -1.0
    else:
        stored[:, :3] = (in_ego - LIDAR_M) @ EGO_FROM["LIDAR_TOP"]
        stored[:, 4] = np.arange(len(points)) % LASERS
        # Missing returns are at zero range.
        stored[5, :3] = 0.0
    stored[:, 3] = 51.0
    return stored.tobytes()


def car_scan_s(stamp_s: float) -> float:
    """Time at which the LiDAR scans the car in the turn with a stamp, by fixed-point iteration."""
    time_s = stamp_s
    for _ in range(20):
        in_ego = (car_m(time_s) - ego_m(stamp_s)) @ rotation(YAW_RAD)
        x, y, _ = (in_ego - LIDAR_M) @ EGO_FROM["LIDAR_TOP"]
        phase = ((np.pi - np.arctan2(y, x)) / (2 * np.pi)) % 1.0
        time_s = stamp_s - TURN_S * (1 - phase)
    return float(time_s)


def write_data_set(root: Path, layout: Layout = NUSCENES, scenes: int = 1) -> Path:
    """Write the data set and return its folder; further scenes have tables only."""
    rng = np.random.default_rng(1)
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in _TABLES}
    for channel in (*CAMERA_M, layout.lidar):
        modality = "camera" if channel in CAMERA_M else "lidar"
        row = {"token": f"sensor-{channel}", "channel": channel, "modality": modality}
        tables["sensor"].append(row)
    tables["category"] = [{"token": "cat-car", "name": "vehicle.car"}]
    tables["attribute"] = [
        {"token": "att-moving", "name": "vehicle.moving"},
        {"token": "att-parked", "name": "vehicle.parked"},
    ]
    for number in range(scenes):
        _add_scene(tables, number, layout)
    for name, rows in tables.items():
        write_table(root / layout.tables / f"{name}.json", rows)
    for row in tables["sample_data"]:
        path = root / row["filename"]
        if not row["token"].startswith("0-"):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".bin":
            path.write_bytes(sweep_bytes((row["timestamp"] - START_US) * 1e-6, layout))
        else:
            picture = rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
            Image.fromarray(picture).save(path, quality=90)
    return root


def write_table(path: Path, rows: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=0), encoding="utf-8")


_TABLES = (
    "scene", "log", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor",
    "sample_annotation", "instance", "category", "attribute",
)  # fmt: skip


def _add_scene(tables: dict[str, list[dict[str, Any]]], n: int, layout: Layout) -> None:
    tables["scene"].append(
        {"token": f"{n}-token", "name": f"scene-{61 + n:04d}", "log_token": f"{n}-log"}
    )
    location = "" if layout.is_merged else LOCATION
    tables["log"].append({"token": f"{n}-log", "location": location})
    for channel in (*CAMERA_M, layout.lidar):
        tables["calibrated_sensor"].append(_calibration(n, channel, layout))
    tables["instance"] += [
        {"token": f"{n}-driven", "category_token": "cat-car"},
        {"token": f"{n}-parked", "category_token": "cat-car"},
    ]
    for key in range(N_KEY_FRAMES):
        time_us = START_US + round(tick_s(2 * key) * 1e6)
        row = {"token": f"{n}-sample-{key}", "timestamp": time_us, "scene_token": f"{n}-token"}
        tables["sample"].append(row)
        tables["sample_annotation"] += _annotations(n, key, layout)
    for tick in range(N_TICKS):
        for channel in (*CAMERA_M, layout.lidar):
            data, pose = _data(n, tick, channel, layout)
            tables["sample_data"].append(data)
            tables["ego_pose"].append(pose)


def _calibration(n: int, channel: str, layout: Layout) -> dict[str, Any]:
    is_camera = channel in CAMERA_M
    (cx, cy), f = CENTRE_PX, FOCAL_PX
    is_ego = layout.is_merged and not is_camera
    translation = CAMERA_M[channel] if is_camera else LIDAR_M
    return {
        "token": f"{n}-calibration-{channel}",
        "sensor_token": f"sensor-{channel}",
        "translation": [0.0, 0.0, 0.0] if is_ego else translation.tolist(),
        "rotation": [1.0, 0.0, 0.0, 0.0] if is_ego else QUATERNION[channel],
        "camera_intrinsic": [[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]] if is_camera else [],
        **({"camera_distortion": list(layout.distortion)} if is_camera else {}),
    }


def _data(n: int, tick: int, channel: str, layout: Layout) -> tuple[dict[str, Any], dict[str, Any]]:
    time_s = tick_s(tick) + CAMERA_OFFSET_S.get(channel, 0.0)
    time_us = START_US + round(time_s * 1e6)
    kind = "samples" if tick % 2 == 0 else "sweeps"
    folder = "data" if layout.is_merged else kind
    ending = "jpg" if channel in CAMERA_M else "pcd.bin"
    token = f"{n}-{channel}-{tick}"
    data = {
        "token": token,
        "sample_token": f"{n}-sample-{(tick + 1) // 2}",
        "ego_pose_token": token,
        "calibrated_sensor_token": f"{n}-calibration-{channel}",
        "timestamp": time_us,
        "is_key_frame": tick % 2 == 0,
        "filename": f"{folder}/{channel}/{n}__{channel}__{time_us}.{ending}",
    }
    pose: dict[str, Any] = {
        "token": token,
        "timestamp": time_us,
        "translation": ego_m(time_s).tolist(),
        "rotation": [np.cos(YAW_RAD / 2), 0.0, 0.0, np.sin(YAW_RAD / 2)],
    }
    if layout.geocoordinates:
        # One degree of latitude and of longitude at the equator, in metres.
        x, y, _ = ego_m(time_s).tolist()
        pose["geocoordinate"] = [y / 110_574.0, x / 111_320.0, 5.0]
    return data, pose


def _annotations(n: int, key: int, layout: Layout) -> list[dict[str, Any]]:
    stamp_s = tick_s(2 * key)
    driven = car_m(stamp_s if layout.is_merged else car_scan_s(stamp_s))
    parked = START_M + rotation(YAW_RAD) @ np.array([15.0, -4.0, 0.8])
    return [
        {
            "token": f"{n}-{name}-{key}",
            "sample_token": f"{n}-sample-{key}",
            "instance_token": f"{n}-{name}",
            "attribute_tokens": [attribute],
            "translation": centre.tolist(),
            "size": CAR_SIZE_WLH,
            "rotation": [np.cos(YAW_RAD / 2), 0.0, 0.0, np.sin(YAW_RAD / 2)],
            "num_lidar_pts": 10,
        }
        for name, attribute, centre in (
            ("driven", "att-moving", driven),
            ("parked", "att-parked", parked),
        )
    ]
