"""Place, time and orientation of a synthetic street, drawn from the seed before any geometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from lightsim.core.checks import check_choice, check_seed
from lightsim.core.frames import RigidTransform
from lightsim.core.solar import SolarPosition, solar_position
from lightsim.errors import InputError

Size = Literal["small", "medium", "full", "benchmark"]
Style = Literal["city", "suburban", "boulevard", "industrial"]
# The position of a style is part of its random streams: append, do not reorder.
STYLES: tuple[Style, ...] = get_args(Style)
RendererName = Literal["mitsuba", "cycles"]
"""Path tracer of a street's pictures."""
Standing = Literal["stand", "start", "stop"]
"""Motion of an ego vehicle that waits at a junction: it rolls 0.2 m during the whole log, starts in
the second half, or stops and waits in the middle third."""

# Latitude and longitude, in degrees, of San Francisco, Munich, New York, Barcelona, Tokyo and
# Sydney.
_PLACES = (
    (37.7749, -122.4194),
    (48.1374, 11.5755),
    (40.7306, -73.9866),
    (41.3874, 2.1686),
    (35.6897, 139.7006),
    (-33.8688, 151.2093),
)
# Range of the sun's elevation, in degrees: road and facades have sunlit and shaded parts.
_ELEVATION_DEG = (36.0, 48.0)
# Earliest time of a log, in seconds since 1970: 2019-01-01 UTC, the year of PandaSet.
_EPOCH_S = 1546300800


@dataclass(frozen=True)
class StreetConfig:
    """Length and resolution of the log, and quality of its images."""

    width_px: int = 480
    """Width of every image."""
    height_px: int = 270
    """Height of every image."""
    frame_count: int = 10
    """Number of frames and sweeps, at 10 Hz."""
    azimuth_count: int = 600
    """LiDAR firings per revolution."""
    truth_stems: tuple[int, ...] = (3, 7)
    """Indices of the frames with relit images."""
    buffer_stems: tuple[int, ...] = (3,)
    """Indices of the frames with depth, normals, base colour, sun visibility and actor index."""
    buffer_cameras: tuple[str, ...] = ("front_camera", "left_camera", "back_camera")
    """Cameras with these buffers; empty: all."""
    samples: int = 24
    """Light paths per pixel of the log's images."""
    truth_samples: int = 64
    """Light paths per pixel of relit images."""
    ego_speed_m_s: float = 13.0
    """Speed of the ego vehicle: 1.3 m per frame."""
    ego_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset (ahead, left, up) of the ego vehicle from its path, frame `ego`; set by an edit."""
    sway: float = 0.0
    """Pitch, roll and heave of the ego vehicle: 0 none, 1 as on an uneven city street."""
    has_fast_traffic: bool = False
    """Oncoming traffic is a dense column at 15 to 18 m/s."""
    standing: Standing | None = None
    """Motion of an ego vehicle with a visible body that waits at a junction; None: it drives at
    `ego_speed_m_s`, and no sensor sees its body."""
    dome_height_px: int = 128
    """Height of the sky files."""
    environment_height_px: int = 512
    """Height of the sky that lights the scene; the sun is a separate disc."""


def config_of(size: Size) -> StreetConfig:
    """Return the settings of a named size.

    `small` fits into the package. `medium` has the length and LiDAR of `full`, but small images,
    for the evaluation of reconstruction. `full` is for training and evaluation. `benchmark` is
    `small` with less rendering: one relit frame, no buffers, few light paths, for use with a
    denoiser.
    """
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
    """Place, time and orientation. The street runs along +x of frame `street`, ground at z = 0.

    Args:
        start_ns: time of the first sweep; the sun of the whole log is that of this time.
        sun: position of the sun at this place and time.
    """

    seed: int
    latitude_deg: float
    longitude_deg: float
    start_ns: int
    sun: SolarPosition
    enu_from_world: RigidTransform
    world_from_street: RigidTransform
    style: Style = "city"
    """Style of the street: buildings, vegetation, traffic and materials."""

    @property
    def name(self) -> str:
        """Name of the street: the seed, with the style in front unless it is the city."""
        return street_name(self.seed, self.style)

    def stream(self, number: int) -> np.random.Generator:
        """Return a random stream of this seed and style, independent of the city's streams."""
        return np.random.default_rng([self.seed, 20, STYLES.index(self.style), number])


def street_name(seed: int, style: Style) -> str:
    """Return the name of a street in folders and records: `21`, or `suburban-21`."""
    return str(seed) if style == "city" else f"{style}-{seed}"


def plan_street(seed: int, style: Style = "city") -> StreetPlan:
    """Draw the plan of a seed and style; it is reproducible.

    The sun's elevation is 36 to 48 degrees and its azimuth differs from that of the street by 30 to
    60 degrees, so that road and facades have sunlit and shaded parts.

    Raises:
        InputError: the seed is out of range, or there is no such style.
    """
    check_seed(seed)
    check_choice("--style", style, STYLES)
    rng = np.random.default_rng([seed, 1] if style == "city" else [seed, 1, STYLES.index(style)])
    latitude, longitude = _PLACES[int(rng.integers(len(_PLACES)))]
    latitude += float(rng.uniform(-0.02, 0.02))
    longitude += float(rng.uniform(-0.02, 0.02))
    start_ns, sun = _daytime(rng, latitude, longitude)
    # Yaw of the street in the frame `enu` is counter-clockwise from east; azimuths are from north.
    across = float(rng.uniform(30.0, 60.0)) * float(rng.choice([-1.0, 1.0]))
    turn = float(rng.choice([0.0, 180.0]))
    if style == "boulevard":
        # The tall near side would shade all of the road: the sun is on the other side.
        across = abs(across) * (1.0 if turn == 0.0 else -1.0)
    street_azimuth_deg = sun.azimuth_deg + across + turn
    street_yaw = np.radians(90.0 - street_azimuth_deg)
    # The frame `world` has a random yaw to north, as PandaSet's.
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
        style,
    )


def _daytime(
    rng: np.random.Generator, latitude_deg: float, longitude_deg: float
) -> tuple[int, SolarPosition]:
    """Draw a time with the sun's elevation in the given range."""
    for _ in range(2000):
        seconds = _EPOCH_S + int(rng.integers(0, 5 * 365 * 86400))
        position = solar_position(latitude_deg, longitude_deg, seconds * 10**9)
        if _ELEVATION_DEG[0] <= position.elevation_deg <= _ELEVATION_DEG[1]:
            return seconds * 10**9, position
    raise InputError(
        "the sun is never in the required range of elevations",
        where=f"latitude {latitude_deg}",
        expected=f"an elevation in {_ELEVATION_DEG} degrees",
    )
