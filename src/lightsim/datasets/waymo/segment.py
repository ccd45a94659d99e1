"""Contents of a segment of the Waymo Open Dataset, which both of its file formats supply."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from lightsim.core.frames import RigidTransform
from lightsim.datasets.lenses import Lens
from lightsim.datasets.plausible import LIMITS, check_intrinsics
from lightsim.datasets.recorded import ReadoutDirection
from lightsim.datasets.waymo.wire import broken
from lightsim.errors import InputError
from lightsim.store.images import decode_texture

# Axes of the data set's cameras (x forward, y left, z up) from those of frame `camera`.
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# RollingShutterReadOutDirection of dataset.proto; 0 is unknown, 5 a global shutter.
_DIRECTIONS = {
    1: ReadoutDirection.TOP_TO_BOTTOM,
    2: ReadoutDirection.LEFT_TO_RIGHT,
    3: ReadoutDirection.BOTTOM_TO_TOP,
    4: ReadoutDirection.RIGHT_TO_LEFT,
}
# Largest side of a picture, in pixels: more than any vehicle camera.
_MAX_SIDE_PX = 20_000


@dataclass(frozen=True, eq=False)
class Camera:
    """Calibration of a camera; `direction` is None for a global shutter."""

    lens: Lens
    ego_from_camera: RigidTransform
    direction: ReadoutDirection | None


@dataclass(frozen=True, eq=False)
class Laser:
    """Calibration of a LiDAR.

    Args:
        ego_from_laser: pose on the vehicle.
        inclinations_rad: elevations of the beams, lowest first; empty where they are uniform.
        range_rad: lowest and highest edge of uniform beams.
    """

    ego_from_laser: RigidTransform
    inclinations_rad: tuple[float, ...]
    range_rad: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture: its exposure, and a pose of the vehicle near it in time.

    Args:
        camera: number of the camera.
        middle_ns: middle of the exposure of the central row or column.
        readout_s: time from the first to the last row or column.
        pose_ns: time of `world_from_ego`.
    """

    camera: int
    middle_ns: int
    readout_s: float
    pose_ns: int
    world_from_ego: RigidTransform
    load: Callable[[], UInt8[np.ndarray, "h w 3"]]


@dataclass(frozen=True, eq=False)
class RangeImages:
    """Range images of the first and second return [range, intensity, ...], and the vehicle's pose
    of each pixel [roll, pitch, yaw, x, y, z] where it is given."""

    returns: tuple[Float32[np.ndarray, "h w c"], ...]
    poses: Float32[np.ndarray, "H W 6"] | None


@dataclass(frozen=True, eq=False)
class Box:
    """A labelled box, frame `ego` at the frame's pose."""

    actor_id: str
    type: int
    centre: Float64[np.ndarray, "3"]
    size_lwh_m: Float64[np.ndarray, "3"]
    heading_rad: float
    speed_m_s: float


@dataclass(frozen=True, eq=False)
class Frame:
    """Contents of one sweep; `start_ns` is its start, but `world_from_ego` is of its middle."""

    start_ns: int
    world_from_ego: RigidTransform
    pictures: tuple[Picture, ...]
    sweeps: Mapping[int, Callable[[], RangeImages]]
    boxes: tuple[Box, ...]


@dataclass(frozen=True, eq=False)
class Segment:
    """A drive of 20 s."""

    name: str
    location: str
    cameras: Mapping[int, Camera]
    lasers: Mapping[int, Laser]
    frames: tuple[Frame, ...]


def transform(dst: str, src: str, values: Sequence[float], where: object) -> RigidTransform:
    """Return a transform of 16 numbers, row by row."""
    if len(values) != 16:
        raise broken(where, f"a matrix of {len(values)} numbers", "16")
    try:
        return RigidTransform(dst, src, np.array(values, dtype=np.float64).reshape(4, 4))
    except InputError as error:
        raise broken(where, f"{error.what}: {error.got}", f"{dst}_from_{src}") from error


def make_camera(
    intrinsic: Sequence[float],
    ego_from_camera: RigidTransform,
    size_px: tuple[int, int],
    direction: int,
    where: object,
) -> Camera:
    """Return a camera of f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3.

    The corner of the first pixel is (0, 0), as in LightSim: dataset.proto states this of projected
    points, and third_party/camera/camera_model.cc accepts u from 0 up to the width.
    """
    if len(intrinsic) != 9 or not all(0 < side <= _MAX_SIDE_PX for side in size_px):
        got = f"{len(intrinsic)} intrinsics for {size_px[0]}x{size_px[1]} px"
        raise broken(where, got, "9 intrinsics, and the size of the pictures")
    fx, fy, cx, cy = intrinsic[:4]
    # Its notes are of the axis of side cameras, whose pictures are cropped by design.
    check_intrinsics(Path(str(where)), size_px, (fx, fy), (cx, cy))
    lens = Lens("brown", *size_px, fx, fy, cx, cy, tuple(intrinsic[4:]))
    own_axes = RigidTransform.from_rotation("waymo camera", "camera", _AXES, np.zeros(3))
    return Camera(lens, ego_from_camera @ own_axes, _DIRECTIONS.get(direction))


def make_picture(
    camera: int,
    times_s: tuple[float, float, float, float],
    world_from_ego: RigidTransform,
    load: Callable[[], UInt8[np.ndarray, "h w 3"]],
    where: object,
) -> Picture:
    """Return a picture with the times of dataset.proto.

    The camera is triggered when the exposure of the first column starts, and done when the last
    column is read: the centre is exposed half-way, and the readout is shorter by the exposure.

    Args:
        times_s: pose_timestamp, shutter (the exposure), camera_trigger_time and
            camera_readout_done_time.
    """
    pose_s, shutter_s, trigger_s, done_s = times_s
    middle_ns = time_ns((trigger_s + done_s) / 2, where)
    pose_ns = time_ns(pose_s, where)
    if abs(middle_ns - pose_ns) > 1_000_000_000:
        raise broken(where, f"a pose {(middle_ns - pose_ns) * 1e-9:.3g} s before the picture")
    return Picture(camera, middle_ns, done_s - trigger_s - shutter_s, pose_ns, world_from_ego, load)


def make_box(
    actor_id: str, kind: int, numbers: Sequence[float], speed_m_s: float, where: object
) -> Box:
    """Return a box of centre x, y, z, length, width, height and heading."""
    values = np.array(numbers, dtype=np.float64)
    if not actor_id:
        raise broken(where, "a box without a name")
    distance_m = float(np.linalg.norm(values[:3]))
    LIMITS["box distance"].check(where, distance_m, f"{distance_m:.4g} m from the vehicle")
    return Box(actor_id, kind, values[:3], values[3:6], float(values[6]), speed_m_s)


def time_ns(seconds: float, where: object) -> int:
    """Return nanoseconds of a POSIX time, rounded to microseconds, which doubles resolve."""
    if not 3.1e8 < seconds < 4.2e9:
        raise broken(where, f"a time of {seconds} s", "UTC seconds between 1980 and 2100")
    return round(seconds * 1e6) * 1000


def decode_picture(data: bytes, lens: Lens, where: object) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pixels of a JPEG; it must have the size of the calibration."""
    expected = f"a picture of {lens.width_px}x{lens.height_px} px"
    try:
        pixels = decode_texture(data)[..., :3]
    except ValueError as error:
        raise broken(where, error, expected) from error
    if pixels.shape[:2] != (lens.height_px, lens.width_px):
        raise broken(where, f"{pixels.shape[1]}x{pixels.shape[0]} px", expected)
    return np.ascontiguousarray(pixels)
