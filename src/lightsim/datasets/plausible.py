"""What no recording of a drive can hold is refused, what it hardly holds is said in a note.

One unit or index gone wrong on the way to us (milliseconds for seconds, a wrong column) gives
numbers that every later stage takes without a word. Each limit lies well outside what recorded
drives show, so that a plain error passes none of them and an odd log all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import Trajectory, vector_from_rotation
from lightsim.errors import InputError

MAX_SPEED_M_S = 150.0
"""540 km/h: no road vehicle; one pose 15 m off at 10 Hz gives it."""
FAST_M_S = 80.0
"""288 km/h: a race track, or poses with errors."""
MAX_TURN_RAD_S = 2.0 * np.pi
"""One turn a second: no vehicle spins faster, not even in a crash."""
MAX_COORDINATE_M = 1e5
"""Points are single precision: beyond 100 km from the origin they lie 8 mm apart or more."""
MIN_VIEW_DEG, MAX_VIEW_DEG = 2.0, 170.0
"""Narrower is a telescope (front tele cameras have 10 to 50 degrees); wider no pinhole shows."""
NARROW_VIEW_DEG, WIDE_VIEW_DEG = 10.0, 140.0
"""Outside these a rectified driving camera is odd, though it may exist."""
MAX_PIXEL_ASPECT = 2.0
"""Pixels are square within a percent; anamorphic lenses squeeze by two at most."""
MAX_READOUT_S = 0.1
"""Rows are read before the next picture starts, at 10 Hz or more."""
SLOW_READOUT_S = 0.05
"""Rolling shutters of driving cameras take 5 to 35 ms."""
MAX_MOUNT_M = 30.0
"""Sensors sit on one vehicle, and no road vehicle in one piece is longer."""
MAX_CLOCK_S = 0.5
"""Entries of one number belong to one sweep, a tenth of a second long in PandaSet."""
ODD_CLOCK_S = 0.2
"""Twice a sweep: a sensor that lost a picture and kept counting."""
MAX_RELATIVE_DRIFT_M = 0.5
"""Cameras are fixed to the vehicle: relative to the path they stay within centimetres."""
MAX_GPS_GAP_S = 60.0
"""At city speeds the place is then a kilometre away; and its clock is another."""
MAX_BOX_M = 60.0
"""Trams and road trains stay below; a box of this size swallows the street's own LiDAR returns."""
LONG_BOX_M = 30.0
"""Only trams, trains and road trains are longer."""
MAX_BOX_DISTANCE_M = 1000.0
"""Boxes are drawn around LiDAR returns, and no LiDAR reaches further."""
MAX_RANGE_M = 500.0
"""Automotive LiDARs reach 300 m; half of a sweep's returns beyond this lie in another frame."""


