"""A tiny, valid log in Argoverse 2's layout, for tests: a car drives through Pittsburgh's frame.

Four sweeps of two LiDARs, three cameras, a parked car and a car ahead. The ego drives at
`SPEED_M_S` in the direction `HEADING_DEG`, counter-clockwise from grid east.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

LOG = "0a1b2c3d-0000-3000-8000-00000000cafe"
START_NS = 315_966_265_000_000_000
SPEED_M_S, OTHER_M_S = 15.0, 8.0
HEADING_DEG = 30.0
START_M = np.array([5172.5, 2419.25, 66.5])
AXLE_M = 0.32
"""Height of the data set's ego frame above the road."""
N_SWEEPS, SWEEP_NS, PICTURE_NS = 4, 100_000_000, 50_000_000
N_RETURNS = 720
UP_M, DOWN_M = np.array([1.35, 0.0, 1.64]), np.array([1.34, 0.0, 1.53])
CAMERA_M = {
    "ring_front_center": np.array([1.6, 0.0, 1.4]),
    "ring_rear_left": np.array([1.1, 0.1, 1.4]),
    "stereo_front_left": np.array([1.6, 0.25, 1.2]),
}
SIZE_PX = {
    "ring_front_center": (48, 64),
    "ring_rear_left": (64, 48),
    "stereo_front_left": (64, 48),
}
FOCAL_PX = 60.0
# Looking along +x and along -x: x right, y down, z forward.
_FORWARD_WXYZ, _BACKWARD_WXYZ = (0.5, -0.5, 0.5, -0.5), (0.5, -0.5, -0.5, 0.5)
PARKED_M, PARKED_LWH_M = np.array([12.0, 4.0, 0.4]), np.array([4.5, 1.9, 1.6])
"""Parked car: its centre in the data set's ego frame at START_NS, and its size."""
AHEAD_M, AHEAD_LWH_M = np.array([20.0, 0.1, 0.5]), np.array([4.2, 1.8, 1.5])
"""Car ahead of the ego: its centre in the ego frame of each sweep."""
SWEEP = f"sensors/lidar/{START_NS}.feather"
FRONT = "sensors/cameras/ring_front_center"
Columns = dict[str, Any]


def write_argoverse2_log(folder: Path) -> Path:
    """Write the log into a folder of its name, and return that folder."""
    log = folder / LOG
    write_table(log / "calibration/egovehicle_SE3_sensor.feather", mounting_columns())
    write_table(log / "calibration/intrinsics.feather", intrinsics_columns())
    write_table(log / "city_SE3_egovehicle.feather", pose_columns())
    write_table(log / "annotations.feather", box_columns())
    for i in range(N_SWEEPS):
        name = f"sensors/lidar/{START_NS + i * SWEEP_NS}.feather"
        write_table(log / name, sweep_columns())
    rng = np.random.default_rng(1)
    for name, (width, height) in SIZE_PX.items():
        shape = (height, width) if name.startswith("stereo") else (height, width, 3)
        for i in range(2 * N_SWEEPS):
            path = log / "sensors/cameras" / name / f"{picture_ns(name, i)}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(rng.integers(0, 255, shape, dtype=np.uint8)).save(path)
    archive = f"map/log_map_archive_{LOG}____PIT_city_47896.json"
    (log / "map").mkdir()
    (log / archive).write_text("{}")
    return log


def write_table(path: Path, columns: Columns) -> None:
    import pyarrow as pa
    from pyarrow import feather

    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(path))


def picture_ns(name: str, number: int) -> int:
    """Times of pictures: each camera has its own."""
    return START_NS + number * PICTURE_NS + 3_000_000 * (1 + list(SIZE_PX).index(name))


def ego_m(time_ns: int | np.ndarray) -> np.ndarray:
    """Position of the rear axle at a time, in the city's frame."""
    way_m = np.asarray(SPEED_M_S * (time_ns - START_NS) * 1e-9)
    heading = np.radians(HEADING_DEG)
    return START_M + way_m[..., None] * np.array([np.cos(heading), np.sin(heading), 0.0])


