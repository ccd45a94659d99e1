"""Ego vehicle: path, six cameras and roof LiDAR, with poses and timing similar to PandaSet's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, rotation_from_vector
from lightsim_lab.synthetic.plan import StreetConfig, StreetPlan

# Height of the LiDAR above the ground, in metres.
LIDAR_HEIGHT_M = 2.2
# Duration of a sweep, and time between frames, in seconds (10 Hz, as PandaSet).
SWEEP_S = 0.1
# Distance that a stationary vehicle rolls with its brake released over the whole log, in metres.
_ROLL_DISTANCE_M = 0.2
# Acceleration of a vehicle that stops or starts, in m/s^2: gentle city driving.
_ACCELERATION_M_S2 = 2.0
# Mean y of the ego vehicle's path, frame `street`, in metres: the right-hand lane.
_LANE_CENTRE_M = -1.7
# Focal length over image width of PandaSet's front camera (1970 px at 1920 px).
_TELE_FOCAL = 1970.0 / 1920.0
# Focal length over image width of PandaSet's five other cameras (930 px at 1920 px).
_WIDE_FOCAL = 930.0 / 1920.0

# Yaw in frame ego, position in frame ego, focal length over image width, and the offset of the
# principal point from the image's centre in half pixels of a 960 px wide image.
_MOUNTINGS = {
    "front_camera": (0.0, (0.04, 0.0, 2.16), _TELE_FOCAL, (5, -4)),
    "front_left_camera": (47.0, (-0.06, 0.42, 1.94), _WIDE_FOCAL, (6, -16)),
    "front_right_camera": (-47.0, (-0.06, -0.42, 1.93), _WIDE_FOCAL, (2, -38)),
    "left_camera": (95.0, (-0.2, 0.5, 1.92), _WIDE_FOCAL, (16, 1)),
    "right_camera": (-95.0, (-0.2, -0.5, 1.91), _WIDE_FOCAL, (-8, -11)),
    "back_camera": (180.0, (-0.62, 0.0, 1.98), _WIDE_FOCAL, (-32, -16)),
}


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """Camera on the ego vehicle.

    Args:
        margin_px: offset (u, v) of the principal point from the image centre; whole pixels, so
            that a renderer can obtain it by cropping.
        time_offset_s: time of exposure relative to the sweep's time.
        gain: RGB gain: linear pixel value = gain x scene radiance.
    """

    camera: PinholeCamera
    margin_px: tuple[int, int]
    ego_from_camera: RigidTransform
    time_offset_s: float
    gain: Float[np.ndarray, "3"]


def mount_cameras(plan: StreetPlan, config: StreetConfig) -> tuple[MountedCamera, ...]:
    """Return the six cameras; their gains vary by about 10 %, with geometric mean 1 per channel."""
    rng = np.random.default_rng([plan.seed, 7])
    # A factor common to the channels of each camera, and one per channel.
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
    """Return the time at which the LiDAR scans an azimuth (frame `ego`), relative to the sweep's.

    It rotates clockwise, starts and ends at the rear, and the sweep's time is that of the end.
    """
    turned = (np.pi - azimuth_rad) % (2 * np.pi)
    return float(-SWEEP_S + turned / (2 * np.pi) * SWEEP_S)


def ego_way_m(config: StreetConfig, time_s: float) -> float:
    """Return the position of the ego vehicle along the street, in metres; 0 where it stands."""
    if config.standing is None:
        return config.ego_speed_m_s * time_s
    end_s = SWEEP_S * config.frame_count
    if config.standing == "stand":
        return _ROLL_DISTANCE_M * time_s / end_s
    braked_s, moving_s = 0.0, max(time_s - end_s / 2, 0.0)
    if config.standing == "stop":
        braked_s, moving_s = max(end_s / 3 - time_s, 0.0), max(time_s - end_s * 2 / 3, 0.0)
    return _ACCELERATION_M_S2 / 2 * (moving_s**2 - braked_s**2)


def street_from_ego(x: float) -> RigidTransform:
    """Return the pose on the path at a position along the street: small lateral oscillation,
    z = 0."""
    y = _LANE_CENTRE_M + 0.25 * np.sin(0.11 * x)
    yaw = float(np.arctan(0.25 * 0.11 * np.cos(0.11 * x)))
    return RigidTransform.from_yaw("street", "ego", yaw, np.array([x, float(y), 0.0]))


def world_from_ego(plan: StreetPlan, config: StreetConfig, time_s: float) -> RigidTransform:
    """Return the pose of the ego vehicle, with the offset and the sway of the config."""
    beside = RigidTransform.from_rotation("ego", "ego", np.eye(3), np.array(config.ego_offset_m))
    on_path = plan.world_from_street @ street_from_ego(ego_way_m(config, time_s))
    return on_path @ _swayed(config.sway, time_s) @ beside


def _swayed(sway: float, time_s: float) -> RigidTransform:
    """Return the motion of the body on its suspension, with a natural frequency of about 1.2 Hz.

    Amplitudes at sway 1 (pitch .7 degrees, roll .5 degrees, heave 2.5 cm) are chosen, not measured.
    """
    pitch = np.radians(0.5 * np.sin(7.5 * time_s) + 0.2 * np.sin(2.9 * time_s + 1.0))
    roll = np.radians(0.35 * np.sin(6.7 * time_s + 2.0) + 0.15 * np.sin(1.7 * time_s))
    heave_m = 0.02 * np.sin(8.1 * time_s + 0.5) + 0.005 * np.sin(3.3 * time_s)
    rotation = rotation_from_vector(sway * np.array([roll, pitch, 0.0]))
    return RigidTransform.from_rotation("ego", "ego", rotation, np.array([0, 0, sway * heave_m]))


def _mount_from_camera(name: str) -> RigidTransform:
    # Camera axes (right, down, forward) in the axes of the mount (forward, left, up).
    rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return RigidTransform.from_rotation("mount", name, rotation, np.zeros(3))
