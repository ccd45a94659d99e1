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
EGO_BELOW_LIDAR_M = 2.2
READOUT_S = 0.03
"""PandaSet's cameras read their rows one after another. The published calibration does not say
how fast; where it has a line `readout_s:` for a camera, that holds."""
_FRONT = "front_camera"
_LIDAR = "main_pandar64"
_FRONT_LIDAR = "front_gt"

_MAX_BYTES = 1 << 20
"""The published file has 2.7 kB."""
_MAX_DIGITS = 40
"""Characters of a number; a double printed in full has 24."""
_LETTERS_BY_KEY = {"rotation": "wxyz", "translation": "xyz", "readout_s": "s"}


@dataclass(frozen=True)
class Rig:
    """Static calibration.

    Args:
        camera_from_pandar64: by camera name.
        front_lidar_pandar64: origin of the forward PandarGT, metres in frame `pandar64`.
        readout_s_by_camera: cameras whose readout the calibration gives; READOUT_S for others.
        notes: what was assumed.
    """

    camera_from_pandar64: Mapping[str, RigidTransform]
    front_lidar_pandar64: Float64[np.ndarray, "3"]
    readout_s_by_camera: Mapping[str, float]
    notes: tuple[str, ...] = ()


def ego_from_pandar64() -> RigidTransform:
    """Axes x forward, y left, z up, origin on the road below the roof LiDAR."""
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform.from_rotation(
        "ego", "pandar64", rotation, np.array([0.0, 0.0, EGO_BELOW_LIDAR_M])
    )


def nominal_rig() -> Rig:
    """The rig where a log brings no calibration file: the front camera sits just below and before
    the LiDAR and looks straight ahead (right to within 2 degrees and 2 cm)."""
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
            f"no {CALIBRATION_FILE} beside the log: the ego's path rests on a nominal mounting of "
            "the front camera",
        ),
    )


def read_rig(folder: Path) -> Rig:
    """The rig of a log: its own calibration file, else one beside the logs, else nominal.

    Raises:
        InputError: a calibration file is there but broken.
    """
    path = calibration_path(folder)
    return nominal_rig() if path is None else _parse_rig(path)


def calibration_path(folder: Path) -> Path | None:
    """The calibration file that holds for a log: its own, else the one beside the logs."""
    paths = (folder / CALIBRATION_FILE, folder.parent / CALIBRATION_FILE)
    return next((path for path in paths if has_file(path)), None)


def ego_trajectory(
    rig: Rig, world_from_camera: Mapping[str, Trajectory], where: object
) -> Trajectory:
    """`world_from_ego` at the front camera's times, prolonged by the other cameras' poses.

    Camera poses are used because PandaSet's stored LiDAR poses belong to another, unnamed frame.
    The cameras disagree by a constant 1 to 2 cm; before they prolong the path, that offset to the
    front camera is taken out.

    Args:
        rig: static calibration.
        world_from_camera: poses by camera name; frames `world` and the camera's name.
        where: named in errors.

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
    """World positions of a point fixed to the ego, at constant velocity between its poses.

    The last sweep ends some 20 ms after the last camera pose, so the end velocities are continued
    beyond the poses; the reader lets no sweep be more than 0.2 s away from them.
    """
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
    """`path` with its mean offset to `reference` (in frame ego) taken out."""
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
    u, _, vt = np.linalg.svd(offsets[:, :3, :3].mean(axis=0))
    mean[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    mean[:3, 3] = offsets[:, :3, 3].mean(axis=0)
    return Trajectory("world", "ego", path.times_ns, path.matrices @ mean)


def _parse_rig(path: Path) -> Rig:
    """The published file is plain enough that a YAML package would be one dependency too many."""
    try:
        text = read_bytes(path, "calibration", _MAX_BYTES).decode()
    except UnicodeDecodeError as error:
        raise InputError(
            "the calibration is no text", where=path, got=error, expected="YAML in UTF-8"
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
            "the calibration names no sensor",
            where=path,
            expected="blocks 'camera: extrinsic: transform: rotation, translation'",
        )
    others = {k: t for k, t in transforms.items() if k not in (_LIDAR, _FRONT_LIDAR)}
    if _FRONT_LIDAR in transforms:
        # Unlike the cameras' entries this one reads pandar64_from_sensor: its scan lines lie in
        # planes through that point (0.17 against 0.61 degrees the other way round).
        return Rig(others, transforms[_FRONT_LIDAR].translation_m.copy(), readouts)
    return Rig(others, nominal_rig().front_lidar_pandar64, readouts)


_Numbers = dict[str, dict[str, float]]
"""What a sensor has under each key of interest, by letter."""


def _sensors(text: str) -> dict[str, _Numbers]:
    """The numbers of every sensor: names start in the first column, all else is indented.

    Split into words, never searched with patterns: those can take time in the square of the text.
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
    """The number that a word spells, or NaN, which is no part of a calibration."""
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
