"""Place, time and north of a log; north is the rotation of the ego path onto the GPS track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import Clock, GeoReference, Place
from lightsim.core.reading import LogReading
from lightsim.core.solar import SolarPosition
from lightsim.errors import InputError

MIN_PATH_M = 3.0
"""Least length of an ego path that determines its direction, in metres: GPS errs by a metre or
more."""
# Residual above which path and track are different drives, as a fraction of `HeadingFit.path_m`.
# Chosen; sensitivity not measured.
_MAX_RESIDUAL_FRACTION = 0.2
SEMI_MAJOR_M = 6378137.0
"""WGS 84 (NIMA TR8350.2): semi-major axis in metres."""
# WGS 84: square of the first eccentricity.
_ECCENTRICITY_SQUARED = 6.69437999014e-3


# Half the side of a square about 0, 0 without roads, in degrees: a kilometre.
_NULL_DEG = 0.01


@dataclass(frozen=True)
class GpsTrack:
    """GPS fixes of one log, in time order.

    Args:
        n_lost: number of fixes at 0, 0, which are left out.
    """

    times_ns: np.ndarray
    latitude_deg: Float64[np.ndarray, " n"]
    longitude_deg: Float64[np.ndarray, " n"]
    n_lost: int = 0


def gps_track(
    times_ns: np.ndarray,
    latitude_deg: Float64[np.ndarray, " n"],
    longitude_deg: Float64[np.ndarray, " n"],
    where: Callable[[int], str],
) -> GpsTrack:
    """Return the fixes of a log without those at 0, 0.

    Args:
        where: returns the place of a fix in the file, by its index.

    Raises:
        InputError: one is out of range. The convention of longitudes 0 to 360 is not used by logs.
    """
    is_off = (np.abs(latitude_deg) > 90) | (np.abs(longitude_deg) > 180)
    if is_off.any():
        i = int(np.flatnonzero(is_off)[0])
        raise InputError(
            "the latitude or longitude of a GPS fix is out of range",
            where=where(i),
            got=f"latitude {latitude_deg[i]:g}, longitude {longitude_deg[i]:g}",
            expected="degrees within 90 and 180 of zero",
        )
    is_fix = ~is_null(latitude_deg, longitude_deg)
    return GpsTrack(
        times_ns[is_fix], latitude_deg[is_fix], longitude_deg[is_fix], int((~is_fix).sum())
    )


def is_null(
    latitude_deg: Float64[np.ndarray, " n"], longitude_deg: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return where a position is 0, 0, in the sea off Africa: receivers without reception and
    templates contain it."""
    return (np.abs(latitude_deg) < _NULL_DEG) & (np.abs(longitude_deg) < _NULL_DEG)


@dataclass(frozen=True)
class HeadingFit:
    """Rotation about z from the ego path to the GPS track.

    Args:
        yaw_rad: yaw of `enu_from_world`, counter-clockwise from above.
        residual_m: RMS distance between the rotated path and the track.
        std_deg: one standard deviation of the yaw: residual over the RMS extent of the path. GPS
            errors of one drive are correlated, so all fixes count as one.
        path_m: largest distance of a point from the point that is farthest from the path's mean,
            about the largest distance between two points.
    """

    yaw_rad: float
    residual_m: float
    std_deg: float
    path_m: float


