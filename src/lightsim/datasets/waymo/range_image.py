"""Returns of a LiDAR from range images, whose rows are beams and whose columns are azimuths."""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from lightsim.datasets.recorded import PointFrame, RawSweep
from lightsim.datasets.waymo.segment import Laser, RangeImages
from lightsim.datasets.waymo.wire import Span, Wire, broken

# Largest range image, in bytes: that of the top LiDAR with 64 rows, 2650 columns and 6 channels
# takes 4 MB.
_MAX_BYTES = 64 << 20
# Time of one turn, in seconds.
_TURN_S = 0.1
# Farthest return, in metres; the data set cuts the top LiDAR off at 75 m.
_MAX_RANGE_M = 1000.0


def unpack_matrix(data: bytes, channels: int, where: object) -> Float32[np.ndarray, "h w c"]:
    """Return a compressed MatrixFloat of dataset.proto.

    Raises:
        InputError: it is damaged, too large, or has fewer channels.
    """
    stream = zlib.decompressobj()
    try:
        plain = stream.decompress(data, _MAX_BYTES)
    except zlib.error as error:
        raise broken(where, error, "a range image compressed with zlib") from error
    if not stream.eof:
        got = f"{len(plain)} bytes, then more or nothing"
        raise broken(where, got, f"a whole range image of at most {_MAX_BYTES} bytes")
    wire = Wire(io.BytesIO(plain), where)
    matrix = wire.message(Span(0, len(plain)), "range image")
    dims = matrix.message(2, "shape").wholes(1)
    spans = matrix.spans(1)
    values = wire.read(spans[-1], _MAX_BYTES) if spans else b""
    return shaped(np.frombuffer(values[: len(values) // 4 * 4], "<f4"), dims, channels, where)


def shaped(
    values: Float32[np.ndarray, " n"], dims: Sequence[object], channels: int, where: object
) -> Float32[np.ndarray, "h w c"]:
    """Return numbers as an array of rows, columns and at least `channels` channels.

    Raises:
        InputError: the numbers are not as many as the dimensions demand.
    """
    sizes: list[int] = [size for size in dims if isinstance(size, int)]
    height, width, depth = sizes if len(sizes) == 3 else (0, 0, 0)
    if min(height, width) < 1 or depth < channels or height * width * depth != len(values):
        got = f"{len(values)} numbers for dimensions {dims!r:.60}"
        raise broken(where, got, f"rows, columns and {channels} channels")
    # Conversion of signalling NaN to doubles would be a warning.
    values = np.where(np.isfinite(values), values, np.float32(np.nan))
    return values.reshape(height, width, depth)


def make_sweep(images: RangeImages, laser: Laser, start_s: float, where: object) -> RawSweep:
    """Return the returns of one sweep.

    The first column looks backwards and is measured first; the turn is clockwise from above: the
    cameras, which fire when the top LiDAR points where they look, are exposed within 1 ms of it.
    Beams of one column fire some milliseconds apart, which the data set does not contain; poses
    of pixels are of their true times.

    Args:
        start_s: start of the turn, from the time of the sweep.
    """
    parts = [_returns(image, images.poses, laser, where) for image in images.returns]
    points, origins, intensity, column, row = (
        np.concatenate(columns) for columns in zip(*parts, strict=True)
    )
    width = images.returns[0].shape[1]
    offset_s = start_s + (column + 0.5) / width * _TURN_S
    # Intensities are not bounded: retroreflectors have up to 5e4 (waymo-open-dataset#59, #226).
    # Most surfaces are below 1, so that clipping keeps their ratios, which the tanh that #93
    # advises would not.
    intensity = np.clip(intensity, 0.0, 1.0)
    origin_ego = laser.ego_from_laser.translation_m
    if images.poses is None:
        # "Virtual" range images of dataset.proto: points and centre are moved to the frame's pose.
        return RawSweep(points, PointFrame.SWEEP_TIME, origin_ego, intensity, None, row)
    return RawSweep(
        points, PointFrame.WORLD, origin_ego, intensity, offset_s, row, origins_world=origins
    )


_Returns = tuple[
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, " n"],
    Int64[np.ndarray, " n"],
    Int64[np.ndarray, " n"],
]
"""Points, origins, intensities, columns and rows."""


def _returns(
    image: Float32[np.ndarray, "h w c"],
    poses: Float32[np.ndarray, "H W 6"] | None,
    laser: Laser,
    where: object,
) -> _Returns:
    """Return points and origins: in the world where pixels have poses, else on the vehicle."""
    height, width = image.shape[:2]
    if poses is not None and poses.shape[:2] != (height, width):
        raise broken(where, f"poses {poses.shape[:2]} for an image {height}x{width}", "equal sizes")
    distance_m, intensity = image[..., 0], image[..., 1]
    # Pixels without a return have range 0 or -1.
    is_return = (distance_m > 0) & (distance_m < _MAX_RANGE_M)
    row, column = (index.astype(np.int64) for index in np.nonzero(is_return))
    rays = _directions(laser, row, column, (height, width), where)
    distance = distance_m[row, column].astype(np.float64)[:, None]
    points = laser.ego_from_laser.apply(rays * distance)
    origins = np.broadcast_to(laser.ego_from_laser.translation_m, points.shape).copy()
    if poses is not None:
        points, origins = _moved(poses[row, column].astype(np.float64), points, origins)
    return points, origins, intensity[row, column].astype(np.float64), column, row


def _moved(
    poses: Float64[np.ndarray, "n 6"],
    points: Float64[np.ndarray, "n 3"],
    origins: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Move points and origins by the poses; those without a pose become NaN."""
    # Poses of zeros are found in rows near the vehicle (simple-waymo-open-dataset-reader#6).
    is_posed = np.logical_and(np.isfinite(poses).all(axis=1), (poses != 0).any(axis=1))
    angles = np.where(is_posed[:, None], poses[:, :3], 0.0)
    turns = Rotation.from_euler("ZYX", angles[:, ::-1])
    shift = np.where(is_posed[:, None], poses[:, 3:], np.nan)
    return turns.apply(points) + shift, turns.apply(origins) + shift


def _directions(
    laser: Laser,
    row: Int64[np.ndarray, " n"],
    column: Int64[np.ndarray, " n"],
    size: tuple[int, int],
    where: object,
) -> Float64[np.ndarray, "n 3"]:
    """Return unit vectors of pixels in the frame of the LiDAR."""
    height, width = size
    inclinations = np.array(laser.inclinations_rad)
    if not len(inclinations):
        low, high = laser.range_rad
        inclinations = low + (np.arange(height) + 0.5) / height * (high - low)
    if len(inclinations) != height:
        raise broken(where, f"{height} rows for {len(inclinations)} beams", "a row for each beam")
    # The first row is the highest beam. Columns are azimuths on the vehicle, of which the
    # LiDAR's yaw is subtracted.
    inclination = inclinations[::-1][row]
    azimuth = np.pi * (1 - 2 * (column + 0.5) / width) - laser.ego_from_laser.yaw_rad
    flat = np.cos(inclination)
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination)], axis=1)
