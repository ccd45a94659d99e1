"""Names of nuScenes: categories, attributes, levels of visibility and channels.

Names and descriptions: the schema and the annotation instructions of nuscenes-devkit.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from scipy.optimize import linear_sum_assignment

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.export.motion import is_moving_at
from lightsim.export.scenario_log import ScenarioLog

CATEGORY_BY_KIND: Mapping[ActorKind, str] = MappingProxyType({
    ActorKind.CAR: "vehicle.car",
    # nuScenes counts pickups as trucks.
    ActorKind.PICKUP: "vehicle.truck",
    ActorKind.TRUCK: "vehicle.truck",
    ActorKind.BUS: "vehicle.bus.rigid",
    ActorKind.TRAILER: "vehicle.trailer",
    ActorKind.CONSTRUCTION_VEHICLE: "vehicle.construction",
    ActorKind.MOTORCYCLE: "vehicle.motorcycle",
    ActorKind.SCOOTER: "vehicle.motorcycle",
    ActorKind.BICYCLE: "vehicle.bicycle",
    ActorKind.PEDESTRIAN: "human.pedestrian.adult",
    ActorKind.PERSONAL_MOBILITY: "human.pedestrian.personal_mobility",
    ActorKind.ANIMAL: "animal",
    ActorKind.CONE: "movable_object.trafficcone",
    ActorKind.BARRIER: "movable_object.barrier",
    ActorKind.ROLLING_CONTAINER: "movable_object.pushable_pullable",
})  # fmt: skip
"""Categories; kinds without an entry have none in nuScenes, whose devkit rejects other names."""
CATEGORIES = (
    "animal", "human.pedestrian.adult", "human.pedestrian.child",
    "human.pedestrian.construction_worker", "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer", "human.pedestrian.stroller", "human.pedestrian.wheelchair",
    "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle",
    "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction",
    "vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle",
    "vehicle.trailer", "vehicle.truck",
)  # fmt: skip
ATTRIBUTES = (
    "cycle.with_rider", "cycle.without_rider", "pedestrian.moving",
    "pedestrian.sitting_lying_down", "pedestrian.standing", "vehicle.moving", "vehicle.parked",
    "vehicle.stopped",
)  # fmt: skip
VISIBILITY: Mapping[str, tuple[float, str]] = MappingProxyType({
    "1": (0.0, "v0-40"),
    "2": (0.4, "v40-60"),
    "3": (0.6, "v60-80"),
    "4": (0.8, "v80-100"),
})  # fmt: skip
"""Token, least visible fraction and name of each level."""
LIDAR = "LIDAR_TOP"
_AZIMUTH_DEG: Mapping[str, float] = MappingProxyType({
    "CAM_FRONT": 0.0,
    "CAM_FRONT_LEFT": 55.0,
    "CAM_BACK_LEFT": 110.0,
    "CAM_BACK": 180.0,
    "CAM_BACK_RIGHT": -110.0,
    "CAM_FRONT_RIGHT": -55.0,
})  # fmt: skip
"""Azimuth of each camera's optical axis to the left of straight ahead (Caesar et al. 2020,
doi:10.1109/CVPR42600.2020.01164, Fig. 4)."""


def attribute_of(track: ActorTrack, time_ns: int) -> str | None:
    """Return the attribute of an actor at a time; None where the log does not determine it, such
    as the presence of a rider."""
    is_moving = is_moving_at(track, time_ns)
    if track.kind.is_vehicle:
        still = "vehicle.stopped" if track.is_moving else "vehicle.parked"
        return "vehicle.moving" if is_moving else still
    if track.kind == ActorKind.PEDESTRIAN:
        return "pedestrian.moving" if is_moving else "pedestrian.standing"
    return None


def visibility_token(visibility: float) -> str:
    """Return the token of the level of a visible fraction."""
    return max(token for token, (least, _) in VISIBILITY.items() if visibility >= least)


def channel_by_camera(log: ScenarioLog) -> dict[str, str]:
    """Return the channel of each camera: the six of nuScenes, which loaders expect, by the least
    sum of differences in azimuth; further cameras get CAM_ and their own name."""
    names, channels = list(log.log.cameras), list(_AZIMUTH_DEG)
    axes = np.array([log.ego_from_camera(name).rotation[:2, 2] for name in names])
    azimuth_deg = np.degrees(np.arctan2(axes[:, 1], axes[:, 0]))
    gap_deg = azimuth_deg[:, None] - np.array(list(_AZIMUTH_DEG.values()))
    rows, columns = linear_sum_assignment(np.abs((gap_deg + 180.0) % 360.0 - 180.0))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    chosen = {names[row]: channels[column] for row, column in pairs}
    return {name: chosen.get(name, f"CAM_{name.upper()}") for name in names}
