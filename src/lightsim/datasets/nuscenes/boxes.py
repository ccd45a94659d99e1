"""Labelled boxes of key frames as actor tracks."""

from __future__ import annotations

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.datasets.nuscenes.sweeps import LidarMount
from lightsim.datasets.nuscenes.table_rows import Row
from lightsim.datasets.nuscenes.tables import SceneTables
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.errors import InputError

# Longest accepted id; tokens have 32 characters.
_MAX_ID_CHARACTERS = 512
# Ends of names of attributes of actors that move: vehicle.moving, pedestrian.moving, and of the T4
# format vehicle_state.driving.
_MOVING = (".moving", ".driving")
_K = ActorKind
KIND_BY_LABEL = {
    # nuScenes.
    "human.pedestrian.adult": _K.PEDESTRIAN,
    "human.pedestrian.child": _K.PEDESTRIAN,
    "human.pedestrian.construction_worker": _K.PEDESTRIAN,
    "human.pedestrian.police_officer": _K.PEDESTRIAN,
    "human.pedestrian.personal_mobility": _K.PERSONAL_MOBILITY,
    "human.pedestrian.stroller": _K.PERSONAL_MOBILITY,
    "human.pedestrian.wheelchair": _K.PERSONAL_MOBILITY,
    "animal": _K.ANIMAL,
    "vehicle.car": _K.CAR,
    "vehicle.truck": _K.TRUCK,
    "vehicle.trailer": _K.TRAILER,
    "vehicle.bus.rigid": _K.BUS,
    "vehicle.bus.bendy": _K.BUS,
    "vehicle.construction": _K.CONSTRUCTION_VEHICLE,
    "vehicle.emergency.ambulance": _K.OTHER_VEHICLE,
    "vehicle.emergency.police": _K.OTHER_VEHICLE,
    "vehicle.bicycle": _K.BICYCLE,
    "vehicle.motorcycle": _K.MOTORCYCLE,
    "movable_object.barrier": _K.BARRIER,
    "movable_object.trafficcone": _K.CONE,
    "movable_object.pushable_pullable": _K.ROLLING_CONTAINER,
    "movable_object.debris": _K.OTHER,
    "static_object.bicycle_rack": _K.OTHER,
    # TruckScenes.
    "vehicle.train": _K.RAIL_VEHICLE,
    "vehicle.other": _K.OTHER_VEHICLE,
    "vehicle.ego_trailer": _K.TRAILER,
    "static_object.traffic_sign": _K.SIGN,
    # Lyft Level 5 and the T4 format.
    "car": _K.CAR,
    "truck": _K.TRUCK,
    "trailer": _K.TRAILER,
    "bus": _K.BUS,
    "other_vehicle": _K.OTHER_VEHICLE,
    "emergency_vehicle": _K.OTHER_VEHICLE,
    "police_car": _K.OTHER_VEHICLE,
    "ambulance": _K.OTHER_VEHICLE,
    "fire_truck": _K.TRUCK,
    "forklift": _K.CONSTRUCTION_VEHICLE,
    "bicycle": _K.BICYCLE,
    "motorcycle": _K.MOTORCYCLE,
    "pedestrian": _K.PEDESTRIAN,
    "construction_worker": _K.PEDESTRIAN,
    "police_officer": _K.PEDESTRIAN,
    "personal_mobility": _K.PERSONAL_MOBILITY,
    "stroller": _K.PERSONAL_MOBILITY,
    "wheelchair": _K.PERSONAL_MOBILITY,
}
"""Names of categories."""


def read_tracks(
    tables: SceneTables, ego: Trajectory, lidar: LidarMount | None
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return one track for each instance, longest first, and notes.

    A box lies where the LiDAR saw the actor, so that its time is that of the scan of its centre, up
    to 50 ms before the time of the sample; then it also fits the pictures, which are taken when the
    LiDAR passes. Without a known turn, it is the time of the sample.

    Args:
        ego: `world_from_ego`.
        lidar: the LiDAR of the labels.

    Raises:
        InputError: a row is broken, or a box is implausible.
    """
    boxes = [_box(row, tables, ego, lidar) for row in tables.rows("sample_annotation")]
    return tracks_of(boxes, KIND_BY_LABEL, tables.table("sample_annotation"))


def _box(row: Row, tables: SceneTables, ego: Trajectory, lidar: LidarMount | None) -> TimedBox:
    instance = tables.find("instance", _id(row), row.where)
    category = tables.find("category", instance.text("category_token"), instance.where)
    attributes = [
        tables.find("attribute", token, row.where).text("name")
        for token in row.tokens("attribute_tokens")
    ]
    width, length, height = row.numbers("size", 3).tolist()
    pose = row.pose("world", "actor")
    time_ns = tables.find("sample", row.text("sample_token"), row.where).time_ns()
    centre_ego = ego.held(time_ns).inverse().apply(pose.translation_m[None])
    distance_m = float(np.linalg.norm(centre_ego))
    LIMITS["box distance"].check(row.where, distance_m, f"{distance_m:.4g} m from the vehicle")
    offset_s = 0.0 if lidar is None else float(lidar.scan_offset_s(centre_ego)[0])
    return TimedBox(
        time_ns + round(offset_s * 1e9),
        instance.text("token"),
        category.text("name"),
        np.array([length, width, height]),
        pose,
        any(name.endswith(_MOVING) for name in attributes),
    )


def _id(row: Row) -> str:
    """Return the token of an instance, which becomes the actor's id."""
    token = row.text("instance_token")
    if not 0 < len(token) <= _MAX_ID_CHARACTERS or not token.isprintable():
        raise InputError(
            "the token of an instance is no id",
            where=row.where,
            got=f"{token!r:.60}",
            expected=f"1 to {_MAX_ID_CHARACTERS} printable characters",
        )
    return token
