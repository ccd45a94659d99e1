"""Position of the sun by pvlib's ephemeris; azimuth is clockwise from true north."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import cast

import numpy as np
from jaxtyping import Float

from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError

# First year, and the year after the last, in which the ephemeris is accurate and times fit into
# int64 nanoseconds.
_YEARS = (1900, 2200)


@dataclass(frozen=True)
class SolarPosition:
    """Apparent direction of the sun's centre, refraction included."""

    azimuth_deg: float
    elevation_deg: float


def solar_position(latitude_deg: float, longitude_deg: float, time_ns: int) -> SolarPosition:
    """Return the sun's position by NREL's SPA (Reda & Andreas 2004,
    doi:10.1016/j.solener.2003.12.003) through pvlib.

    Raises:
        InputError: latitude or longitude is out of range.
    """
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 360.0):
        raise InputError(
            "latitude or longitude is out of range",
            got=f"latitude {latitude_deg}, longitude {longitude_deg} degrees",
            expected="-90 to 90, and -360 to 360",
        )
    import pandas as pd
    from pvlib.solarposition import get_solarposition

    times = pd.DatetimeIndex([pd.Timestamp(time_ns, unit="ns", tz="UTC")])
    table = cast(pd.DataFrame, get_solarposition(times, latitude_deg, longitude_deg))
    row = cast("dict[str, float]", table.iloc[0].to_dict())
    return SolarPosition(float(row["azimuth"]), float(row["apparent_elevation"]))


def parse_utc(text: str, where: object, expected: str) -> int:
    """Return the nanoseconds since 1970 of an ISO 8601 time; a time without an offset is UTC.

    Args:
        where: option or value that has the text, for errors.
        expected: form of the text, for errors.

    Raises:
        InputError: it is not an ISO 8601 time of the years 1900 to 2199.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError("the time cannot be read", where=where, expected=expected) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    if not _YEARS[0] <= moment.year < _YEARS[1]:
        raise InputError(
            "the time is out of range",
            where=where,
            got=f"the year {moment.year}",
            expected=f"{_YEARS[0]} to {_YEARS[1] - 1}",
        )
    # Through whole microseconds: a float timestamp cannot represent nanoseconds.
    return round(moment.timestamp() * 1e6) * 1000


def direction_enu(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector in frame `enu` of an azimuth, clockwise from north, and an
    elevation."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )


def azimuth_elevation(direction: Float[np.ndarray, "3"]) -> SolarPosition:
    """Return azimuth in [0, 360) and elevation of a direction in frame `enu`: the inverse of
    `direction_enu`."""
    # Arguments in the order east, north: the angle is measured from north towards east.
    x, y, z = direction / np.linalg.norm(direction)
    azimuth = float(np.degrees(np.arctan2(x, y)) % 360.0)
    return SolarPosition(azimuth, float(np.degrees(np.arcsin(z))))


def direction_world(
    azimuth_deg: float, elevation_deg: float, enu_from_world: RigidTransform
) -> Float[np.ndarray, "3"]:
    """Return the unit vector in frame `world` of an azimuth from true north and an elevation."""
    return enu_from_world.inverse().rotate(direction_enu(azimuth_deg, elevation_deg))


def angle_between_deg(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """Return the angle between two directions; accurate for small angles, too."""
    # The arc cosine of the dot product loses half of the digits of small angles.
    cross, dot = float(np.linalg.norm(np.cross(a, b))), float(a @ b)
    return float(np.degrees(np.arctan2(cross, dot)))
