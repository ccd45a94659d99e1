"""Conversion of a synthetic street to nuScenes' layout, with the properties of nuScenes' sensors.

Pictures are those of an existing street (10 Hz, nuScenes has 12). The differences from PandaSet are
simulated: a LiDAR with 32 beams at 20 Hz whose points are motion compensated and have no times,
planar poses with noise, and boxes at 2 Hz (Caesar et al. 2020, doi:10.1109/CVPR42600.2020.01164).
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

from lightsim.core.frames import RigidTransform, quaternion_from_matrix
from lightsim.progress import Progress
from lightsim_lab.synthetic.lidar import LidarSensor, scan
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import SWEEP_S, MountedCamera, mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street
from lightsim_lab.synthetic.truth import stem_of
from lightsim_lab.synthetic.writer import write_json

VERSION = "v1.0-mini"
HDL32E = LidarSensor(32, -30.67, 10.67, 70.0, 0.02, 0.015, 0.05, 1.84)
"""Velodyne HDL-32E on nuScenes' roof: beams, elevations, range and 20 Hz of its data sheet."""
# Columns per revolution in nuScenes' files.
_COLUMNS = 1084
# Standard deviation of the localisation along x and along y, in metres; nuScenes states errors of
# at most 10 cm.
_NOISE_M = 0.03
# Standard deviation of the yaw, in degrees. Chosen.
_NOISE_DEG = 0.05
# Time between samples of the noise, in seconds.
_NOISE_STEP_S = 0.05
# Correlation of the noise, in samples: a second.
_NOISE_SMOOTHING = 20
# Frames between key frames: 2 Hz of 10.
_KEY_STEP = 5
_CHANNEL_BY_CAMERA = {
    "front_camera": "CAM_FRONT",
    "front_left_camera": "CAM_FRONT_LEFT",
    "front_right_camera": "CAM_FRONT_RIGHT",
    "left_camera": "CAM_BACK_LEFT",
    "right_camera": "CAM_BACK_RIGHT",
    "back_camera": "CAM_BACK",
}
_CATEGORY = {"car": "vehicle.car", "pedestrian": "human.pedestrian.adult"}


@dataclass(frozen=True, eq=False)
class Localisation:
    """Planar, noisy poses of the ego vehicle; the recorded world frame is ENU, as in nuScenes."""

    street: Street
    config: StreetConfig
    noise: Float64[np.ndarray, "n 3"]
    """Errors of x, y (metres) and yaw (radians), every 0.05 s from a second before the start."""

    @staticmethod
    def of(street: Street, config: StreetConfig) -> Localisation:
        """Return poses with the noise of the street's seed."""
        rng = np.random.default_rng([street.plan.seed, 21])
        count = int((config.frame_count * SWEEP_S + 3.0) / _NOISE_STEP_S)
        white = rng.standard_normal((count, 3))
        smooth = gaussian_filter1d(white, _NOISE_SMOOTHING, axis=0)
        smooth /= smooth.std(axis=0)
        return Localisation(
            street, config, smooth * np.array([_NOISE_M, _NOISE_M, np.radians(_NOISE_DEG)])
        )

    def true(self, time_s: float) -> RigidTransform:
        """Return the true `world_from_ego`."""
        return world_from_ego(self.street.plan, self.config, time_s)

    def recorded(self, time_s: float) -> RigidTransform:
        """Return the recorded pose, with x east and y north: z, pitch and roll are 0."""
        true = self.street.plan.enu_from_world @ self.true(time_s)
        at = np.arange(len(self.noise)) * _NOISE_STEP_S - 1.0
        dx, dy, turn = (float(np.interp(time_s, at, column)) for column in self.noise.T)
        x, y, _ = true.translation_m.tolist()
        return RigidTransform.from_yaw(
            "world", "ego", true.yaw_rad + turn, np.array([x + dx, y + dy, 0.0])
        )


@dataclass(eq=False)
class _Tables:
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def add(self, table: str, key: str, **values: Any) -> str:
        """Append a row and return its token, which is made of the table and the key."""
        token = _token(table, key)
        self.rows.setdefault(table, []).append({"token": token, **values})
        return token

    def chain(self, table: str, tokens: Sequence[str]) -> None:
        """Set the fields prev and next of rows in order of time."""
        by_token = {row["token"]: row for row in self.rows[table]}
        for before, token, after in zip(["", *tokens[:-1]], tokens, [*tokens[1:], ""], strict=True):
            by_token[token] |= {"prev": before, "next": after}