def east_north_m(
    latitude_deg: Float64[np.ndarray, " n"], longitude_deg: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 2"]:
    """Return metres east and north of the first fix, on the tangent plane of WGS 84 there.

    The radii of curvature of that latitude are used (Snyder 1987, Map Projections, USGS
    Professional Paper 1395, p. 24-25); over 1 km the error is about 0.1 m at middle
    latitudes, because the length of a degree of longitude changes with latitude.
    """
    latitude = float(np.radians(latitude_deg[0]))
    meridian_m, normal_m = _radii_m(latitude)
    # Differences across the date line are small, too.
    degrees_east = (longitude_deg - longitude_deg[0] + 180.0) % 360.0 - 180.0
    east = np.radians(degrees_east) * normal_m * np.cos(latitude)
    north = np.radians(latitude_deg - latitude_deg[0]) * meridian_m
    return np.stack([east, north], axis=1)


def place_at(
    latitude_deg: float, longitude_deg: float, east_m: float, north_m: float
) -> tuple[float, float]:
    """Return latitude and longitude of a point east and north of another one: the inverse of
    `east_north_m`."""
    latitude = float(np.radians(latitude_deg))
    meridian_m, normal_m = _radii_m(latitude)
    return (
        latitude_deg + float(np.degrees(north_m / meridian_m)),
        longitude_deg + float(np.degrees(east_m / (normal_m * np.cos(latitude)))),
    )


def _radii_m(latitude_rad: float) -> tuple[float, float]:
    """Return the radii of curvature along the meridian and across it."""
    flattening = 1.0 - _ECCENTRICITY_SQUARED * float(np.sin(latitude_rad)) ** 2
    meridian_m = SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_SQUARED) / flattening**1.5
    return meridian_m, SEMI_MAJOR_M / flattening**0.5


def fit_heading(
    path_world: Float64[np.ndarray, "n 2"], track_enu: Float64[np.ndarray, "n 2"]
) -> HeadingFit:
    """Fit rotation and shift of the path to the track by least squares (planar Procrustes)."""
    path = path_world - path_world.mean(axis=0)
    track = track_enu - track_enu.mean(axis=0)
    # In the plane, the least-squares rotation has a closed form: the angle of the sums of dot and
    # cross products. Both are centred, so that the shift drops out.
    dot = float((path * track).sum())
    cross = float((path[:, 0] * track[:, 1] - path[:, 1] * track[:, 0]).sum())
    yaw = float(np.arctan2(cross, dot))
    c, s = np.cos(yaw), np.sin(yaw)
    # The transposed rotation matrix, as points are rows.
    turned = path @ np.array([[c, s], [-s, c]])
    residual = float(np.sqrt(((turned - track) ** 2).sum(axis=1).mean()))
    spread = float(np.sqrt((path**2).sum(axis=1).mean()))
    std_deg = float(np.degrees(residual / spread)) if spread > 0 else 180.0
    return HeadingFit(yaw, residual, std_deg, _extent_m(path))


@dataclass(frozen=True)
class Located:
    """Place, time and north as a recording contains them; each may be missing.

    Args:
        track: GPS fixes, from which place and north follow.
        place: position, if there is no GPS track.
        clock: offset of UTC from the log's times; None if the times are no UTC times.
        world_x_azimuth_deg: azimuth of world +x, clockwise from true north.
        azimuth_std_deg: one standard deviation of that azimuth; None if unknown.
        azimuth_origin: source of that azimuth.
        azimuth_residual_m: RMS distance between ego path and GPS track, if they determined it.
        sun: position of the recorded sun, if the recording has one of its own.
    """

    track: GpsTrack | None = None
    place: Place | None = None
    clock: Clock | None = field(default_factory=Clock)
    world_x_azimuth_deg: float | None = None
    azimuth_std_deg: float | None = 0.5
    azimuth_origin: str = "map"
    azimuth_residual_m: float | None = None
    sun: SolarPosition | None = None


def locate(
    recorded: Located, ego: Trajectory, start_ns: int, reading: LogReading
) -> tuple[GeoReference | None, tuple[str, ...]]:
    """Return place, time and north of a log, and notes on unknown ones; None if all are unknown.

    Args:
        recorded: contents of the recording; the user's options override them.
        ego: `world_from_ego`.
        start_ns: time of the first frame, of the log's clock.
        reading: options --place, --utc, --sun and --heading-deg.
    """
    track, lost = recorded.track, ()
    if track is not None and track.n_lost:
        lost = (f"{track.n_lost} GPS fixes are 0, 0, as receivers write without reception, and are"
                " not used",)  # fmt: skip
        recorded = recorded if len(track.times_ns) else replace(recorded, track=None)
    place, clock = _place(recorded, start_ns, reading), recorded.clock
    if reading.utc:
        clock = Clock(reading.utc_ns - start_ns, "given")
    sun = recorded.sun if reading.sun_deg is None else SolarPosition(*reading.sun_deg)
    enu_from_world, north, std_deg, residual_m, notes = _north(recorded, ego, reading)
    notes = (*lost, *notes)
    if place is None and sun is None and enu_from_world is None:
        return None, (*lost, "no GPS: place, solar position and north are unknown")
    if sun is None:
        if place is None:
            notes += ("no place: the solar position is unknown; give --place or --sun",)
        if clock is None:
            notes += ("no UTC time: the solar position is unknown; give --utc or --sun",)
    geo = GeoReference(place, clock, enu_from_world, north, std_deg, residual_m, sun)
    return geo, notes


