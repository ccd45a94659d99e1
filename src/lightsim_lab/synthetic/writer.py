"""Writer of a log in PandaSet's layout."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lightsim.core.actors import ActorKind
from lightsim.core.frames import RigidTransform, quaternion_from_matrix
from lightsim.store.atomic import whole_file
from lightsim.store.pandaset_tables import cuboid_table, pose_entry, write_table
from lightsim_lab.synthetic.lidar import Returns, actor_poses
from lightsim_lab.synthetic.plan import StreetConfig, StreetPlan
from lightsim_lab.synthetic.rig import (
    LIDAR_HEIGHT_M,
    SWEEP_S,
    MountedCamera,
    world_from_ego,
)
from lightsim_lab.synthetic.street import Street

# PandaSet's labels of the kinds that streets have.
LABEL_BY_KIND = {
    ActorKind.CAR: "Car",
    ActorKind.TRUCK: "Medium-sized Truck",
    ActorKind.TRAILER: "Towed Object",
    ActorKind.RAIL_VEHICLE: "Tram / Subway",
    ActorKind.PEDESTRIAN: "Pedestrian",
}
# Equatorial radius of the WGS 84 ellipsoid, in metres.
_EQUATOR_M = 6378137.0
# Flattening of the WGS 84 ellipsoid.
_FLATTENING = 1 / 298.257223563


def utc_s(plan: StreetPlan, offset_s: float) -> float:
    """Return a time relative to the first sweep in seconds since 1970, to the microsecond."""
    return round(plan.start_ns * 1e-9 + offset_s, 6)


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def write_rig(
    folder: Path, plan: StreetPlan, config: StreetConfig, cameras: Sequence[MountedCamera]
) -> None:
    """Write intrinsics, poses and times of cameras and LiDAR, GPS, and the calibration."""
    count = config.frame_count
    for mounted in cameras:
        camera = mounted.camera
        target = folder / "camera" / camera.name
        times = [SWEEP_S * k + mounted.time_offset_s for k in range(count)]
        # PandaSet's pixel coordinates (OpenCV) have the first pixel's centre at 0, not 0.5.
        write_json(
            target / "intrinsics.json",
            {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - 0.5, "cy": camera.cy - 0.5},
        )
        poses = [camera_pose(plan, config, mounted, t) for t in times]
        write_json(target / "poses.json", [pose_entry(pose) for pose in poses])
        write_json(target / "timestamps.json", [utc_s(plan, t) for t in times])
    times = [SWEEP_S * k for k in range(count)]
    egos = [world_from_ego(plan, config, t) for t in times]
    lidar = _ego_from_pandar64()
    write_json(folder / "lidar" / "poses.json", [pose_entry(ego @ lidar) for ego in egos])
    for name in ("lidar", "meta"):
        write_json(folder / name / "timestamps.json", [utc_s(plan, t) for t in times])
    write_json(folder / "meta" / "gps.json", _gps(plan, config, times))
    _write_calibration(folder / "static_extrinsic_calibration.yaml", cameras)


def camera_pose(
    plan: StreetPlan, config: StreetConfig, mounted: MountedCamera, time_s: float
) -> RigidTransform:
    """Return `world_from_camera` at a time."""
    return world_from_ego(plan, config, time_s) @ mounted.ego_from_camera


def write_sweep(path: Path, returns: Returns, end_utc_s: float) -> None:
    """Write a sweep with PandaSet's columns x y z i t d; d = 0 is the roof LiDAR."""
    x, y, z = returns.points_world.T
    times = np.round((end_utc_s + returns.offset_s) * 1e4) / 1e4
    device = np.zeros(len(x), dtype=np.int64)
    columns = {"x": x, "y": y, "z": z, "i": returns.intensity, "t": times, "d": device}
    write_table(path, columns, "index")