def record_as_nuscenes(
    street: Street, config: StreetConfig, log: Path, out: Path, progress: Progress
) -> str:
    """Write OUT with samples/, sweeps/, maps/ and tables; return the scene's name.

    A nuScenes log derives its location from one of four maps. The location of a street differs and
    must be given to the reader with --place.

    Args:
        log: folder of the street's log in PandaSet's layout, whose pictures are copied.
    """
    scene = f"scene-{street.plan.seed:04d}"
    tables, local = _Tables(), Localisation.of(street, config)
    keys = range(0, config.frame_count, _KEY_STEP)
    log_token = tables.add(
        "log", scene, logfile=scene, vehicle="synthetic", date_captured="2019-01-01",
        location="singapore-onenorth",
    )  # fmt: skip
    samples = [
        tables.add("sample", f"{scene} {k}", timestamp=_us(street, SWEEP_S * k),
                   scene_token=_token("scene", scene))
        for k in keys
    ]  # fmt: skip
    tables.chain("sample", samples)
    tables.add(
        "scene", scene, log_token=log_token, nbr_samples=len(samples), name=scene, description="",
        first_sample_token=samples[0], last_sample_token=samples[-1],
    )  # fmt: skip
    for mounted in mount_cameras(street.plan, config):
        _add_camera(tables, local, mounted, samples, log, out)
    _add_lidar(tables, local, samples, out, progress)
    _add_boxes(tables, local, samples)
    (out / "maps").mkdir(parents=True, exist_ok=True)
    tables.add("map", scene, log_tokens=[log_token], category="semantic_prior", filename="")
    for table, rows in tables.rows.items():
        write_json(out / VERSION / f"{table}.json", rows)
    return scene


