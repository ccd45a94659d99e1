"""Where, when and how a synthetic street stands: drawn from the seed before any geometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lightsim.core.checks import check_seed
from lightsim.core.frames import RigidTransform
from lightsim.core.solar import SolarPosition, solar_position
from lightsim.errors import InputError

Size = Literal["small", "medium", "full", "benchmark"]

_PLACES = (
    (37.7749, -122.4194),
    (48.1374, 11.5755),
    (40.7306, -73.9866),
    (41.3874, 2.1686),
    (35.6897, 139.7006),
    (-33.8688, 151.2093),
)
_ELEVATION_DEG = (36.0, 48.0)
_EPOCH_S = 1546300800
"""2019-01-01 UTC."""


@dataclass(frozen=True)
class StreetConfig:
    """How much is recorded, and how finely it is rendered."""

    width_px: int = 480
    """Width of every image."""
    height_px: int = 270
    """Height of every image."""
    frame_count: int = 10
    """Frames and sweeps at 10 Hz."""
    azimuth_count: int = 600
    """LiDAR firings a revolution."""
    truth_stems: tuple[int, ...] = (3, 7)
    """Frames with relit images."""
    buffer_stems: tuple[int, ...] = (3,)
    """Frames with depth, normals, base colour, sun visibility and actor index."""
    buffer_cameras: tuple[str, ...] = ("front_camera", "left_camera", "back_camera")
    """Cameras with these buffers; empty is all."""
    samples: int = 24
    """Paths a pixel."""
    truth_samples: int = 64
    """Paths a pixel of relit images."""
    ego_speed_m_s: float = 13.0
    """1.3 m a frame."""
    ego_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """(ahead, left, up) by which the ego drives beside its path, in its own axes: of an edit."""
    dome_height_px: int = 128
    """Height of the sky files."""
    environment_height_px: int = 512
    """Height of the sky that lights the scene (the sun is a disc of its own)."""


def config_of(size: Size) -> StreetConfig:
    """`small` fits into the package; `medium` has the length and the LiDAR of `full`, but small
    images, for measuring reconstruction; `full` is for training and evaluation; `benchmark` is
    `small` with less to render: one relit frame, no buffers, few paths, to be denoised."""
    if size == "small":
        return StreetConfig()
    if size == "benchmark":
        return StreetConfig(truth_stems=(3,), buffer_stems=(), samples=16, truth_samples=16)
    if size == "medium":
        stems = (12, 28)
        return StreetConfig(
            frame_count=40, azimuth_count=1800, truth_stems=stems, buffer_stems=stems
        )
    stems = (5, 12, 19, 26, 33)
    return StreetConfig(
        width_px=960,
        height_px=540,
        frame_count=40,
        azimuth_count=1800,
        truth_stems=stems,
        buffer_stems=stems,
        buffer_cameras=(),
        samples=32,
        truth_samples=64,
    )


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Place, time and directions. The street runs along +x of frame `street`, ground at z = 0.

    Args:
        start_ns: time of the first sweep; the sun of the whole log stands as at this time.
        sun: as seen from the place at that time.
    """

    seed: int
    latitude_deg: float
    longitude_deg: float
    start_ns: int
    sun: SolarPosition
    enu_from_world: RigidTransform
    world_from_street: RigidTransform


def plan_street(seed: int) -> StreetPlan:
    """The same plan for the same seed, another one for another seed.

    The sun stands 36 to 48 degrees high and crosses the street at 30 to 60 degrees, so that road
    and facades show sunlit and shaded parts.

    Raises:
        InputError: the seed is out of range.
    """
    check_seed(seed)
    rng = np.random.default_rng([seed, 1])
    latitude, longitude = _PLACES[int(rng.integers(len(_PLACES)))]
    latitude += float(rng.uniform(-0.02, 0.02))
    longitude += float(rng.uniform(-0.02, 0.02))
    start_ns, sun = _daytime(rng, latitude, longitude)
    across = float(rng.uniform(30.0, 60.0)) * float(rng.choice([-1.0, 1.0]))
    turn = float(rng.choice([0.0, 180.0]))
    street_azimuth_deg = sun.azimuth_deg + across + turn
    street_yaw = np.radians(90.0 - street_azimuth_deg)
    world_yaw = float(rng.uniform(-np.pi, np.pi))
    zero = np.zeros(3)
    return StreetPlan(
        seed,
        latitude,
        longitude,
        start_ns,
        sun,
        RigidTransform.from_yaw("enu", "world", world_yaw, zero),
        RigidTransform.from_yaw("world", "street", float(street_yaw - world_yaw), zero),
    )


def _daytime(
    rng: np.random.Generator, latitude_deg: float, longitude_deg: float
) -> tuple[int, SolarPosition]:
    """A random time at which the sun stands in the wanted band of elevations."""
    for _ in range(2000):
        seconds = _EPOCH_S + int(rng.integers(0, 5 * 365 * 86400))
        position = solar_position(latitude_deg, longitude_deg, seconds * 10**9)
        if _ELEVATION_DEG[0] <= position.elevation_deg <= _ELEVATION_DEG[1]:
            return seconds * 10**9, position
    raise InputError(
        "no time of day has the sun in the wanted band",
        where=f"latitude {latitude_deg}",
        expected=f"an elevation in {_ELEVATION_DEG} degrees",
    )
