"""The ego vehicle: its path, six cameras and the roof LiDAR, mounted and timed as PandaSet's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.plan import StreetConfig, StreetPlan

LIDAR_HEIGHT_M = 2.2
SWEEP_S = 0.1
_LANE_CENTRE_M = -1.7
_TELE_FOCAL = 1970.0 / 1920.0
_WIDE_FOCAL = 930.0 / 1920.0

_MOUNTINGS = {
    "front_camera": (0.0, (0.04, 0.0, 2.16), _TELE_FOCAL, (5, -4)),
    "front_left_camera": (47.0, (-0.06, 0.42, 1.94), _WIDE_FOCAL, (6, -16)),
    "front_right_camera": (-47.0, (-0.06, -0.42, 1.93), _WIDE_FOCAL, (2, -38)),
    "left_camera": (95.0, (-0.2, 0.5, 1.92), _WIDE_FOCAL, (16, 1)),
    "right_camera": (-95.0, (-0.2, -0.5, 1.91), _WIDE_FOCAL, (-8, -11)),
    "back_camera": (180.0, (-0.62, 0.0, 1.98), _WIDE_FOCAL, (-32, -16)),
}
"""Yaw in frame ego, position in frame ego, focal length over image width, and the offset of the
principal point from the image's centre in half pixels of a 960 px wide image."""


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera on the car.

    Args:
        margin_px: (u, v) by which the principal point lies off the centre; whole pixels, so that
            a renderer gets there by cropping.
        time_offset_s: when it fires, seconds from the sweep's time.
        gain: RGB, linear pixel value = gain x scene radiance.
    """

    camera: PinholeCamera
    margin_px: tuple[int, int]
    ego_from_camera: RigidTransform
    time_offset_s: float
    gain: Float[np.ndarray, "3"]


def mount_cameras(plan: StreetPlan, config: StreetConfig) -> tuple[MountedCamera, ...]:
    """The six cameras. Gains differ by about 10 %, geometric mean exactly 1 in each channel."""
    rng = np.random.default_rng([plan.seed, 7])
    logs = rng.normal(0.0, 0.08, (len(_MOUNTINGS), 1)) + rng.normal(0.0, 0.05, (len(_MOUNTINGS), 3))
    gains = np.exp(logs - logs.mean(axis=0))
    cameras = []
    for gain, (name, mounting) in zip(gains, _MOUNTINGS.items(), strict=True):
        yaw_deg, position, focal, shift = mounting
        width, height = config.width_px, config.height_px
        margin = (round(shift[0] * width / 960), round(shift[1] * width / 960))
        camera = PinholeCamera(
            name,
            width,
            height,
            focal * width,
            focal * width,
            width / 2 + margin[0],
            height / 2 + margin[1],
        )
        pose = RigidTransform.from_yaw("ego", "mount", np.radians(yaw_deg), np.array(position))
        cameras.append(
            MountedCamera(
                camera,
                margin,
                pose @ _mount_from_camera(name),
                scan_offset_s(np.radians(yaw_deg)),
                gain,
            )
        )
    return tuple(cameras)


def scan_offset_s(azimuth_rad: float) -> float:
    """When the LiDAR looks that way (frame ego): it turns clockwise from behind and ends there."""
    turned = (np.pi - azimuth_rad) % (2 * np.pi)
    return float(-SWEEP_S + turned / (2 * np.pi) * SWEEP_S)


def street_from_ego(time_s: float, speed_m_s: float) -> RigidTransform:
    """The car's pose: steady speed along the lane, weaving a little. Origin on the ground."""
    x = speed_m_s * time_s
    y = _LANE_CENTRE_M + 0.25 * np.sin(0.11 * x)
    yaw = float(np.arctan(0.25 * 0.11 * np.cos(0.11 * x)))
    return RigidTransform.from_yaw("street", "ego", yaw, np.array([x, float(y), 0.0]))


def world_from_ego(plan: StreetPlan, config: StreetConfig, time_s: float) -> RigidTransform:
    """The car's pose, beside its path where the config says so."""
    beside = RigidTransform.from_rotation("ego", "ego", np.eye(3), np.array(config.ego_offset_m))
    return plan.world_from_street @ street_from_ego(time_s, config.ego_speed_m_s) @ beside


def _mount_from_camera(name: str) -> RigidTransform:
    rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return RigidTransform.from_rotation("mount", name, rotation, np.zeros(3))
