"""PandaSet's sensor rig and the ego's motion, from camera poses and the static calibration.

Frames: `pandar64` is the roof LiDAR's own frame (x left, y backward, z up in the published
calibration). `ego` has its axes as x forward, y left, z up, and its origin EGO_BELOW_LIDAR_M below
it, nominally on the road. The LiDAR's mounting tilt of about one degree is not removed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.layout import has_file
from lightsim.datasets.plausible import check_mounting, check_readout
from lightsim.errors import InputError
from lightsim.store.reading import read_bytes

CALIBRATION_FILE = "static_extrinsic_calibration.yaml"
# Nominal height of the roof LiDAR above the road, in metres; not measured for single vehicles.
EGO_BELOW_LIDAR_M = 2.2
READOUT_S = 0.03
"""Readout time of PandaSet's rolling shutters, in seconds, which the published calibration does not
contain. A line `readout_s:` of a camera in the calibration overrides it."""
_FRONT = "front_camera"
_LIDAR = "main_pandar64"
_FRONT_LIDAR = "front_gt"

# Largest calibration file; the published one has 2.7 kB.
_MAX_BYTES = 1 << 20
# Longest number in characters; a double in full has 24.
_MAX_DIGITS = 40
_LETTERS_BY_KEY = {"rotation": "wxyz", "translation": "xyz", "readout_s": "s"}


@dataclass(frozen=True)
class Rig:
    """Static calibration of the sensors.

    Args:
        camera_from_pandar64: transforms by camera name.
        front_lidar_pandar64: origin of the forward PandarGT, metres in frame `pandar64`.
        readout_s_by_camera: readout times of the calibration; READOUT_S for other cameras.
        notes: assumptions.
    """

    camera_from_pandar64: Mapping[str, RigidTransform]
    front_lidar_pandar64: Float64[np.ndarray, "3"]
    readout_s_by_camera: Mapping[str, float]
    notes: tuple[str, ...] = ()


def ego_from_pandar64() -> RigidTransform:
    """Return the transform to frame `ego`: x forward, y left, z up, origin on the road."""
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform.from_rotation(
        "ego", "pandar64", rotation, np.array([0.0, 0.0, EGO_BELOW_LIDAR_M])
    )


def nominal_rig() -> Rig:
    """Return the rig of logs without a calibration file: the front camera is just below and in
    front of the LiDAR and points straight ahead (within 2 degrees and 2 cm of the published
    calibration)."""
    rotation = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    centre_pandar64 = np.array([0.0, -0.04, -0.04])
    transform = RigidTransform.from_rotation(
        _FRONT, "pandar64", rotation, -rotation @ centre_pandar64
    )
    return Rig(
        {_FRONT: transform},
        np.array([0.0, -0.6, -0.3]),
        {},
        (
            f"no {CALIBRATION_FILE} beside the log: the ego's path is computed with a nominal "
            "mounting of the front camera",
        ),
    )


def read_rig(folder: Path) -> Rig:
    """Read the rig of a log: its own calibration file, else one beside the logs, else nominal.

    Raises:
        InputError: the calibration file is broken.
    """
    path = calibration_path(folder)
    return nominal_rig() if path is None else _parse_rig(path)


def calibration_path(folder: Path) -> Path | None:
    """Return the calibration file of a log: its own, else the one beside the logs."""
    paths = (folder / CALIBRATION_FILE, folder.parent / CALIBRATION_FILE)
    return next((path for path in paths if has_file(path)), None)


def ego_trajectory(
    rig: Rig, world_from_camera: Mapping[str, Trajectory], where: object
) -> Trajectory:
    """Return `world_from_ego` at the times of the front camera, extended by poses of other cameras.

    Camera poses are used because PandaSet's stored LiDAR poses refer to another, unnamed frame. The
    cameras disagree by a constant 1 to 2 cm; this offset to the front camera is removed before they
    extend the path.

    Args:
        rig: static calibration.
        world_from_camera: poses by camera name; frames `world` and the name of the camera.
        where: log, for error messages.

    Raises:
        InputError: no camera of the log is in the calibration.
    """
    names = [name for name in world_from_camera if name in rig.camera_from_pandar64]
    if not names:
        raise InputError(
            "no camera of the log is in the calibration, so the ego's path is unknown",
            where=where,
            got=", ".join(world_from_camera) or "no camera",
            expected="front_camera, or a camera named in " + CALIBRATION_FILE,
        )
    # The front camera is the reference if it is calibrated.
    names.sort(key=lambda name: (name != _FRONT, name))
    paths = [_ego_path(rig, name, world_from_camera[name]) for name in names]
    reference = paths[0]
    earliest = min(paths, key=lambda path: path.start_ns)
    latest = max(paths, key=lambda path: path.end_ns)
    before = _aligned(earliest, reference)
    after = _aligned(latest, reference)
    is_before = before.times_ns < reference.start_ns
    is_after = after.times_ns > reference.end_ns
    return Trajectory(
        "world",
        "ego",
        np.concatenate([before.times_ns[is_before], reference.times_ns, after.times_ns[is_after]]),
        np.concatenate([before.matrices[is_before], reference.matrices, after.matrices[is_after]]),
    )


def positions_along(
    ego: Trajectory, point_ego: Float64[np.ndarray, "3"], times_ns: np.ndarray
) -> Float64[np.ndarray, "n 3"]:
    """Return world positions of a point fixed to the ego, at constant velocity between poses.

    The last sweep ends some 20 ms after the last camera pose, so the motion is extrapolated at
    constant velocity; the reader accepts sweeps up to 0.2 s beyond the poses.
    """
    # Positions are interpolated, not poses: over 0.1 s the arc differs from its chord by
    # millimetres.
    knots = ego.matrices[:, :3, :3] @ point_ego + ego.positions_m
    if len(ego) == 1:
        return np.tile(knots, (len(times_ns), 1))
    segment = np.clip(np.searchsorted(ego.times_ns, times_ns) - 1, 0, len(ego) - 2)
    span = (ego.times_ns[segment + 1] - ego.times_ns[segment]).astype(np.float64)
    fraction = ((times_ns - ego.times_ns[segment]) / span)[:, None]
    return (1.0 - fraction) * knots[segment] + fraction * knots[segment + 1]


def _ego_path(rig: Rig, name: str, world_from_camera: Trajectory) -> Trajectory:
    camera_from_ego = rig.camera_from_pandar64[name] @ ego_from_pandar64().inverse()
    return Trajectory(
        "world",
        "ego",
        world_from_camera.times_ns,
        world_from_camera.matrices @ camera_from_ego.matrix,
    )


def _aligned(path: Trajectory, reference: Trajectory) -> Trajectory:
    """Return `path` without its mean offset to `reference`, in frame `ego`."""
    if path is reference:
        return path
    is_shared = (path.times_ns >= reference.start_ns) & (path.times_ns <= reference.end_ns)
    if not is_shared.any():
        return path
    offsets = np.stack(
        [
            np.linalg.inv(matrix) @ reference.at(int(time_ns)).matrix
            for time_ns, matrix in zip(
                path.times_ns[is_shared], path.matrices[is_shared], strict=True
            )
        ]
    )
    mean = np.eye(4)
    # The mean of rotations: the rotation nearest to the mean of the matrices; the determinant
    # excludes a reflection.
    u, _, vt = np.linalg.svd(offsets[:, :3, :3].mean(axis=0))
    mean[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    mean[:3, 3] = offsets[:, :3, 3].mean(axis=0)
    return Trajectory("world", "ego", path.times_ns, path.matrices @ mean)


def _parse_rig(path: Path) -> Rig:
    """Parse a calibration file, whose simple subset of YAML needs no package."""
    try:
        text = read_bytes(path, "calibration", _MAX_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            "the calibration is not text", where=path, got=error, expected="YAML in UTF-8"
        ) from error
    transforms: dict[str, RigidTransform] = {}
    readouts: dict[str, float] = {}
    for name, numbers in _sensors(text).items():
        where = f"{path}, '{name}'"
        quaternion = _complete("rotation", numbers, where)
        translation = _complete("translation", numbers, where)
        check_mounting(where, translation)
        transforms[name] = _transform(name, quaternion, translation, path)
        if "readout_s" in numbers:
            readouts[name] = float(_complete("readout_s", numbers, where)[0])
            check_readout(where, readouts[name])
    if not transforms:
        raise InputError(
            "the calibration contains no sensor",
            where=path,
            expected="blocks 'camera: extrinsic: transform: rotation, translation'",
        )
    others = {k: t for k, t in transforms.items() if k not in (_LIDAR, _FRONT_LIDAR)}
    if _FRONT_LIDAR in transforms:
        # Unlike the entries of cameras, this one is pandar64_from_sensor: scan lines lie in planes
        # through that point (residual 0.17 degrees, 0.61 for the inverse; no script repeats this).
        return Rig(others, transforms[_FRONT_LIDAR].translation_m.copy(), readouts)
    return Rig(others, nominal_rig().front_lidar_pandar64, readouts)


# Numbers of a sensor by key and letter.
_Numbers = dict[str, dict[str, float]]


def _sensors(text: str) -> dict[str, _Numbers]:
    """Return the numbers of every sensor: names start in the first column, other lines are
    indented.

    The text is split into words without regular expressions, which may need quadratic time.
    """
    found: dict[str, _Numbers] = {}
    numbers: _Numbers = {}
    key = letter = ""
    for line in text.splitlines():
        line = line.partition("#")[0].rstrip()
        if line[:1].strip():
            numbers = {}
            key = letter = ""
            name = line.removesuffix(":")
            if line.endswith(":") and name.replace("_", "a").isalnum():
                found[name] = numbers
            continue
        for word in line.translate(_SPACED).split():
            if word.endswith(":"):
                letter = word[:-1]
                if letter not in tuple("wxyz"):
                    key, letter = letter, "s"
            elif key in _LETTERS_BY_KEY and letter:
                numbers.setdefault(key, {})[letter] = _number(word)
                letter = ""
    return found


_SPACED = str.maketrans({"{": " ", "}": " ", ",": " ", ":": ": "})


def _number(word: str) -> float:
    """Return the number of a word, or NaN, which a calibration must not contain."""
    try:
        return float(word) if len(word) <= _MAX_DIGITS else np.nan
    except ValueError:
        return np.nan


def _complete(key: str, numbers: _Numbers, where: str) -> Float64[np.ndarray, " n"]:
    letters = _LETTERS_BY_KEY[key]
    values = numbers.get(key, {})
    if set(values) != set(letters) or not all(abs(v) <= MAX_NUMBER for v in values.values()):
        raise InputError(
            f"the {key} is incomplete",
            where=where,
            got=", ".join(f"{k} {v}" for k, v in values.items()) or "nothing",
            expected=f"numbers {', '.join(letters)}",
        )
    return np.array([values[letter] for letter in letters])


def _transform(
    name: str,
    quaternion_wxyz: Float64[np.ndarray, "4"],
    translation_m: Float64[np.ndarray, "3"],
    path: Path,
) -> RigidTransform:
    try:
        return RigidTransform.from_quaternion(name, "pandar64", quaternion_wxyz, translation_m)
    except InputError as error:
        raise InputError(
            f"the calibration of '{name}' is wrong: {error.what}",
            where=path,
            expected="a rotation w, x, y, z of about unit length",
        ) from error