def write_cuboids(path: Path, street: Street, config: StreetConfig, time_s: float) -> None:
    """Write the boxes of all actors, each at the time when it was scanned.

    PandaSet's boxes have their width along x and length along y, hence yaw = heading - 90 degrees.
    """
    rows = []
    poses = actor_poses(street, time_s, config)
    for actor, (pose, _) in zip(street.participants, poses, strict=True):
        x, y, z = pose.translation_m.tolist()
        length, width, height = actor.size_lwh_m
        is_still = actor.speed_m_s == 0
        still, moving = ("Parked", "Moving") if actor.kind.is_vehicle else (None, None)
        rows.append(
            {
                "uuid": actor.actor_id,
                "label": LABEL_BY_KIND[actor.kind],
                "yaw": float(np.angle(np.exp(1j * (pose.yaw_rad - np.pi / 2)))),
                "stationary": is_still,
                "camera_used": -1,
                "position.x": x,
                "position.y": y,
                "position.z": z,
                "dimensions.x": width,
                "dimensions.y": length,
                "dimensions.z": height,
                "attributes.object_motion": still if is_still else moving,
                "cuboids.sibling_id": "-",
                "cuboids.sensor_id": -1,
                "attributes.rider_status": None,
                "attributes.pedestrian_behavior": "Walking" if actor.kind.is_person else None,
                "attributes.pedestrian_age": "Adult" if actor.kind.is_person else None,
            }
        )
    write_table(path, cuboid_table(rows))


def _ego_from_pandar64() -> RigidTransform:
    """Return the pose of the LiDAR; PandaSet's LiDAR has y forward and x to the right."""
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    height = np.array([0.0, 0.0, LIDAR_HEIGHT_M])
    return RigidTransform.from_rotation("ego", "pandar64", rotation, height)


def _gps(
    plan: StreetPlan, config: StreetConfig, times_s: Sequence[float]
) -> list[dict[str, float]]:
    """Return the GPS fixes of the ego origin."""
    fixes = []
    for time_s in times_s:
        here = _enu(plan, config, time_s)
        ahead = _enu(plan, config, time_s + 0.01)
        latitude_deg, longitude_deg = latitude_longitude_deg(plan, here)
        fixes.append(
            {
                "lat": latitude_deg,
                "long": longitude_deg,
                "height": float(here[2]),
                # Velocity from a finite difference over 0.01 s.
                "xvel": float((ahead[0] - here[0]) / 0.01),
                "yvel": float((ahead[1] - here[1]) / 0.01),
            }
        )
    return fixes


def latitude_longitude_deg(
    plan: StreetPlan, position_enu: Float[np.ndarray, "3"]
) -> tuple[float, float]:
    """Return latitude and longitude of a position, by the WGS 84 radii of curvature at the
    start."""
    eccentricity_2 = _FLATTENING * (2 - _FLATTENING)
    latitude = np.radians(plan.latitude_deg)
    # Radii of curvature along the meridian and the parallel.
    w = np.sqrt(1 - eccentricity_2 * np.sin(latitude) ** 2)
    meridian_m = _EQUATOR_M * (1 - eccentricity_2) / w**3
    parallel_m = _EQUATOR_M / w * np.cos(latitude)
    east, north, _ = position_enu
    return (
        float(plan.latitude_deg + np.degrees(north / meridian_m)),
        float(plan.longitude_deg + np.degrees(east / parallel_m)),
    )


def _enu(plan: StreetPlan, config: StreetConfig, time_s: float) -> Float[np.ndarray, "3"]:
    return (plan.enu_from_world @ world_from_ego(plan, config, time_s)).translation_m


def _write_calibration(path: Path, cameras: Sequence[MountedCamera]) -> None:
    # PandaSet's calibration maps LiDAR to camera coordinates.
    lines = []
    for mounted in cameras:
        camera = mounted.camera
        transform = mounted.ego_from_camera.inverse() @ _ego_from_pandar64()
        w, x, y, z = quaternion_from_matrix(transform.rotation).tolist()
        tx, ty, tz = transform.translation_m.tolist()
        lines += [
            f"{camera.name}:",
            "  extrinsic:",
            "    transform:",
            f"      rotation: {{w: {w:.12f}, x: {x:.12f}, y: {y:.12f}, z: {z:.12f}}}",
            f"      translation: {{x: {tx:.9f}, y: {ty:.9f}, z: {tz:.9f}}}",
            "  readout_s: 0.0",
            "  intrinsic:",
            "    D: [0, 0, 0, 0, 0]",
            f"    K: [{camera.fx}, 0, {camera.cx - 0.5}, "
            f"0, {camera.fy}, {camera.cy - 0.5}, 0, 0, 1]",
        ]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