def _add_camera(
    tables: _Tables,
    local: Localisation,
    mounted: MountedCamera,
    samples: Sequence[str],
    log: Path,
    out: Path,
) -> None:
    camera = mounted.camera
    channel = _CHANNEL_BY_CAMERA[camera.name]
    # The devkit's pixel coordinates have the first pixel's centre at 0.
    matrix = [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
    calibrated = _calibrate(tables, channel, "camera", mounted.ego_from_camera, matrix)
    tokens: list[str] = []
    for k in range(local.config.frame_count):
        time_s = SWEEP_S * k + mounted.time_offset_s
        is_key = k % _KEY_STEP == 0
        name = f"{'samples' if is_key else 'sweeps'}/{channel}/{channel}__{k:03d}.jpg"
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(log / "camera" / camera.name / f"{stem_of(k)}.jpg", out / name)
        token = _add_data(tables, local, (channel, k), time_s, samples, name)
        tables.rows["sample_data"][-1] |= {
            "calibrated_sensor_token": calibrated, "is_key_frame": is_key, "fileformat": "jpg",
            "width": camera.width_px, "height": camera.height_px,
        }  # fmt: skip
        tokens.append(token)
    tables.chain("sample_data", tokens)


def _add_lidar(
    tables: _Tables, local: Localisation, samples: Sequence[str], out: Path, progress: Progress
) -> None:
    """Write a sweep every 0.05 s: all columns in order, rings within a column, zeros where there is
    no return, and points moved to the sensor's pose at the end of the sweep."""
    street, config = local.street, local.config
    mount = RigidTransform.from_rotation(
        "ego", "lidar", np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([0.0, 0.0, HDL32E.height_m]),
    )  # fmt: skip
    calibrated = _calibrate(tables, "LIDAR_TOP", "lidar", mount, [])
    settings = StreetConfig(
        azimuth_count=_COLUMNS, ego_speed_m_s=config.ego_speed_m_s, sway=config.sway
    )
    tokens: list[str] = []
    count = 2 * config.frame_count - 1
    for i in progress.track(range(count), "LiDAR of nuScenes", count):
        time_s = i * HDL32E.sweep_s
        is_key = i % (2 * _KEY_STEP) == 0
        name = f"{'samples' if is_key else 'sweeps'}/LIDAR_TOP/LIDAR_TOP__{i:03d}.pcd.bin"
        path = out / name
        if not path.exists():
            rng = np.random.default_rng([street.plan.seed, 22, i])
            found = scan(street, settings, time_s, rng, HDL32E)
            at_end = local.true(time_s).inverse().apply(found.points_world)
            rows = np.zeros((_COLUMNS * HDL32E.beam_count, 5), dtype=np.float32)
            rows[:, 4] = np.tile(np.arange(HDL32E.beam_count), _COLUMNS)
            rows[found.firing, :3] = mount.inverse().apply(at_end)
            rows[found.firing, 3] = found.intensity
            path.parent.mkdir(parents=True, exist_ok=True)
            rows.tofile(path)
        tokens.append(_add_data(tables, local, ("LIDAR_TOP", i), time_s, samples, name))
        tables.rows["sample_data"][-1] |= {
            "calibrated_sensor_token": calibrated, "is_key_frame": is_key, "fileformat": "pcd",
            "width": 0, "height": 0,
        }  # fmt: skip
    tables.chain("sample_data", tokens)


def _add_boxes(tables: _Tables, local: Localisation, samples: Sequence[str]) -> None:
    """Add the boxes of each key frame, with their true poses relative to the recorded ego pose."""
    for name in sorted(set(_CATEGORY.values())):
        tables.add("category", name, name=name, description="")
    tables.add("attribute", "vehicle.moving", name="vehicle.moving", description="")
    tables.add("visibility", "4", level="v80-100", description="")
    for actor in local.street.participants:
        category = _token("category", _CATEGORY[str(actor.kind)])
        instance = _token("instance", actor.actor_id)
        tokens: list[str] = []
        for number, sample in enumerate(samples):
            time_s = SWEEP_S * _KEY_STEP * number
            true = local.street.plan.world_from_street @ actor.street_from_actor(time_s)
            pose = local.recorded(time_s) @ local.true(time_s).inverse() @ true
            length, width, height = actor.size_lwh_m
            tokens.append(tables.add(
                "sample_annotation", f"{actor.actor_id} {number}", sample_token=sample,
                instance_token=instance, visibility_token=_token("visibility", "4"),
                attribute_tokens=[_token("attribute", "vehicle.moving")]
                if actor.speed_m_s and actor.kind.is_vehicle else [],
                translation=pose.translation_m.tolist(), size=[width, length, height],
                rotation=quaternion_from_matrix(pose.rotation).tolist(), num_lidar_pts=1,
                num_radar_pts=0,
            ))  # fmt: skip
        tables.chain("sample_annotation", tokens)
        tables.add("instance", actor.actor_id, category_token=category, nbr_annotations=len(tokens),
                   first_annotation_token=tokens[0],
                   last_annotation_token=tokens[-1])  # fmt: skip


def _calibrate(
    tables: _Tables,
    channel: str,
    modality: str,
    ego_from_sensor: RigidTransform,
    intrinsic: list[list[float]],
) -> str:
    sensor = tables.add("sensor", channel, channel=channel, modality=modality)
    return tables.add(
        "calibrated_sensor", channel, sensor_token=sensor, camera_intrinsic=intrinsic,
        translation=ego_from_sensor.translation_m.tolist(),
        rotation=quaternion_from_matrix(ego_from_sensor.rotation).tolist(),
    )  # fmt: skip


def _add_data(
    tables: _Tables,
    local: Localisation,
    key: tuple[str, int],
    time_s: float,
    samples: Sequence[str],
    filename: str,
) -> str:
    pose = local.recorded(time_s)
    name, timestamp = f"{key[0]} {key[1]}", _us(local.street, time_s)
    ego = tables.add(
        "ego_pose", name, timestamp=timestamp, translation=pose.translation_m.tolist(),
        rotation=quaternion_from_matrix(pose.rotation).tolist(),
    )  # fmt: skip
    nearest = min(len(samples) - 1, max(0, round(time_s / (SWEEP_S * _KEY_STEP))))
    return tables.add(
        "sample_data", name, sample_token=samples[nearest], ego_pose_token=ego,
        timestamp=timestamp, filename=filename,
    )  # fmt: skip


def _us(street: Street, time_s: float) -> int:
    """Return the time stamp, microseconds since 1970."""
    return round(street.plan.start_ns / 1000 + time_s * 1e6)


def _token(table: str, key: str) -> str:
    return hashlib.blake2b(f"{table} {key}".encode(), digest_size=16).hexdigest()
