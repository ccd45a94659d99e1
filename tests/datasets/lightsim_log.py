"""A tiny lightsim-log/1 folder with known truth: a car on a circle passes posts and another car.

Three cameras of 64x48 px, four frames, one LiDAR that turns while the car moves at 15 m/s. The
world is far from its origin, as in UTM, and turned by `AZIMUTH_DEG`.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

START_NS = 1_600_000_000_000_000_000
"""12:26:40 UTC in September."""
UTC_MINUS_LOG_NS = -2 * 3600 * 10**9
SPEED_M_S, YAW_RATE = 15.0, 0.2
RADIUS_M = SPEED_M_S / YAW_RATE
OFFSET_M = np.array([690_000.25, 5_334_000.5, 520.0])
AZIMUTH_DEG = 70.0
LATITUDE_DEG, LONGITUDE_DEG = 48.0, 11.0
WIDTH_PX, HEIGHT_PX = 64, 48
N_FRAMES, PERIOD_NS = 4, 100_000_000
READOUT_S = 0.02
N_POINTS = 500
CAR_SIZE = (4.5, 1.9, 1.6)

# x right, y down, z forward, in frame ego (x forward, y left, z up).
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def transform(rotation: np.ndarray, translation: Sequence[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


EGO_FROM_FRONT = transform(_FORWARD, (1.5, 0.2, 1.6))
EGO_FROM_LEFT = transform(_LEFT, (0.5, 0.9, 1.5))
EGO_FROM_LIDAR = transform(Rotation.from_euler("z", 0.3).as_matrix(), (0.9, 0.0, 1.9))
CAMERAS: dict[str, dict[str, Any]] = {
    # Stamped at the start of the readout; counted from the centre of the first pixel.
    "front": {"model": "pinhole", "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5,
              "first_pixel_centre": 0.0, "ego_from_camera": EGO_FROM_FRONT.tolist(),
              "readout_s": READOUT_S, "readout": "top_to_bottom", "time": "start"},
    "left": {"model": "brown", "fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0,
             "distortion": [-0.1, 0.01, 0.001, -0.001], "first_pixel_centre": 0.5,
             "ego_from_camera": EGO_FROM_LEFT.tolist(), "readout_s": READOUT_S,
             "readout": "left_to_right", "time": "middle"},
    "fisheye": {"model": "kannala_brandt", "fx": 30.0, "fy": 30.0, "cx": 32.0, "cy": 24.0,
                "distortion": [0.01, 0.0, 0.0, 0.0], "first_pixel_centre": 0.5,
                "ego_from_camera": EGO_FROM_FRONT.tolist()},
}  # fmt: skip
PHASES_NS = {"front": 0, "left": 31_000_000, "fisheye": -20_000_000}
"""Cameras are not synchronised."""


def seconds(time_ns: int | np.ndarray) -> np.ndarray:
    return (np.asarray(time_ns) - START_NS) * 1e-9


def world_from_ego(time_ns: int) -> np.ndarray:
    """Closed form: a circle, level."""
    angle = YAW_RATE * float(seconds(time_ns))
    place = RADIUS_M * np.array([np.sin(angle), 1.0 - np.cos(angle), 0.0])
    return transform(Rotation.from_euler("z", angle).as_matrix(), tuple(place + OFFSET_M))


def world_from_car(time_ns: int) -> np.ndarray:
    """The other car drives straight at 10 m/s, to the left of the circle's tangent."""
    place = np.array([12.0 + 10.0 * float(seconds(time_ns)), 6.0, 0.8])
    return transform(np.eye(3), tuple(place + OFFSET_M))


def posts() -> np.ndarray:
    """Points on a wall of posts around the start, in the world."""
    azimuth = 2 * np.pi * (np.arange(N_POINTS) + 0.5) / N_POINTS
    height = 0.5 + 2.5 * (np.arange(N_POINTS) % 5) / 4
    around = np.stack([20 * np.cos(azimuth), 20 * np.sin(azimuth), height], axis=1)
    return around + OFFSET_M