def city_from_axle(points: np.ndarray, time_ns: int) -> np.ndarray:
    """Points of the data set's ego frame at a time, in the city's frame."""
    c, s = np.cos(np.radians(HEADING_DEG)), np.sin(np.radians(HEADING_DEG))
    return ego_m(time_ns) + points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def mounting_columns() -> Columns:
    names = [*CAMERA_M, "up_lidar", "down_lidar"]
    rotations = [_FORWARD_WXYZ, _BACKWARD_WXYZ, _FORWARD_WXYZ, (1.0, 0, 0, 0), (0.0, 1.0, 0, 0)]
    return {
        "sensor_name": names,
        **_columns(("qw", "qx", "qy", "qz"), np.array(rotations)),
        **_columns(("tx_m", "ty_m", "tz_m"), np.stack([*CAMERA_M.values(), UP_M, DOWN_M])),
    }


def intrinsics_columns() -> Columns:
    """Distortion coefficients are those of the lens; the pictures have none."""
    width, height = np.array(list(SIZE_PX.values())).T
    n = len(SIZE_PX)
    return {
        "sensor_name": list(SIZE_PX),
        "fx_px": np.full(n, FOCAL_PX),
        "fy_px": np.full(n, FOCAL_PX),
        "cx_px": width / 2 - 0.5,
        "cy_px": height / 2 - 0.5,
        **{k: np.full(n, value) for k, value in (("k1", -0.24), ("k2", -0.2), ("k3", 0.3))},
        "height_px": height.astype(np.uint16),
        "width_px": width.astype(np.uint16),
    }


def pose_columns() -> Columns:
    """Poses every 10 ms, and a nanosecond after each third one, as in the data set."""
    times = START_NS + np.arange(-2, 60) * 10_000_000
    times = np.sort(np.concatenate([times, times[::3] + 1]))
    half = np.radians(HEADING_DEG) / 2
    rotation = np.tile([np.cos(half), 0.0, 0.0, np.sin(half)], (len(times), 1))
    return {
        "timestamp_ns": times,
        **_columns(("qw", "qx", "qy", "qz"), rotation),
        **_columns(("tx_m", "ty_m", "tz_m"), ego_m(times)),
    }


def scan_s(azimuth: np.ndarray, is_down: np.ndarray) -> np.ndarray:
    """Time at which a LiDAR scans an azimuth: clockwise from the left, half a turn apart."""
    turn = (np.pi / 2 - azimuth) / (2 * np.pi) + 0.5 * is_down
    return 0.00265 + 0.1 * (turn % 1.0)


def sweep_columns() -> Columns:
    """A ring of returns around the LiDARs, in the data set's ego frame of the sweep's stamp."""
    azimuth = (np.arange(N_RETURNS) // 2 + 0.5) / (N_RETURNS // 2) * 2 * np.pi
    is_down = np.arange(N_RETURNS) % 2 == 1
    xyz = np.stack([1.35 + 8 * np.cos(azimuth), 8 * np.sin(azimuth), 0 * azimuth - AXLE_M], axis=1)
    return {
        **_columns("xyz", xyz.astype(np.float16)),
        "intensity": np.full(N_RETURNS, 51, dtype=np.uint8),
        "laser_number": (7 + 32 * is_down).astype(np.uint8),
        "offset_ns": np.round(scan_s(azimuth, is_down) * 1e9).astype(np.int32),
    }


def box_columns() -> Columns:
    """Boxes of each sweep in its ego frame: the parked car moves backward by what the ego drives.

    The car ahead keeps its distance to the ego's pose at the time stamps.
    """
    stamps = START_NS + np.arange(N_SWEEPS) * SWEEP_NS
    parked = PARKED_M - (stamps - START_NS)[:, None] * 1e-9 * np.array([SPEED_M_S, 0.0, 0.0])
    centres = np.concatenate([parked, np.tile(AHEAD_M, (N_SWEEPS, 1))])
    sizes = np.repeat(np.stack([PARKED_LWH_M, AHEAD_LWH_M]), N_SWEEPS, axis=0)
    return {
        "timestamp_ns": np.tile(stamps, 2),
        "track_uuid": ["parked"] * N_SWEEPS + ["ahead"] * N_SWEEPS,
        "category": ["REGULAR_VEHICLE"] * N_SWEEPS + ["BOX_TRUCK"] * N_SWEEPS,
        **_columns(("length_m", "width_m", "height_m"), sizes),
        **_columns(("qw", "qx", "qy", "qz"), np.tile([1.0, 0, 0, 0], (2 * N_SWEEPS, 1))),
        **_columns(("tx_m", "ty_m", "tz_m"), centres),
        "num_interior_pts": np.zeros(2 * N_SWEEPS, dtype=np.int64),
    }


def _columns(names: Any, values: np.ndarray) -> Columns:
    return {name: values[:, i].copy() for i, name in enumerate(names)}