def _place(recorded: Located, start_ns: int, reading: LogReading) -> Place | None:
    if reading.place_deg is not None:
        return Place(*reading.place_deg, "given")
    track = recorded.track
    if track is None:
        return recorded.place
    first = int(np.argmin(np.abs(track.times_ns - start_ns)))
    return Place(float(track.latitude_deg[first]), float(track.longitude_deg[first]))


_North = tuple[RigidTransform | None, str, float | None, float | None, tuple[str, ...]]


def _north(recorded: Located, ego: Trajectory, reading: LogReading) -> _North:
    """Return `enu_from_world`, its source, standard deviation, residual, and notes."""
    if reading.heading_deg is not None:
        return enu_from_heading(reading.heading_deg), "given", None, None, ()
    if recorded.world_x_azimuth_deg is not None:
        enu_from_world = enu_from_heading(recorded.world_x_azimuth_deg)
        north, std_deg = recorded.azimuth_origin, recorded.azimuth_std_deg
        return enu_from_world, north, std_deg, recorded.azimuth_residual_m, ()
    advice = "give the azimuth of world +x with --heading-deg"
    if recorded.track is None:
        return None, "unknown", None, None, (f"north is unknown; {advice}",)
    fit = _fit_log(recorded.track, ego)
    if fit is None or fit.path_m < MIN_PATH_M:
        moved = 0.0 if fit is None else fit.path_m
        note = (
            f"the ego moved only {moved:.1f} m, too little to find north (at least "
            f"{MIN_PATH_M:g} m); {advice}"
        )
        return None, "unknown", None, None, (note,)
    if fit.residual_m > _MAX_RESIDUAL_FRACTION * fit.path_m:
        note = (
            f"ego path and GPS track disagree by {fit.residual_m:.1f} m over {fit.path_m:.1f} m, "
            f"so north is unknown; {advice}"
        )
        return None, "unknown", None, None, (note,)
    return _enu_from_yaw(fit.yaw_rad), "gps track", fit.std_deg, fit.residual_m, ()


def enu_from_heading(heading_deg: float) -> RigidTransform:
    """Return `enu_from_world` for an azimuth of world +x, degrees clockwise from true north."""
    # An azimuth is clockwise from north, a yaw counter-clockwise from east.
    return _enu_from_yaw(float(np.radians(90.0 - heading_deg)))


def _fit_log(track: GpsTrack, ego: Trajectory) -> HeadingFit | None:
    is_covered = (track.times_ns >= ego.start_ns) & (track.times_ns <= ego.end_ns)
    times_ns = track.times_ns[is_covered]
    if len(times_ns) < 2:
        return None
    path = np.array([ego.at(int(t)).translation_m[:2] for t in times_ns])
    return fit_heading(
        path, east_north_m(track.latitude_deg[is_covered], track.longitude_deg[is_covered])
    )


def _enu_from_yaw(yaw_rad: float) -> RigidTransform:
    return RigidTransform.from_yaw("enu", "world", yaw_rad, np.zeros(3))


def _extent_m(points: Float64[np.ndarray, "n 2"]) -> float:
    far = points[np.argmax((points**2).sum(axis=1))]
    return float(np.sqrt(((points - far) ** 2).sum(axis=1).max()))
