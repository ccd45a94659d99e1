"""A tiny scene in TRI's DGP format with known truth: a vehicle drives at 15 m/s past a wall.

Four frames; two pinhole cameras and a fisheye; one merged LiDAR whose frame is the vehicle's,
`ROAD_M` above the road; a moving and a parked car. World +x is east.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lightsim.core.frames import RigidTransform, quaternion_from_matrix

START = datetime(2019, 6, 27, 14, 30, 25, 2790, tzinfo=UTC)
START_NS = round(START.timestamp() * 1e6) * 1000
PERIOD_US, N_FRAMES = 100_000, 4
CAMERA_LAG_US = 9_000
"""Cameras fire before the LiDAR's stamp."""
SPEED_M_S, YAW_DEG = 15.0, 30.0
ORIGIN_M = np.array([552_000.0, 4_180_000.0, 20.0])
ROAD_M = -0.4
"""Height of the road in frame `vehicle`."""
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 64, 48, 40.0
# Camera axes (right, down, forward) in frame `vehicle`, by azimuth to the left.
CAMERA_YAW_DEG = {"CAMERA_01": 0.0, "CAMERA_05": 60.0, "CAMERA_09": 180.0}
FISHEYE = "CAMERA_05"
FISHEYE_K = (0.05, -0.01, 0.002, -0.0005)
CAMERA_M = np.array([1.4, 0.3, 1.2])
SIZE_LWH_M = (4.5, 1.9, 1.6)
PARKED_M = (20.0, -5.0, ROAD_M + 0.8)
"""Centre of the parked car in the vehicle's first frame."""
AHEAD_M, CAR_SPEED_M_S = 25.0, 12.0
LIDAR = "LIDAR"


def times_us(lag_us: int = 0) -> np.ndarray:
    """Microseconds from the first cloud to each frame."""
    return np.arange(N_FRAMES) * PERIOD_US - lag_us


def world_from_vehicle(seconds: float) -> RigidTransform:
    yaw = np.radians(YAW_DEG)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return RigidTransform.from_yaw("world", "vehicle", yaw, ORIGIN_M + SPEED_M_S * seconds * ahead)


def vehicle_from_camera(name: str) -> RigidTransform:
    yaw = np.radians(CAMERA_YAW_DEG[name])
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    axes = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
    return RigidTransform.from_rotation("vehicle", "camera", axes, CAMERA_M)


def world_points() -> np.ndarray:
    """Returns on the road around the whole drive, and on a wall beside it."""
    x, y = np.meshgrid(np.arange(-12.0, 18.0, 0.4), np.arange(-3.4, 3.5, 0.4))
    road = np.stack([x.ravel(), y.ravel(), np.full(x.size, ROAD_M)], axis=1)
    x, z = np.meshgrid(np.arange(-12.0, 18.0, 0.5), np.arange(0.0, 3.0, 0.5))
    wall = np.stack([x.ravel(), np.full(x.size, 6.0), z.ravel()], axis=1)
    return world_from_vehicle(0.0).apply(np.concatenate([road, wall]))


def box_poses(seconds: float) -> dict[str, RigidTransform]:
    """`world_from_actor` of both cars."""
    first = world_from_vehicle(0.0)
    ahead = np.array([AHEAD_M + CAR_SPEED_M_S * seconds, 0.0, ROAD_M + 0.8])
    return {
        "7": first @ RigidTransform.from_yaw("vehicle", "actor", 0.5, np.array(PARKED_M)),
        "4294967296": first @ RigidTransform.from_yaw("vehicle", "actor", 0.0, ahead),
    }


