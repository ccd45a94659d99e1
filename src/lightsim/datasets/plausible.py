"""Plausibility of recordings: impossible values are errors, unusual ones are notes.

A wrong unit or column (milliseconds for seconds) gives numbers that every later stage would accept.
The limits lie well outside the range of recorded drives: errors of unit exceed them, unusual logs
do not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.checks import Limit
from lightsim.core.frames import Trajectory, vector_from_rotation
from lightsim.core.notes import grouped_notes
from lightsim.errors import InputError

# Limits by quantity; each has its reason.
LIMITS = {
    # Points are float32, whose spacing is 8 mm beyond 100 km from the origin.
    "coordinate": Limit(
        "the pose is too far from the world's origin", 1e5, "m",
        remedy="Move the log's world frame near to the drive.",
    ),
    # No road vehicle reaches 540 km/h; one pose with an error of 15 m at 10 Hz does. 288 km/h is a
    # race track, or an error of the poses.
    "speed": Limit(
        "the pose is too far from the one before", 150.0, "m/s", odd=(0.0, 80.0),
        remedy="Check the positions (metres) and the times (seconds).",
    ),
    # One turn a second: no vehicle spins faster, not even in a crash.
    "turn": Limit(
        "the pose is turned too far from the one before", 360.0, "degrees a second",
        remedy="Check the quaternions (w, x, y, z) and the times (seconds).",
    ),
    # Front tele cameras have 10 to 50 degrees; wider images are not pinhole images.
    # Rectified driving cameras below 10 or above 140 degrees are unusual.
    "view": Limit(
        "the focal length does not fit the picture", 170.0, "degrees", 2.0, odd=(10.0, 140.0),
        remedy="Focal lengths are in pixels of the stored pictures.",
    ),
    # Rows are read before the next picture starts, at 10 Hz or more; 5 to 35 ms are usual.
    "readout": Limit(
        "the readout time of the camera is out of range", 0.1, "s", 0.0,
        remedy="Give seconds from the first row to the last one; 0 is a global shutter.",
    ),
    # Sensors are on one vehicle, and no rigid road vehicle is longer.
    "mounting": Limit(
        "the sensor is not on the vehicle", 30.0, "m", remedy="Translations are in metres.",
    ),
    "fellow camera": Limit(
        "the camera is too far from the other cameras", 30.0, "m",
        remedy="Poses of all cameras must be of one drive and one world frame.",
    ),
    # Entries of one number belong to one sweep, a tenth of a second long in PandaSet. Twice a sweep
    # is a sensor that lost a picture but not its count.
    "clock": Limit(
        "the times differ from those of the other sensors", 0.5, "s", odd=(0.0, 0.2),
        remedy="All files must be of one sequence and one clock.",
    ),
    # Cameras are fixed to the vehicle: relative to the path they stay within centimetres.
    "drift": Limit(
        "the camera moves relative to the vehicle", math.inf, "m", odd=(0.0, 0.5)
    ),
    # At city speed the place is then a kilometre away, and the clock is another one.
    "gps gap": Limit(
        "no GPS fix is near the log's first picture in time", 60.0, "s",
        remedy="All files must be of one sequence and one clock.",
    ),
    # Trams and road trains are shorter; a larger box would contain returns of the street. Only they
    # and trains are longer than 30 m.
    "box": Limit("a box is too large", 60.0, "m", odd=(0.0, 30.0)),
    # Boxes are drawn around LiDAR returns, and no LiDAR reaches further.
    "box distance": Limit("a box is beyond the LiDAR's range", 1000.0, "m"),
    # Automotive LiDARs reach 300 m; a sweep with half of its returns beyond this is in another
    # frame.
    "range": Limit(
        "the sweep's points are too far from the vehicle", 500.0, "m",
        remedy="Points must be in metres, in the world frame of the camera poses.",
    ),
}  # fmt: skip
MAX_PIXEL_ASPECT = 2.0
"""Largest ratio of fx to fy: pixels are square within a percent; anamorphic lenses squeeze by
two."""


# Size of PandaSet's pictures, in pixels.
_PUBLISHED_PX = (1920, 1080)
# Ratio of 2 cx x 2 cy to the size of the pictures above which the intrinsics are of another scale.
# PandaSet's six cameras have .93 to 1.02 (geometric mean of both axes).
_OTHER_SIZE = 1.15
# Largest ratio between the scale factors of the two axes after scaling; a crop exceeds it. PandaSet
# has up to 1.17.
_SAME_SHAPE = 1.33
# Ratio of 2 cx to the width (2 cy to the height) that deserves a note: the optical axis is off by a
# third of half a side.
_OFF_CENTRE = 1.33


def check_poses(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    """Check the poses of one sensor and return notes on unusual ones.

    Raises:
        InputError: an impossible coordinate, speed or rate of turn.
    """
    positions = trajectory.positions_m
    far = int(np.argmax(np.abs(positions).max(axis=1)))
    farthest_m = float(np.abs(positions[far]).max())
    got = f"position {positions[far].tolist()} m"
    LIMITS["coordinate"].check(f"{path}[{far}]", farthest_m, got)
    if len(trajectory) < 2:
        return ()
    seconds = np.diff(trajectory.times_ns) * 1e-9
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / seconds
    i = int(np.argmax(speeds))
    speed = float(speeds[i])
    is_odd = LIMITS["speed"].check(f"{path}[{i + 1}]", speed, f"{speed:.4g} m/s")
    _check_turns(path, trajectory, seconds)
    if is_odd:
        return (f"{path.parent.name} moves at {speed:.0f} m/s: poses or times may be wrong",)
    return ()


def _check_turns(path: Path, trajectory: Trajectory, seconds: Float64[np.ndarray, " n"]) -> None:
    rotations = trajectory.matrices[:, :3, :3]
    turns_deg = np.degrees(
        [
            np.linalg.norm(vector_from_rotation(after @ before.T))
            for before, after in pairwise(rotations)
        ]
    )
    rates = turns_deg / seconds
    i = int(np.argmax(rates))
    got = f"{turns_deg[i]:.0f} degrees in {seconds[i]:.3g} s"
    LIMITS["turn"].check(f"{path}[{i + 1}]", float(rates[i]), got)


def check_intrinsics(
    path: Path,
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
) -> tuple[str, ...]:
    """Check the intrinsics of a pinhole camera and return notes on unusual ones.

    Args:
        path: of the file, for messages.
        size_px: width and height of its pictures.
        focal_px: fx, fy.
        centre_px: cx, cy.

    Raises:
        InputError: an impossible field of view, pixel aspect or optical axis.
    """
    (width, height), (fx, fy), (cx, cy) = size_px, focal_px, centre_px
    got = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for {width}x{height} px"
    notes = _check_size(path, size_px, centre_px)
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
    if LIMITS["view"].check(path, view_deg, f"{got}: a view of {view_deg:.3g} degrees"):
        notes += (f"{path.parent.name} sees {view_deg:.0f} degrees: its focal length may be wrong",)
    return notes


def _check_size(
    path: Path, size_px: tuple[int, int], centre_px: tuple[float, float]
) -> tuple[str, ...]:
    """Notes on an optical axis off the pictures' centre.

    Raises:
        InputError: the axis is in the centre of pictures of another size.
    """
    width, height = size_px
    # Size of the pictures in whose centre the axis lies; PandaSet counts from the centre of the
    # first pixel, hence 1.
    meant = (2 * centre_px[0] + 1, 2 * centre_px[1] + 1)
    if min(meant) <= 0:
        return ()
    x, y = meant[0] / width, meant[1] / height
    scale = math.sqrt(x * y)
    is_same_shape = 1 / _SAME_SHAPE < x / y < _SAME_SHAPE
    if is_same_shape and not 1 / _OTHER_SIZE <= scale <= _OTHER_SIZE:
        published_x, published_y = meant[0] / _PUBLISHED_PX[0], meant[1] / _PUBLISHED_PX[1]
        is_published = all(0.8 < ratio < 1.25 for ratio in (published_x, published_y))
        wide, high = _PUBLISHED_PX if is_published else map(round, meant)
        raise InputError(
            "the intrinsics are for pictures of another size",
            where=path,
            got=f"pictures of {width}x{height} px and an optical axis at {centre_px[0]:g}, "
            f"{centre_px[1]:g} px",
            expected=f"pictures of about {wide}x{high} px, with the axis near their centre",
            remedy="Put the pictures of that size back (--image-scale reduces them while "
            f"reading), or multiply fx, fy, cx, cy by {width / wide:.4g}.",
        )
    if all(1 / _OFF_CENTRE <= ratio <= _OFF_CENTRE for ratio in (x, y)):
        return ()
    return (
        f"{path.parent.name}: the optical axis at {centre_px[0]:g}, {centre_px[1]:g} px is far "
        f"from the centre of {width}x{height} px, as of cropped pictures; scaled ones need other "
        "intrinsics",
    )


def check_readout(where: object, readout_s: float) -> None:
    """Check that the readout time of a rolling shutter is from 0 to 0.1 s.

    Raises:
        InputError: negative, not finite or too long.
    """
    LIMITS["readout"].check(where, readout_s, f"readout_s: {readout_s:g}")


def check_mounting(where: object, translation_m: Float64[np.ndarray, "3"]) -> None:
    """Check that the translation of a sensor on the vehicle is at most 30 m.

    Raises:
        InputError: the translation is too long or not finite.
    """
    distance_m = math.hypot(*translation_m)
    LIMITS["mounting"].check(where, distance_m, f"a translation of {distance_m:.4g} m")


def check_clocks(times_ns_by_file: Mapping[Path, Int64[np.ndarray, " n"]]) -> tuple[str, ...]:
    """Return notes on sensors whose times differ from the other sensors' at the same index.

    Args:
        times_ns_by_file: times of each sensor, in nanoseconds; entries of one index differ by a
            fraction of a sweep. A wrong clock is identified by its distance from the median.

    Raises:
        InputError: a sensor's clock is shifted or runs at another speed.
    """
    if len(times_ns_by_file) < 2:
        return ()
    n = min(len(times) for times in times_ns_by_file.values())
    table = np.stack([times[:n] for times in times_ns_by_file.values()])
    start = int(table[0, 0])
    off_s = (table - start) * 1e-9
    # The median of all sensors, which a single wrong clock does not move.
    off_s -= np.median(off_s, axis=0)
    files = list(times_ns_by_file)
    worst_s = np.abs(off_s).max(axis=1)
    if len(files) == 2:
        worst_s *= 2.0  # The median lies midway: neither of two is nearer to it.
    worst = int(np.argmax(worst_s))
    got = f"{worst_s[worst]:.4g} s from {_others(files, worst)}"
    LIMITS["clock"].check(files[worst], float(worst_s[worst]), got)
    return tuple(
        f"{path.parent.name}: times are up to {seconds:.2f} s from {_others(files, i)}"
        for i, (path, seconds) in enumerate(zip(files, worst_s, strict=True))
        if LIMITS["clock"].check(path, float(seconds), "")
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
    # Relative to the ego path, since absolute positions change by the drive itself.
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
    got = f"{distances_m[far]:.4g} m from it"
    LIMITS["fellow camera"].check(f"{path}[{shared[far]}]", float(distances_m[far]), got)
    drift_m = float(np.linalg.norm(places_ego - np.median(places_ego, axis=0), axis=1).max())
    if LIMITS["drift"].check(path, drift_m, f"{drift_m:.4g} m"):
        return (
            f"{path.parent.name} moves {drift_m:.1f} m relative to the vehicle: its poses or "
            "times may be wrong",
        )
    return ()


def odd_track_notes(tracks: Iterable[ActorTrack]) -> tuple[str, ...]:
    """Notes on actors that are very long or move very fast."""
    long: list[str] = []
    fast: list[str] = []
    for track in tracks:
        name = f"{track.actor_id[:40]} ({track.label[:40]})"
        size_m = float(track.size_lwh_m.max())
        if size_m > LIMITS["box"].odd[1]:
            long.append(f"{name} {size_m:.0f} m")
        steps_m = np.linalg.norm(np.diff(track.trajectory.positions_m, axis=0), axis=1)
        speeds = steps_m / (np.diff(track.trajectory.times_ns) * 1e-9)
        if len(speeds) and speeds.max() > LIMITS["speed"].odd[1]:
            fast.append(f"{name} {speeds.max():.0f} m/s")
    return grouped_notes(
        {
            "very long": long,
            "very fast: two actors may have one id": fast,
        },
        "actor",
    )
