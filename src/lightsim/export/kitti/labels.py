"""Label lines and calibration of KITTI's object benchmark.

Columns and frames: KITTI object development kit, readme.txt; Geiger et al. 2013,
doi:10.1177/0278364913491297.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frame_labels import ActorLabel, Box
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.export.projection import (
    Rectangle,
    box_rectangle,
    inside_picture,
    intrinsic_matrix,
    truncation,
)

CLASS_BY_KIND: Mapping[ActorKind, str] = MappingProxyType({
    ActorKind.CAR: "Car",
    # KITTI has no class for pickups, buses and motorcycles; `Misc` is for other vehicles.
    ActorKind.PICKUP: "Car",
    ActorKind.TRUCK: "Truck",
    ActorKind.BUS: "Misc",
    ActorKind.RAIL_VEHICLE: "Tram",
    ActorKind.TRAILER: "Misc",
    ActorKind.CONSTRUCTION_VEHICLE: "Misc",
    ActorKind.OTHER_VEHICLE: "Misc",
    ActorKind.MOTORCYCLE: "Misc",
    ActorKind.SCOOTER: "Misc",
    ActorKind.BICYCLE: "Cyclist",
    ActorKind.PEDESTRIAN: "Pedestrian",
    ActorKind.PERSONAL_MOBILITY: "Misc",
})  # fmt: skip
"""Classes; street furniture, animals and unknown kinds are not labelled in KITTI."""
_DONT_CARE = "DontCare -1 -1 -10 {} {} {} {} -1 -1 -1 -1000 -1000 -1000 -10"
# Least visible fraction of `fully visible`: that of nuScenes' highest level, since KITTI's
# annotators had no measure.
_FULLY = 0.8
# Least visible fraction of `partly occluded`: that of nuScenes' second lowest level.
_PARTLY = 0.4
# Code of an unknown occlusion.
_UNKNOWN = 3


@dataclass(frozen=True)
class KittiView:
    """One picture, for which labels are written."""

    frame: CameraFrame
    camera: PinholeCamera

    def line(self, track: ActorTrack, label: ActorLabel | None) -> str | None:
        """Return the line of an actor; None if the picture does not show its place.

        Args:
            label: visibility and boxes; None for an actor without a mesh.
        """
        rectangle = box_rectangle(track, self.frame, self.camera)
        inside = None if rectangle is None else inside_picture(rectangle, self.camera)
        if rectangle is None or (label is None and inside is None):
            return None
        if label is not None and label.visible_px == 0:
            return _DONT_CARE.format(*_pixels(label.amodal_box))
        pose = self.frame.world_from_camera.inverse() @ track.world_from_actor(self.frame.time_ns)
        length, width, height = track.size_lwh_m.tolist()
        rotation_y, alpha = angles_rad(pose)
        # The centre of the bottom face, with the box upright in the camera's frame, as readers
        # assume: the centre of the box is exact.
        place = pose.translation_m + [0.0, height / 2, 0.0]
        edges = label.amodal_box if label is not None else inside
        assert edges is not None
        numbers = [alpha, *_pixels(edges), height, width, length, *place.tolist(), rotation_y]
        words = " ".join(f"{number:.6f}" for number in numbers)
        occluded = _UNKNOWN if label is None else occlusion(label.visibility)
        truncated = f"{truncation(rectangle, self.camera):.2f}"
        return f"{CLASS_BY_KIND[track.kind]} {truncated} {occluded} {words}"

    def calibration(self, camera_from_lidar: RigidTransform) -> str:
        """Return the calibration file; all four cameras are the chosen one, which is rectified."""
        projection = np.hstack([intrinsic_matrix(self.camera), np.zeros((3, 1))])
        lines = {f"P{number}": projection for number in range(4)}
        lines |= {
            "R0_rect": np.eye(3),
            "Tr_velo_to_cam": camera_from_lidar.matrix[:3],
            "Tr_imu_to_velo": np.eye(4)[:3],
        }
        return "".join(f"{name}: {_numbers(matrix)}\n" for name, matrix in lines.items())


def angles_rad(camera_from_actor: RigidTransform) -> tuple[float, float]:
    """Return rotation_y, the heading about the camera's y axis (0 along x), and alpha, the heading
    relative to the ray to the actor; both in [-pi, pi]."""
    ahead = camera_from_actor.rotation[:, 0]
    rotation_y = float(np.arctan2(-ahead[2], ahead[0]))
    x, _, z = camera_from_actor.translation_m
    alpha = rotation_y - float(np.arctan2(x, z))
    return rotation_y, float(np.arctan2(np.sin(alpha), np.cos(alpha)))


def occlusion(visibility: float) -> int:
    """Return KITTI's state of occlusion: 0 fully visible, 1 partly, 2 largely occluded."""
    if visibility >= _FULLY:
        return 0
    return 1 if visibility >= _PARTLY else 2


def _pixels(edges: Box | Rectangle) -> tuple[float, float, float, float]:
    """Return the first and last column and row, counted from 0, of a box given by its edges."""
    left, top, right, bottom = edges
    return float(left), float(top), float(right) - 1.0, float(bottom) - 1.0


def _numbers(matrix: Float64[np.ndarray, "n m"]) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.reshape(-1).tolist())
