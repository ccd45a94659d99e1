"""Visibility masks of camera rigs in panoramas; the forward direction is the centre column.

All cameras of a rig are at one point. The parallax between them affects near surfaces, not the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial.transform import Rotation

from lightsim.core.equirect import sample_bilinear
from lightsim_lab.training import grids


@dataclass(frozen=True)
class RigCamera:
    """Orientation and field of view of one camera of a rig.

    Args:
        yaw_deg: yaw of the optical axis, counter-clockwise from forward.
        half_width: tangent of the angle from the axis to the left and right image border.
        up: tangent of the angle to the upper border.
        down: tangent of the angle to the lower border.
        pitch_deg: pitch of the optical axis, positive upwards.
    """

    yaw_deg: float
    half_width: float
    up: float
    down: float
    pitch_deg: float = 0.0


@dataclass(frozen=True)
class Rig:
    """Cameras of one vehicle type."""

    name: str
    cameras: tuple[RigCamera, ...]


def _pixels(
    yaw_deg: float,
    size: tuple[int, int],
    focal: float,
    row: float | None = None,
    pitch: float = 0.0,
) -> RigCamera:
    """Return a camera from image size, focal length and principal row, in pixels."""
    width, height = size
    centre = height / 2 if row is None else row
    return RigCamera(yaw_deg, width / 2 / focal, centre / focal, (height - centre) / focal, pitch)


# Width and height of the images of PandaSet, in pixels.
_FULL_HD = (1920, 1080)
# PandaSet: intrinsics as published with the data set, mounting as in its sequence 002.
PANDASET = Rig(
    "pandaset",
    (
        _pixels(0.0, _FULL_HD, 1970.0, 484.0),
        _pixels(57.4, _FULL_HD, 930.0, 508.0, 1.7),
        _pixels(-58.3, _FULL_HD, 930.0, 464.0, -0.6),
        _pixels(91.3, _FULL_HD, 930.0, 542.0, 2.8),
        _pixels(-89.0, _FULL_HD, 922.0, 518.0, -0.6),
        _pixels(-178.6, _FULL_HD, 933.0, 508.0, 0.3),
    ),
)
# Synthetic street: the same cameras as in `synthetic.rig`, without the principal point offsets.
SYNTHETIC = Rig(
    "synthetic",
    (
        _pixels(0.0, _FULL_HD, 1970.0),
        *(_pixels(y, _FULL_HD, 930.0) for y in (47.0, -47.0, 95.0, -95.0, 180.0)),
    ),
)
# Six cameras of 70 degrees, the rear one 110 (Caesar et al., CVPR 2020).
NUSCENES = Rig(
    "nuscenes",
    (
        *(_pixels(y, (1600, 900), 1260.0) for y in (0.0, 55.0, -55.0, 110.0, -110.0)),
        _pixels(180.0, (1600, 900), 800.0),
    ),
)
# Five cameras of 50.4 degrees, none to the rear (Sun et al., CVPR 2020).
WAYMO = Rig(
    "waymo",
    (
        *(_pixels(y, (1920, 1280), 2050.0) for y in (0.0, 45.0, -45.0)),
        *(_pixels(y, (1920, 886), 2050.0) for y in (90.0, -90.0)),
    ),
)
# Seven ring cameras, the front one upright (Wilson et al. 2021, arXiv:2301.00493).
ARGOVERSE2 = Rig(
    "argoverse2",
    (
        _pixels(0.0, (1550, 2048), 1690.0),
        *(_pixels(y, (2048, 1550), 1690.0) for y in (45.0, -45.0, 99.0, -99.0, 153.0, -153.0)),
    ),
)
RIGS = (PANDASET, SYNTHETIC, NUSCENES, WAYMO, ARGOVERSE2)
# Probabilities of the RIGS. PandaSet and the synthetic street, on which the networks are evaluated,
# are the most frequent. Chosen, not measured.
_WEIGHTS = (0.4, 0.2, 0.16, 0.12, 0.12)


@dataclass(frozen=True)
class MaskConfig:
    """Random deviations of masks from the nominal rig."""

    tilt_deg: float = 1.5
    """Standard deviation of pitch and roll of the vehicle and its rig."""
    scale: float = 0.12
    """Standard deviation of the log of the focal length."""
    border: float = 0.05
    """Amplitude of the noise of the upper and lower border, as tangents."""
    holes: float = 5.0
    """Mean number of holes: moving actors, leaves, gaps of the stitching."""


def rig_mask(height_px: int, rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Return the visibility mask of a randomly chosen rig; see `mask_of`."""
    rig = RIGS[int(rng.choice(len(RIGS), p=_WEIGHTS))]
    return mask_of(rig, height_px, rng, MaskConfig())


