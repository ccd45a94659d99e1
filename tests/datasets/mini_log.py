"""A tiny, valid log in PandaSet's layout, for tests: a car drives east past two boxes.

Three frames, two cameras of 64x36 px, three sweeps of 400 points. World is ENU turned by
`WORLD_YAW_DEG`; the ego drives along world +x at `SPEED_M_S`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

START_S = 1_600_000_000.0
PERIOD_S = 0.1
SPEED_M_S = 30.0
WORLD_YAW_DEG = 20.0
LATITUDE_DEG, LONGITUDE_DEG = 48.0, 11.0
WIDTH_PX, HEIGHT_PX = 64, 36
N_FRAMES = 3
CAMERAS = ("back_camera", "front_camera")
EGO_BELOW_LIDAR_M = 2.2

CALIBRATION = """\
front_camera:
  extrinsic:
    transform:
      rotation: {w: 0.0, x: 0.0, y: 0.70710678118654757,
        z: -0.70710678118654757}
      translation: {x: 0.0, y: 0.0, z: -0.5}
  readout_s: 0.0
main_pandar64:
  extrinsic:
    transform:
      rotation: {w: 1.0, x: 0.0, y: 0.0, z: 0.0}
      translation: {x: 0.0, y: 0.0, z: 0.0}
front_gt:
  extrinsic:
    transform:
      rotation: {w: 0.0, x: 0.0, y: 0.0, z: 1.0}
      translation: {x: 0.0, y: -0.6, z: -0.3}
"""

# x right, y down, z forward for a camera that looks along world +x, and along -x.
_WORLD_FROM_FRONT_WXYZ = (0.5, -0.5, 0.5, -0.5)
_WORLD_FROM_BACK_WXYZ = (0.5, -0.5, -0.5, 0.5)


def write_mini_log(folder: Path, n_frames: int = N_FRAMES, speed_m_s: float = SPEED_M_S) -> Path:
    """Write the log and return its folder."""
    times = START_S + PERIOD_S * np.arange(n_frames)
    rng = np.random.default_rng(1)
    for name in CAMERAS:
        _write_camera(folder / "camera" / name, name, times, speed_m_s, rng)
    for i, time_s in enumerate(times):
        write_frame(folder / "lidar" / f"{i:02d}.pkl.gz", sweep_columns(float(time_s), speed_m_s))
        write_frame(
            folder / "annotations" / "cuboids" / f"{i:02d}.pkl.gz",
            cuboid_columns(float(time_s), speed_m_s),
        )
        write_frame(
            folder / "annotations" / "semseg" / f"{i:02d}.pkl.gz",
            {"class": np.full(400, 7, dtype=np.int64)},
        )
    write_json(folder / "lidar" / "timestamps.json", times.tolist())
    write_json(folder / "meta" / "timestamps.json", times.tolist())
    write_json(folder / "meta" / "gps.json", [_gps(float(t), speed_m_s) for t in times])
    (folder / "static_extrinsic_calibration.yaml").write_text(CALIBRATION, encoding="utf-8")
    return folder


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")


def write_frame(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(columns).to_pickle(path)


def ego_x_m(time_s: float, speed_m_s: float = SPEED_M_S) -> float:
    return speed_m_s * (time_s - START_S)


def sweep_columns(time_s: float, speed_m_s: float = SPEED_M_S) -> dict[str, Any]:
    """A ring of points on the road; the roof LiDAR turns once in the 0.1 s before `time_s`,
    clockwise from behind."""
    phase = (np.arange(400) + 0.5) / 400
    azimuth = np.pi - 2 * np.pi * phase
    times = time_s - PERIOD_S * (1 - phase)
    x = 8.0 * np.cos(azimuth) + speed_m_s * (times - START_S)
    is_front = (np.arange(400) % 10 == 0) & (np.cos(azimuth) > 0.5)
    return {
        "x": x,
        "y": 8.0 * np.sin(azimuth),
        "z": np.zeros(400),
        "i": np.full(400, 51.0),
        "t": times,
        "d": is_front.astype(np.int64),
    }


def cuboid_columns(time_s: float, speed_m_s: float = SPEED_M_S) -> dict[str, Any]:
    """A parked car, and a car ahead of the ego at its speed, labelled once for each LiDAR."""
    x = ego_x_m(time_s, speed_m_s)
    return {
        "uuid": ["parked", "moving-a", "moving-b"],
        "label": ["Car", "Car", "Car"],
        "yaw": [0.0, -np.pi / 2, -np.pi / 2],
        "stationary": [True, False, False],
        "camera_used": [-1, -1, -1],
        "position.x": [10.0, x + 20.0, x + 20.1],
        "position.y": [6.0, 0.0, 0.0],
        "position.z": [0.8, 0.8, 0.8],
        "dimensions.x": [1.9, 1.8, 1.8],
        "dimensions.y": [4.5, 4.2, 4.2],
        "dimensions.z": [1.6, 1.5, 1.5],
        "attributes.object_motion": ["Parked", "Moving", "Moving"],
        "cuboids.sibling_id": ["-", "moving-b", "moving-a"],
        "cuboids.sensor_id": [-1, 0, 1],
    }


def _write_camera(
    folder: Path, name: str, times: np.ndarray, speed_m_s: float, rng: np.random.Generator
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    is_front = name == "front_camera"
    camera_times = times - (PERIOD_S / 2 if is_front else PERIOD_S * 0.99)
    w, x, y, z = _WORLD_FROM_FRONT_WXYZ if is_front else _WORLD_FROM_BACK_WXYZ
    heading = {"w": w, "x": x, "y": y, "z": z}
    poses = [
        {
            "position": {
                "x": ego_x_m(float(t), speed_m_s) + (0.5 if is_front else -0.5),
                "y": 0.0,
                "z": EGO_BELOW_LIDAR_M,
            },
            "heading": heading,
        }
        for t in camera_times
    ]
    write_json(folder / "poses.json", poses)
    write_json(folder / "timestamps.json", camera_times.tolist())
    write_json(folder / "intrinsics.json", {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 17.5})
    for i in range(len(times)):
        picture = rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
        Image.fromarray(picture).save(folder / f"{i:02d}.jpg", quality=90)


def _gps(time_s: float, speed_m_s: float) -> dict[str, float]:
    yaw = np.radians(WORLD_YAW_DEG)
    x = ego_x_m(time_s, speed_m_s)
    metres_per_degree = 111_200.0
    return {
        "lat": LATITUDE_DEG + float(np.sin(yaw)) * x / metres_per_degree,
        "long": LONGITUDE_DEG
        + float(np.cos(yaw)) * x / (metres_per_degree * float(np.cos(np.radians(LATITUDE_DEG)))),
        "height": 500.0,
        "xvel": speed_m_s,
        "yvel": 0.0,
    }
