"""Early checks of a recording, so that a build does not fail after minutes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from lightsim.build.options import BuildOptions
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.log import DrivingLog
from lightsim.errors import InputError
from lightsim.progress import Progress

# Mean luminance of the upper third of a picture (1.0: pixel value 255) below which it is dark.
# PandaSet log 002, with the sun at 12 degrees, has .27 to .38; not measured at night.
_DARK = 0.04
# Number of pictures of each camera that are examined: a median over some pictures, because one may
# show a bridge. Chosen; sensitivity not measured.
_PICTURES = 3
# The upper third of a picture is examined: sky and buildings, no road in the headlights.
_UPPER = 3
# Length of the ego path, in metres, below which the ego vehicle counts as standing: motion then
# finds neither its mask nor north.
_STANDING_M = 5.0
_NEEDS_SWEEPS = "fields"
_NEEDS_SUN = "sky"


def check_places(source: Path, work: Path) -> None:
    """Reject a work folder inside the recording.

    Raises:
        InputError: it is inside.
    """
    # A folder inside would change the hashes of the recording, and every build would be stale.
    inside = work.resolve()
    if source in (inside, *inside.parents):
        raise InputError(
            "the work folder is inside the recording, which must not be changed",
            where=f"--work {work}",
            got=f"SOURCE {source}",
            remedy="Choose a folder outside the recording.",
        )


def check_suitable(log: DrivingLog, options: BuildOptions, stages: Collection[str]) -> None:
    """Reject a recording that a later stage would refuse.

    Args:
        log: the recorded log without held-out frames and sweeps.
        stages: names of the stages that will run.

    Raises:
        InputError: there are no sweeps, place and time are at night, or a camera of the field is
            not in the log.
    """
    unknown = [name for name in options.field_cameras if name not in log.cameras]
    if unknown:
        raise InputError(
            "the log has no camera of this name",
            where="--field-cameras",
            got=", ".join(unknown),
            expected=f"some of {', '.join(log.cameras)}",
        )
    if _NEEDS_SWEEPS in stages and not log.sweeps:
        raise InputError(
            "the log has no LiDAR sweep, which geometry requires",
            where=options.reading.source,
            got=f"{len(log.frames)} pictures and no sweep"
            + (f" in --frames {options.reading.frames}" if options.reading.frames else ""),
            expected="sweeps (PandaSet: lidar/00.pkl.gz), or points.ply in a lightsim-log folder",
            remedy="Download the sweeps, too, or choose --frames that have some. Without a LiDAR, "
            "make a cloud of points: lightsim export SOURCE --out LOG, then colmap "
            "patch_match_stereo and colmap stereo_fusion --output_path LOG/points.ply with the "
            "poses of LOG, and build LOG. --until alignment stops before geometry.",
        )
    elevation_deg = sun_elevation_deg(log)
    # A build that ends before the sky stage needs no sun.
    is_used = options.gps != "none" and _NEEDS_SUN in stages
    if is_used and elevation_deg is not None and elevation_deg <= 0:
        raise InputError(
            "the log was recorded at night: twilight and night are not modelled",
            where=options.reading.source,
            got=f"a sun {-elevation_deg:.1f} degrees below the horizon by GPS and clock",
            expected="a sun above the horizon",
            remedy="Choose a recording by day; or give --gps none, which estimates the "
            "light from the pictures alone and models a night as a dark day, or --until assets for"
            " geometry.",
        )


def sun_elevation_deg(log: DrivingLog) -> float | None:
    """Return the sun's elevation in the middle of the log; None without place and time."""
    middle_ns = log.frames[len(log.frames) // 2].time_ns
    position = None if log.geo is None else log.geo.sun_at(middle_ns)
    return None if position is None else position.elevation_deg


def ego_path_m(log: DrivingLog) -> float:
    """Return the length of the ego path during the log's frames, in metres."""
    times = np.unique([frame.time_ns for frame in log.frames])
    positions = log.ego.held_positions_m(times)
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def standing_cost(log: DrivingLog) -> tuple[str, str] | None:
    """Return how far an ego vehicle moves that stands, and what that costs; None if it drives."""
    path_m = ego_path_m(log)
    if path_m >= _STANDING_M:
        return None
    return (
        f"the ego moves {path_m:.1f} m in all",
        "surfaces are seen from one place: what is hidden from it is inferred, camera gains are "
        "pulled to a common one, and the ego vehicle's own pixels are found only where LiDAR meets "
        "its body. Choose --frames in which it drives, if there are any",
    )


def motion_notes(log: DrivingLog) -> tuple[str, ...]:
    """Return a note on an ego vehicle that stands."""
    found = standing_cost(log)
    return () if found is None else (": ".join(found),)


def light_notes(log: DrivingLog) -> tuple[str, ...]:
    """Return notes on a recording at night, detected by GPS and clock, or else by dark pictures."""
    elevation_deg = sun_elevation_deg(log)
    if elevation_deg is not None and elevation_deg <= 0:
        return (
            f"night: by GPS and clock the sun is {-elevation_deg:.1f} degrees below the horizon; "
            "without --gps none a build stops before the sky",
        )
    # GPS and clock decide on night; pictures decide if they are unknown or do not show it: tunnels.
    brightness = _upper_luminance(log)
    if brightness >= _DARK:
        return ()
    where = (
        "neither place nor time is known"
        if elevation_deg is None
        else f"by GPS and clock the sun is {elevation_deg:.1f} degrees high"
    )
    return (
        f"the pictures are dark (mean luminance {brightness:.3f} of their upper third), as at "
        f"night or in a tunnel, and {where}: light is modelled by day only",
    )


def _upper_luminance(log: DrivingLog) -> float:
    """Return the median luminance of the upper third of some pictures of all cameras."""
    found: list[float] = []
    for name in log.cameras:
        frames = log.frames_of(name)
        for i in np.unique(np.linspace(0, len(frames) - 1, _PICTURES).astype(int)):
            picture = frames[i].load_srgb8()
            upper = picture[: max(1, len(picture) // _UPPER)]
            found.append(float(luminance(linear_from_srgb8(upper)).mean()))
    return float(np.median(found))


def check_sweeps(log: DrivingLog, progress: Progress) -> None:
    """Read every sweep once, so that a damaged file is found before the stages that need it.

    Raises:
        InputError: a sweep or its classes cannot be read.
    """
    for lazy in progress.track(log.sweeps, "check sweeps", len(log.sweeps)):
        lazy.load()
