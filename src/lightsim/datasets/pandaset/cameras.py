"""PandaSet's camera folders: intrinsics, poses, times and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import (
    RigidTransform,
    Trajectory,
    matrices_from_quaternions,
    rotation_from_vector,
    vector_from_rotation,
)
from lightsim.core.sensors import CameraFrame, RollingShutter
from lightsim.datasets.files import (
    read_json,
    read_times_ns,
    require_list,
    require_numbers,
    require_object,
)
from lightsim.datasets.pandaset.numbered import PICTURES, numbered_files
from lightsim.datasets.pictures import image_size, load_image
from lightsim.datasets.plausible import check_intrinsics, check_poses
from lightsim.errors import InputError


@dataclass(frozen=True, eq=False)
class CameraFolder:
    """One camera of the log: model, poses at all listed times, existing pictures, and notes."""

    camera: PinholeCamera
    world_from_camera: Trajectory
    frames: tuple[CameraFrame, ...]
    notes: tuple[str, ...] = ()


def read_camera(folder: Path, readout_s: float, digits: int) -> CameraFolder:
    """Read a camera folder; pictures are opened for their size only.

    PandaSet's times mark the end of the readout (measured on sequence 002 by depth edges: the
    middle row was read 18 ms before, between 8 and 30 ms in the six cameras;
    docs/decisions/0004-alignment-stage.md). Time and pose of a frame are those of its middle row.

    Args:
        folder: folder of the camera.
        readout_s: time from the top row to the bottom row; 0 for a global shutter.
        digits: number of digits of stems.

    Raises:
        InputError: a file is missing, broken or implausible (plausible.py), pictures differ in
            size, or a picture's number lies beyond the lists of poses and times.
    """
    times_ns = read_times_ns(folder / "timestamps.json")
    matrices = read_poses(folder / "poses.json")
    if len(times_ns) != len(matrices):
        raise InputError(
            "poses and times differ in number",
            where=folder / "poses.json",
            got=f"{len(matrices)} poses, {len(times_ns)} times",
            expected="one pose a time",
        )
    trajectory = Trajectory("world", folder.name, times_ns, matrices)
    notes = check_poses(folder / "poses.json", trajectory)
    pictures = numbered_files(folder, PICTURES)
    images = pictures.paths
    if not images:
        raise InputError("the camera has no pictures", where=folder, expected=PICTURES.example)
    last = max(images)
    if last >= len(times_ns):
        raise InputError(
            "the picture's number exceeds the lists of poses and times",
            where=images[last],
            got=last,
            expected=f"0 to {len(times_ns) - 1}",
        )
    camera, lens_notes = _read_intrinsics(folder, list(images.values()))
    velocities = _velocities(trajectory)
    frames = tuple(
        _frame(
            trajectory,
            index,
            f"{index:0{digits}d}",
            partial(load_image, path, camera.width_px, camera.height_px),
            RollingShutter(readout_s, *velocities[index]),
        )
        for index, path in images.items()
    )
    return CameraFolder(camera, trajectory, frames, (*notes, *lens_notes, *pictures.notes))


def _frame(
    trajectory: Trajectory,
    index: int,
    stem: str,
    load: Callable[[], UInt8[np.ndarray, "h w 3"]],
    motion: RollingShutter,
) -> CameraFrame:
    """Return the picture with the time and pose of its middle row."""
    # The stored time is that of the end of the readout, half a readout after the middle row.
    back_s = motion.readout_s / 2
    matrix = trajectory.matrices[index].copy()
    turn = rotation_from_vector(-back_s * motion.angular_velocity_rad_s)
    matrix[:3, :3] = turn @ matrix[:3, :3]
    matrix[:3, 3] -= back_s * motion.velocity_m_s
    return CameraFrame(
        trajectory.src,
        stem,
        int(trajectory.times_ns[index]) - round(back_s * 1e9),
        RigidTransform("world", "camera", matrix),
        load,
        motion if motion.readout_s > 0 else None,
    )


def _velocities(
    trajectory: Trajectory,
) -> list[tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]]:
    """Return linear and angular velocity at each pose, frame `world`, from neighbouring poses."""
    last = len(trajectory) - 1
    if last == 0:
        return [(np.zeros(3), np.zeros(3))]
    found: list[tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]] = []
    # Central differences; one-sided at both ends.
    for i in range(last + 1):
        before, after = max(i - 1, 0), min(i + 1, last)
        seconds = float(trajectory.times_ns[after] - trajectory.times_ns[before]) * 1e-9
        step = trajectory.positions_m[after] - trajectory.positions_m[before]
        turn = trajectory.matrices[after][:3, :3] @ trajectory.matrices[before][:3, :3].T
        found.append((step / seconds, vector_from_rotation(turn) / seconds))
    return found


def read_poses(path: Path) -> Float64[np.ndarray, "n 4 4"]:
    """Read `world_from_sensor` of every entry.

    Raises:
        InputError: a pose is missing, not finite, or its quaternion has no length.
    """
    entries = require_list(read_json(path), path)
    quaternions = np.empty((len(entries), 4))
    matrices = np.tile(np.eye(4), (len(entries), 1, 1))
    for i, entry in enumerate(entries):
        where = f"{path}[{i}]"
        parts = require_object(entry, where)
        for key in ("position", "heading"):
            if key not in parts:
                raise InputError(
                    f"the pose has no '{key}'", where=where, expected="position and heading"
                )
        matrices[i, :3, 3] = require_numbers(parts["position"], ("x", "y", "z"), where)
        quaternions[i] = require_numbers(parts["heading"], ("w", "x", "y", "z"), where)
        length = float(np.linalg.norm(quaternions[i]))
        # Wide limits, since the quaternion is normalised below: other lengths are another quantity.
        if not 0.5 < length < 2.0:
            raise InputError(
                "the heading is not a unit quaternion",
                where=where,
                got=f"length {length:.3g}",
                remedy="Copy the file again from the original data set.",
            )
    matrices[:, :3, :3] = matrices_from_quaternions(quaternions)
    return matrices


def _read_intrinsics(folder: Path, images: Sequence[Path]) -> tuple[PinholeCamera, tuple[str, ...]]:
    path = folder / "intrinsics.json"
    fx, fy, cx, cy = require_numbers(read_json(path), ("fx", "fy", "cx", "cy"), path).tolist()
    sizes = [image_size(image) for image in images]
    for image, size in zip(images, sizes, strict=True):
        if size != sizes[0]:
            raise InputError(
                "the picture's size differs from the camera's other pictures",
                where=image,
                got=f"{size[0]}x{size[1]} px",
                expected=f"{sizes[0][0]}x{sizes[0][1]} px",
            )
    notes = check_intrinsics(path, sizes[0], (fx, fy), (cx, cy))
    # The origin is the centre of the first pixel in PandaSet, its corner in LightSim.
    return PinholeCamera(folder.name, *sizes[0], fx, fy, cx + 0.5, cy + 0.5), notes
