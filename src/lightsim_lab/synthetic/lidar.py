"""A 64-beam LiDAR on the roof: first returns with noise, drop-outs and weak glass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import (
    LIDAR_HEIGHT_M,
    SWEEP_S,
    scan_offset_s,
    street_from_ego,
    world_from_ego,
)
from lightsim_lab.synthetic.street import Street

# Coordinates are stored in steps that a float holds exactly: the files compress better.
STEP_M = 1.0 / 512.0

BEAM_COUNT = 64
_LOWEST_DEG, _HIGHEST_DEG = -25.0, 15.0
_RANGE_M = 120.0
_NOISE_M = 0.015
_DROPOUT = 0.015


@dataclass(frozen=True, eq=False)
class Returns:
    """One sweep: points in frame `world`, intensity 0 to 255, seconds from the sweep's time."""

    points_world: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    offset_s: Float[np.ndarray, " n"]


def actor_poses(
    street: Street, time_s: float, speed_m_s: float
) -> list[tuple[RigidTransform, float]]:
    """`world_from_actor` of every actor at the moment its direction is scanned, and that moment's
    offset from the sweep's time: labels are right then, as in PandaSet."""
    ego_from_street = street_from_ego(time_s - SWEEP_S / 2, speed_m_s).inverse()
    poses = []
    for actor in street.participants:
        centre = actor.street_from_actor(time_s - SWEEP_S / 2).translation_m
        x, y, _ = ego_from_street.apply(centre[None])[0].tolist()
        offset = scan_offset_s(float(np.arctan2(y, x)))
        pose = street.plan.world_from_street @ actor.street_from_actor(time_s + offset)
        poses.append((pose, offset))
    return poses


def scan(street: Street, config: StreetConfig, time_s: float, rng: np.random.Generator) -> Returns:
    """The returns of the sweep that ends at `time_s`; the ego's motion within it is modelled."""
    poses = [pose for pose, _ in actor_poses(street, time_s, config.ego_speed_m_s)]
    snapshot = Snapshot(street, poses)
    origins, directions, offsets = _rays(street, config, time_s)
    hits = snapshot.intersect(origins, directions)
    albedo = snapshot.base_colour(hits) @ np.array([0.5, 0.35, 0.15])
    cosine = np.abs((hits.normal_world * directions).sum(axis=1))
    gain = np.where(hits.is_hit, snapshot.lidar_gain(hits), 0.0)
    strength = gain * albedo * (0.25 + 0.75 * cosine)
    strength *= np.exp(rng.normal(0.0, 0.08, len(strength)))
    # A return is lost where its strength falls with the square of the distance below the noise.
    limit = 0.004 + 0.035 * (np.where(hits.is_hit, hits.distance_m, 0.0) / _RANGE_M) ** 2
    is_kept = hits.is_hit & (hits.distance_m < _RANGE_M) & (strength > limit)
    is_kept &= rng.random(len(strength)) > _DROPOUT
    noisy = hits.distance_m[is_kept] + rng.normal(0.0, _NOISE_M, int(is_kept.sum()))
    points = origins[is_kept] + noisy[:, None] * directions[is_kept]
    intensity = np.clip(np.round(255.0 * 0.9 * strength[is_kept]), 0, 255)
    return Returns(np.round(points / STEP_M) * STEP_M, intensity, offsets[is_kept])


def _rays(
    street: Street, config: StreetConfig, time_s: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Origins and directions in frame `world`, and offsets from the sweep's time."""
    elevation = np.radians(np.linspace(_LOWEST_DEG, _HIGHEST_DEG, BEAM_COUNT))
    azimuths = np.pi - (np.arange(config.azimuth_count) + 0.5) / config.azimuth_count * 2 * np.pi
    origins, directions, offsets = [], [], []
    for azimuth in azimuths.tolist():
        offset = scan_offset_s(azimuth)
        pose = world_from_ego(street.plan, config, time_s + offset)
        fan = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=-1,
        )
        origin = pose.apply(np.array([[0.0, 0.0, LIDAR_HEIGHT_M]]))
        directions.append(pose.rotate(fan))
        origins.append(np.repeat(origin, BEAM_COUNT, axis=0))
        offsets.append(np.full(BEAM_COUNT, offset))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(offsets)