def check_poses(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    """Notes on the poses of one sensor.

    Raises:
        InputError: a coordinate, speed or rate of turn that no vehicle has.
    """
    positions = trajectory.positions_m
    far = int(np.argmax(np.abs(positions).max(axis=1)))
    if np.abs(positions[far]).max() > MAX_COORDINATE_M:
        raise InputError(
            "the pose lies too far from the world's origin",
            where=f"{path}[{far}]",
            got=f"position {positions[far].tolist()} m",
            expected=f"coordinates within {MAX_COORDINATE_M:g} m",
            remedy="Move the log's world frame near to the drive.",
        )
    if len(trajectory) < 2:
        return ()
    seconds = np.diff(trajectory.times_ns) * 1e-9
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / seconds
    i = int(np.argmax(speeds))
    if speeds[i] > MAX_SPEED_M_S:
        raise InputError(
            "the pose is too far from the one before",
            where=f"{path}[{i + 1}]",
            got=f"{speeds[i]:.4g} m/s",
            expected=f"at most {MAX_SPEED_M_S:g} m/s",
            remedy="Check the positions (metres) and the times (seconds).",
        )
    _check_turns(path, trajectory, seconds)
    if speeds[i] > FAST_M_S:
        return (f"{path.parent.name} moves at {speeds[i]:.0f} m/s: poses or times may be wrong",)
    return ()


def _check_turns(path: Path, trajectory: Trajectory, seconds: Float64[np.ndarray, " n"]) -> None:
    rotations = trajectory.matrices[:, :3, :3]
    turns = [
        float(np.linalg.norm(vector_from_rotation(after @ before.T)))
        for before, after in pairwise(rotations)
    ]
    rates = np.array(turns) / seconds
    i = int(np.argmax(rates))
    if rates[i] > MAX_TURN_RAD_S:
        raise InputError(
            "the pose is turned too far from the one before",
            where=f"{path}[{i + 1}]",
            got=f"{np.degrees(turns[i]):.0f} degrees in {seconds[i]:.3g} s",
            expected=f"at most {np.degrees(MAX_TURN_RAD_S):.0f} degrees a second",
            remedy="Check the quaternions (w, x, y, z) and the times (seconds).",
        )


def check_intrinsics(
    path: Path,
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
) -> tuple[str, ...]:
    """Notes on a pinhole camera's numbers.

    Args:
        path: of the file, for messages.
        size_px: width and height of its pictures.
        focal_px: fx, fy.
        centre_px: cx, cy.

    Raises:
        InputError: no camera has such a field of view, pixel or optical axis.
    """
    (width, height), (fx, fy), (cx, cy) = size_px, focal_px, centre_px
    got = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for {width}x{height} px"
    is_square = fx > 0 and fy > 0 and 1 / MAX_PIXEL_ASPECT <= fx / fy <= MAX_PIXEL_ASPECT
    if not is_square or not (-width < cx < 2 * width and -height < cy < 2 * height):
        raise InputError(
            "the intrinsics do not fit the picture",
            where=path,
            got=got,
            expected="positive focal lengths, one at most "
            f"{MAX_PIXEL_ASPECT:g} times the other, and a centre near the picture",
        )
    view_deg = float(np.degrees(2 * np.arctan(max(width / fx, height / fy) / 2)))
    if not MIN_VIEW_DEG <= view_deg <= MAX_VIEW_DEG:
        raise InputError(
            "the focal length does not fit the picture",
            where=path,
            got=f"{got}: a view of {view_deg:.3g} degrees",
            expected=f"{MIN_VIEW_DEG:g} to {MAX_VIEW_DEG:g} degrees",
            remedy="Focal lengths are in pixels of the stored pictures.",
        )
    if not NARROW_VIEW_DEG <= view_deg <= WIDE_VIEW_DEG:
        return (f"{path.parent.name} sees {view_deg:.0f} degrees: its focal length may be wrong",)
    return ()


def check_readout(where: object, readout_s: float) -> None:
    """Refuse a duration that no camera needs to read its rows.

    Raises:
        InputError: negative, not finite or too long.
    """
    if not 0.0 <= readout_s <= MAX_READOUT_S:
        raise InputError(
            "no camera reads its rows for so long",
            where=where,
            got=f"readout_s: {readout_s:g}",
            expected=f"0 to {MAX_READOUT_S:g}",
            remedy="Give seconds from the first row to the last one; 0 is a global shutter.",
        )


def check_mounting(where: object, translation_m: Float64[np.ndarray, "3"]) -> None:
    """Refuse a sensor beside the vehicle.

    Raises:
        InputError: the translation is too long or not finite.
    """
    distance_m = math.hypot(*translation_m)
    if not distance_m <= MAX_MOUNT_M:
        raise InputError(
            "the sensor is not on the vehicle",
            where=where,
            got=f"a translation of {distance_m:.4g} m",
            expected=f"at most {MAX_MOUNT_M:g} m",
            remedy="Translations are in metres.",
        )


def check_clocks(times_ns_by_file: Mapping[Path, Int64[np.ndarray, " n"]]) -> tuple[str, ...]:
    """Notes on sensors whose times of one number belong to different moments.

    Args:
        times_ns_by_file: of all sensors, entry i of each at the same moment but for a fraction
            of a sweep. The median of all tells which one is wrong.

    Raises:
        InputError: a sensor's clock is shifted or runs at another speed.
    """
    if len(times_ns_by_file) < 2:
        return ()
    n = min(len(times) for times in times_ns_by_file.values())
    table = np.stack([times[:n] for times in times_ns_by_file.values()])
    start = int(table[0, 0])
    off_s = (table - start) * 1e-9
    off_s -= np.median(off_s, axis=0)
    files = list(times_ns_by_file)
    worst_s = np.abs(off_s).max(axis=1)
    if len(files) == 2:
        worst_s *= 2.0  # The median lies midway: neither of two is nearer to it.
    worst = int(np.argmax(worst_s))
    if worst_s[worst] > MAX_CLOCK_S:
        raise InputError(
            "the times are not those of the other sensors",
            where=files[worst],
            got=f"{worst_s[worst]:.4g} s from {_others(files, worst)}",
            expected=f"entries of one number within {MAX_CLOCK_S:g} s",
            remedy="All files must be of one sequence and one clock.",
        )
    return tuple(
        f"{path.parent.name}: times are up to {seconds:.2f} s from {_others(files, i)}"
        for i, (path, seconds) in enumerate(zip(files, worst_s, strict=True))
        if seconds > ODD_CLOCK_S
    )


def _others(files: list[Path], i: int) -> str:
    return str(files[1 - i]) if len(files) == 2 else f"the median of {len(files)} sensors"


def check_rigid(path: Path, ego: Trajectory, camera: Trajectory) -> tuple[str, ...]:
    """Notes on a camera that does not stay where it is mounted.

    Args:
        path: of the camera's poses, for messages.
        ego: `world_from_ego`.
        camera: `world_from_camera`.

    Raises:
        InputError: the camera is far from the vehicle.
    """
    shared = [i for i, t in enumerate(camera.times_ns.tolist()) if ego.covers(t)]
    if not shared:
        return ()
    places_ego = np.stack(
        [
            ego.at(int(camera.times_ns[i])).inverse().apply(camera.positions_m[i][None])[0]
            for i in shared
        ]
    )
    distances_m = np.linalg.norm(places_ego, axis=1)
    far = int(np.argmax(distances_m))
    if distances_m[far] > MAX_MOUNT_M:
        raise InputError(
            "the camera is not on the vehicle that the other cameras are on",
            where=f"{path}[{shared[far]}]",
            got=f"{distances_m[far]:.4g} m from it",
            expected=f"at most {MAX_MOUNT_M:g} m",
            remedy="Poses of all cameras must be of one drive and one world frame.",
        )
    drift_m = float(np.linalg.norm(places_ego - np.median(places_ego, axis=0), axis=1).max())
    if drift_m > MAX_RELATIVE_DRIFT_M:
        return (
            f"{path.parent.name} moves {drift_m:.1f} m relative to the vehicle: its poses or "
            "times may be wrong",
        )
    return ()


def odd_track_notes(track: ActorTrack) -> tuple[str, ...]:
    """Notes on an actor that is very long or moves very fast."""
    notes: list[str] = []
    name = f"actor {track.actor_id[:40]} ({track.label[:40]})"
    size_m = float(track.size_lwh_m.max())
    if size_m > LONG_BOX_M:
        notes.append(f"{name} is {size_m:.0f} m long")
    steps_m = np.linalg.norm(np.diff(track.trajectory.positions_m, axis=0), axis=1)
    speeds = steps_m / (np.diff(track.trajectory.times_ns) * 1e-9)
    if len(speeds) and speeds.max() > FAST_M_S:
        notes.append(f"{name} moves at {speeds.max():.0f} m/s: its id may name two actors")
    return tuple(notes)