def sweep_columns(time_ns: int) -> dict[str, np.ndarray]:
    """One turn that ends at `time_ns`: each point in the LiDAR's frame at its own time."""
    offset_s = -0.1 * (1.0 - (np.arange(N_POINTS) + 0.5) / N_POINTS)
    xyz = np.empty((N_POINTS, 3))
    for i, point in enumerate(posts()):
        pose = world_from_ego(time_ns + round(offset_s[i] * 1e9)) @ EGO_FROM_LIDAR
        xyz[i] = pose[:3, :3].T @ (point - pose[:3, 3])
    return {
        "xyz": xyz.astype(np.float32),
        "intensity": np.full(N_POINTS, 51, np.uint8),
        "time_offset_s": offset_s.astype(np.float32),
        "ring": (np.arange(N_POINTS) % 5).astype(np.int16),
        "class": np.full(N_POINTS, 7, np.int16),
    }


def picture_times(name: str) -> list[int]:
    return [START_NS + PHASES_NS[name] + i * PERIOD_NS for i in range(N_FRAMES)]


def sweep_times() -> list[int]:
    return [START_NS + 5_000_000 + i * PERIOD_NS for i in range(N_FRAMES)]


def write_lightsim_mini(folder: Path) -> Path:
    """Write the log and return its folder."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(2)
    for name in CAMERAS:
        (folder / "images" / name).mkdir(parents=True)
        for i, time_ns in enumerate(picture_times(name)):
            suffix = "png" if i % 2 else "jpg"
            picture = rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
            Image.fromarray(picture).save(folder / "images" / name / f"{time_ns}.{suffix}")
    (folder / "sweeps" / "top").mkdir(parents=True)
    for time_ns in sweep_times():
        columns: dict[str, Any] = sweep_columns(time_ns)
        np.savez(folder / "sweeps" / "top" / f"{time_ns}.npz", **columns)
    write_header(folder, header())
    # Poses at 50 Hz, and one of another sensor in between, twice.
    times = [START_NS + i * 20_000_000 for i in range(-10, 26)] + [START_NS + 7_000_000] * 2
    write_table(folder / "ego.csv", POSE, ([t, *row(world_from_ego(t))] for t in times))
    write_table(folder / "boxes.csv", BOXES, box_rows())
    write_table(folder / "gps.csv", "time_ns latitude longitude", gps_rows())
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    mask[-6:] = 255
    (folder / "masks").mkdir()
    Image.fromarray(mask).save(folder / "masks" / "front.png")
    return folder


POSE = "time_ns x y z qw qx qy qz"
BOXES = "time_ns track label x y z qw qx qy qz length width height"


def header() -> dict[str, Any]:
    cameras = {n: {**camera, "size_px": [WIDTH_PX, HEIGHT_PX]} for n, camera in CAMERAS.items()}
    lidar = {"ego_from_lidar": EGO_FROM_LIDAR.tolist(), "points": "raw, at their own times",
             "time": "end", "intensity_max": 255,
             "bin_columns": ["x", "y", "z", "intensity", "time_offset_s"]}  # fmt: skip
    return {"format": "lightsim-log/1", "clock": "local+02:00", "place": None,
            "world_x_azimuth_deg": None, "point_classes": {"7": "Wall"},
            "licence": "CC0-1.0", "cameras": cameras, "lidars": {"top": lidar}}  # fmt: skip


def write_header(folder: Path, value: Any) -> None:
    (folder / "log.json").write_text(json.dumps(value))


def row(matrix: np.ndarray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return [*matrix[:3, 3].tolist(), w, x, y, z]


def box_rows() -> list[list[object]]:
    rows: list[list[object]] = []
    for time_ns in sweep_times():
        rows.append([time_ns, "car-1", "Car", *row(world_from_car(time_ns)), *CAR_SIZE])
        parked = transform(np.eye(3), tuple(OFFSET_M + [5.0, -6.0, 0.9]))
        rows.append([time_ns, "kiosk", "Kiosk", *row(parked), 2.0, 2.0, 1.8])
    return rows


def gps_rows() -> Iterable[list[object]]:
    """The path on the Earth; east is azimuth 90, and world +x has `AZIMUTH_DEG`."""
    turn = np.radians(90.0 - AZIMUTH_DEG)
    for i in range(-5, 11):
        time_ns = START_NS + i * 50_000_000
        x, y, _ = world_from_ego(time_ns)[:3, 3] - OFFSET_M
        east, north = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
        yield [
            time_ns,
            LATITUDE_DEG + north / 111_200.0,
            LONGITUDE_DEG + east / (111_414.0 * np.cos(np.radians(LATITUDE_DEG))),
        ]


def write_table(path: Path, columns: str, rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns.split(), *rows])