def write_dgp_scene(folder: Path, stamp_scale: int = 1) -> Path:
    """Write the scene and return its folder.

    Args:
        stamp_scale: factor on the time since 1970, 10 in DGP's own test scenes.
    """
    data = [_cloud(folder, i, stamp_scale) for i in range(N_FRAMES)]
    data += [_picture(folder, n, i, stamp_scale) for n in CAMERA_YAW_DEG for i in range(N_FRAMES)]
    scene = {
        "name": "", "log": "TEST", "data": data, "ontologies": {"0": "names", "1": "names"},
        "samples": [{"calibration_key": "rig", "datum_keys": []} for _ in range(N_FRAMES)],
    }  # fmt: skip
    write_json(folder / "scene_0123abcd.json", scene)
    still = RigidTransform.identity("vehicle", "sensor")
    mounted = {LIDAR: still, **{name: vehicle_from_camera(name) for name in CAMERA_YAW_DEG}}
    write_json(
        folder / "calibration" / "rig.json",
        {
            "names": list(mounted),
            "extrinsics": [_pose(pose) for pose in mounted.values()],
            "intrinsics": [_intrinsics(name) for name in mounted],
        },
    )
    items = [{"id": 2, "name": "Car"}, {"id": 0, "name": "Person"}]
    write_json(folder / "ontology" / "names.json", {"items": items})
    return folder


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")


def _cloud(folder: Path, i: int, scale: int) -> dict[str, Any]:
    seconds = float(times_us()[i]) * 1e-6
    pose = world_from_vehicle(seconds)
    points = pose.inverse().apply(world_points())
    names = {k: f"{k}/{LIDAR}/{i:02d}" for k in ("point_cloud", "bounding_box_3d")}
    path = folder / f"{names['point_cloud']}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, data=np.column_stack([points, np.full(len(points), 0.25)]))
    boxes = [
        {
            "class_id": 2, "instance_id": int(actor) if len(actor) < 9 else actor,
            "box": {**dict(zip(("length", "width", "height"), SIZE_LWH_M, strict=True)),
                    "pose": _pose(pose.inverse() @ world_from_actor)},
        }
        for actor, world_from_actor in box_poses(seconds).items()
    ]  # fmt: skip
    write_json(folder / f"{names['bounding_box_3d']}.json", {"annotations": boxes})
    body = {
        "filename": f"{names['point_cloud']}.npz", "pose": _pose(pose),
        "point_format": ["X", "Y", "Z", "INTENSITY"],
        "annotations": {"1": f"{names['bounding_box_3d']}.json"},
    }  # fmt: skip
    return {"id": _id(LIDAR, int(times_us()[i]), scale), "datum": {"point_cloud": body}}


def _picture(folder: Path, name: str, i: int, scale: int) -> dict[str, Any]:
    us = int(times_us(CAMERA_LAG_US)[i])
    pixels = np.random.default_rng(i).integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    path = folder / "rgb" / name / f"{i:02d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    pose = world_from_vehicle(us * 1e-6) @ vehicle_from_camera(name)
    body = {"filename": str(path.relative_to(folder)), "pose": _pose(pose)}
    size = {"width": WIDTH_PX, "height": HEIGHT_PX}
    return {"id": _id(name, us, scale), "datum": {"image": {**body, **size}}}


def _id(name: str, us: int, scale: int) -> dict[str, Any]:
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    stamp = epoch + (START + timedelta(microseconds=us) - epoch) * scale
    return {"name": name, "timestamp": stamp.isoformat().replace("+00:00", "Z"), "log": "TEST"}


def _pose(pose: RigidTransform) -> dict[str, Any]:
    quaternion = quaternion_from_matrix(pose.rotation)
    return {
        "translation": dict(zip("xyz", pose.translation_m.tolist(), strict=True)),
        "rotation": dict(zip(("qw", "qx", "qy", "qz"), quaternion.tolist(), strict=True)),
    }


def _intrinsics(name: str) -> dict[str, Any]:
    if name == LIDAR:
        return dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), 0.0)
    values = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": 31.5, "cy": 23.5, "skew": 0.0}
    if name == FISHEYE:
        values |= {"fisheye": 1, **dict(zip(("k1", "k2", "k3", "k4"), FISHEYE_K, strict=True))}
    return values