def mask_of(
    rig: Rig, height_px: int, rng: np.random.Generator, config: MaskConfig
) -> Bool[np.ndarray, "h w"]:
    """Return a visibility mask of one rig with random tilt, scale, border, holes and vehicle."""
    directions = grids.directions(height_px).reshape(-1, 3)
    pitch, roll = np.radians(rng.normal(0.0, max(config.tilt_deg, 1e-9), 2))
    yaw = np.radians(rng.normal(0.0, 2.0 * config.tilt_deg + 1e-9))
    turned = directions @ _rotation(yaw, pitch, roll).astype(np.float32)
    scale = np.float32(np.exp(rng.normal(0.0, config.scale + 1e-9)))
    wobble = _border_noise(height_px, rng) * np.float32(config.border)
    seen = np.zeros(len(directions), dtype=bool)
    for camera in rig.cameras:
        seen |= _sees(camera, turned, scale, wobble)
    mask = seen.reshape(height_px, 2 * height_px)
    mask &= ~_holes(height_px, rng, config.holes)
    return mask & ~_ego_vehicle(height_px, rng)


def _sees(
    camera: RigCamera,
    directions: Float32[np.ndarray, "p 3"],
    scale: np.float32,
    wobble: Float32[np.ndarray, " p"],
) -> Bool[np.ndarray, " p"]:
    to_axes = _rotation(np.radians(camera.yaw_deg), np.radians(camera.pitch_deg), 0.0)
    forward, left, up = (directions @ to_axes.astype(np.float32)).T
    # A larger scale (focal length) narrows the field of view.
    safe = np.maximum(forward, 1e-3) / scale
    beside, above = left / safe, up / safe
    inside = (np.abs(beside) < camera.half_width) & (above < camera.up + wobble)
    return inside & (above > -camera.down + wobble) & (forward > 1e-3)


def _rotation(yaw: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation (columns: forward, left, up) of yaw, then pitch up, then roll."""
    # Positive pitch about the left axis points down, hence the sign.
    return Rotation.from_euler("ZYX", [yaw, -pitch, roll]).as_matrix()


def _border_noise(height_px: int, rng: np.random.Generator) -> Float32[np.ndarray, " p"]:
    """Return border noise by azimuth, equal in all rows: waves, in half of the masks also jags."""
    width = 2 * height_px
    azimuth = np.arange(width) * (2 * np.pi / width)
    waves = sum(
        rng.normal() / k * np.sin(k * azimuth + rng.uniform(0, 2 * np.pi)) for k in (2, 3, 5, 9)
    )
    jags = rng.normal(0.0, 0.5, width) * float(rng.random() < 0.5)
    return np.tile((waves + jags).astype(np.float32), height_px)


def _holes(height_px: int, rng: np.random.Generator, mean: float) -> Bool[np.ndarray, "h w"]:
    """Return random boxes: large ones about the horizon (actors), and small ones above it."""
    width = 2 * height_px
    holes = np.zeros((height_px, width), dtype=bool)
    for _ in range(int(rng.poisson(mean))):
        is_actor = rng.random() < 0.6
        high = int(height_px * (rng.uniform(0.02, 0.16) if is_actor else rng.uniform(0.01, 0.08)))
        wide = int(height_px * rng.uniform(0.03, 0.3 if is_actor else 0.12))
        middle = rng.uniform(0.48, 0.6) if is_actor else rng.uniform(0.2, 0.6)
        top = max(0, int(height_px * middle) - high // 2)
        columns = (int(rng.integers(width)) + np.arange(max(1, wide))) % width
        holes[top : top + max(1, high), columns] = True
    return holes


def _ego_vehicle(height_px: int, rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the ego vehicle, below a line in the lower half; empty for some rigs."""
    mask = np.zeros((height_px, 2 * height_px), dtype=bool)
    if rng.random() < 0.6:
        azimuth = (np.arange(2 * height_px) + 0.5) / height_px * np.pi
        line = rng.uniform(0.68, 0.85) + rng.uniform(0.0, 0.06) * np.cos(2 * azimuth)
        mask = (np.arange(height_px)[:, None] + 0.5) / height_px > line
    return mask


def front_view(
    panorama: Float32[np.ndarray, "h w 3"], size_px: tuple[int, int], rng: np.random.Generator
) -> Float32[np.ndarray, "a b 3"]:
    """Sample a forward pinhole image, 58 to 68 degrees wide, with small random rotations."""
    rows, columns = size_px
    half = float(np.tan(np.radians(rng.uniform(58.0, 68.0) / 2)))
    pitch, roll, yaw = np.radians(rng.normal(0.0, 1.5, 3))
    # Tangents at the pixel centres; left and up are positive.
    left = -((np.arange(columns) + 0.5) / columns * 2 - 1) * half
    up = -((np.arange(rows) + 0.5) / rows * 2 - 1) * half * rows / columns
    grid = np.stack(
        [np.ones((rows, columns)), *np.broadcast_arrays(left[None], up[:, None])], axis=-1
    )
    grid /= np.linalg.norm(grid, axis=-1, keepdims=True)
    turned = (grid @ _rotation(yaw, pitch, roll).T).astype(np.float32)
    return sample_bilinear(panorama, turned)
