"""Simulation of the 64-beam roof LiDAR: first returns with noise and dropouts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import (
    LIDAR_HEIGHT_M,
    SWEEP_S,
    ego_way_m,
    scan_offset_s,
    street_from_ego,
    world_from_ego,
)
from lightsim_lab.synthetic.street import Street

# Resolution of stored coordinates, in metres: exact in binary floating point, and files compress
# better than at full precision.
STEP_M = 1.0 / 512.0


@dataclass(frozen=True)
class LidarSensor:
    """Parameters of a spinning LiDAR, by default roughly those of PandaSet's Pandar64."""

    beam_count: int = 64
    """Number of beams, at equal angles."""
    lowest_deg: float = -25.0
    """Elevation of the lowest beam."""
    highest_deg: float = 15.0
    """Elevation of the highest beam."""
    range_m: float = 120.0
    """Largest distance of a return."""
    noise_m: float = 0.015
    """Standard deviation of the distance."""
    dropout: float = 0.015
    """Fraction of returns that are missing at random."""
    sweep_s: float = SWEEP_S
    """Duration of a revolution."""
    height_m: float = LIDAR_HEIGHT_M
    """Height above the road."""


PANDAR64 = LidarSensor()


@dataclass(frozen=True, eq=False)
class Returns:
    """Points (frame `world`), intensities (0 to 255), relative times (s) and firing numbers of one
    sweep; a firing's number is column x beams + beam."""

    points_world: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    offset_s: Float[np.ndarray, " n"]
    firing: Int[np.ndarray, " n"]


def actor_poses(
    street: Street, time_s: float, config: StreetConfig
) -> list[tuple[RigidTransform, float]]:
    """Return the pose `world_from_actor` of every actor when it is scanned, and that time (s).

    PandaSet's labels are valid at these times.
    """
    # The azimuth in the middle of the sweep determines the time of the scan; the change of azimuth
    # within a sweep is neglected.
    ego_from_street = street_from_ego(ego_way_m(config, time_s - SWEEP_S / 2)).inverse()
    poses = []
    for actor in street.participants:
        centre = actor.street_from_actor(time_s - SWEEP_S / 2).translation_m
        x, y, _ = ego_from_street.apply(centre[None])[0].tolist()
        offset = scan_offset_s(float(np.arctan2(y, x)))
        pose = street.plan.world_from_street @ actor.street_from_actor(time_s + offset)
        poses.append((pose, offset))
    return poses


def scan(
    street: Street,
    config: StreetConfig,
    time_s: float,
    rng: np.random.Generator,
    sensor: LidarSensor = PANDAR64,
) -> Returns:
    """Simulate the sweep that ends at `time_s`, including the motion of the ego vehicle."""
    poses = [pose for pose, _ in actor_poses(street, time_s, config)]
    snapshot = Snapshot(street, poses)
    origins, directions, offsets = _rays(street, config, time_s, sensor)
    distance_m, strength = _reflected(snapshot, origins, directions)
    if street.ego_body:
        own_m, own_strength = _reflected_by_ego(street, config, sensor)
        is_own = own_m < distance_m
        distance_m = np.where(is_own, own_m, distance_m)
        strength = np.where(is_own, own_strength, strength)
    strength *= np.exp(rng.normal(0.0, 0.08, len(strength)))
    # The threshold of detection grows with the square of the distance, as the signal falls with it.
    is_hit = np.isfinite(distance_m)
    limit = 0.004 + 0.035 * (np.where(is_hit, distance_m, 0.0) / sensor.range_m) ** 2
    is_return = is_hit & (distance_m < sensor.range_m) & (strength > limit)
    is_return &= rng.random(len(strength)) > sensor.dropout
    noisy = distance_m[is_return] + rng.normal(0.0, sensor.noise_m, int(is_return.sum()))
    points = origins[is_return] + noisy[:, None] * directions[is_return]
    intensity = np.clip(np.round(255.0 * 0.9 * strength[is_return]), 0, 255)
    firing = np.flatnonzero(is_return)
    return Returns(np.round(points / STEP_M) * STEP_M, intensity, offsets[is_return], firing)


def _reflected(
    snapshot: Snapshot, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return distance (m, inf without a surface) and strength of the reflection of each beam."""
    hits = snapshot.intersect(origins, directions)
    # Infrared reflectance, approximated by a mean that favours red; weights chosen, not measured.
    albedo = snapshot.base_colour(hits) @ np.array([0.5, 0.35, 0.15])
    cosine = np.abs((hits.normal_world * directions).sum(axis=1))
    # Diffuse return with an ambient term, so that grazing surfaces remain visible; chosen, not
    # fitted.
    gain = np.where(hits.is_hit, snapshot.lidar_gain(hits), 0.0)
    return hits.distance_m, gain * albedo * (0.25 + 0.75 * cosine)


def _reflected_by_ego(
    street: Street, config: StreetConfig, sensor: LidarSensor
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return distance and strength of the reflections of the ego vehicle's body, which moves with
    the sensor: the same for every sweep."""
    still = RigidTransform.from_rotation("world", "ego", np.eye(3), np.zeros(3))
    alone = Snapshot(replace(street, background=(), participants=()), (), still)
    fans = _fans(config, sensor).reshape(-1, 3)
    origins = np.broadcast_to(np.array([0.0, 0.0, sensor.height_m]), fans.shape).copy()
    return _reflected(alone, origins, fans)


def _azimuths(config: StreetConfig) -> list[float]:
    steps = (np.arange(config.azimuth_count) + 0.5) / config.azimuth_count
    return (np.pi - steps * 2 * np.pi).tolist()


def _fans(config: StreetConfig, sensor: LidarSensor) -> Float[np.ndarray, "columns beams 3"]:
    """Return the directions of the beams of every column, frame `ego`."""
    elevation = np.radians(np.linspace(sensor.lowest_deg, sensor.highest_deg, sensor.beam_count))
    return np.stack(
        [
            np.stack(
                [
                    np.cos(elevation) * np.cos(azimuth),
                    np.cos(elevation) * np.sin(azimuth),
                    np.sin(elevation),
                ],
                axis=-1,
            )
            for azimuth in _azimuths(config)
        ]
    )


def _rays(
    street: Street, config: StreetConfig, time_s: float, sensor: LidarSensor
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return origins and directions in frame `world`, and times relative to the sweep's."""
    origins, directions, offsets = [], [], []
    for azimuth, fan in zip(_azimuths(config), _fans(config, sensor), strict=True):
        offset = scan_offset_s(azimuth) * sensor.sweep_s / SWEEP_S
        pose = world_from_ego(street.plan, config, time_s + offset)
        origin = pose.apply(np.array([[0.0, 0.0, sensor.height_m]]))
        directions.append(pose.rotate(fan))
        origins.append(np.repeat(origin, sensor.beam_count, axis=0))
        offsets.append(np.full(sensor.beam_count, offset))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(offsets)
