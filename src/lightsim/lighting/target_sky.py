"""Target skies: named skies, skies from files, and the scaling of their brightness."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun, add_sun, find_sun, split_sun
from lightsim.core.log import GeoReference
from lightsim.core.sky_choice import sun_numbers
from lightsim.core.solar import azimuth_elevation, direction_enu, direction_world, solar_position
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.sky.clear_sky import clear_sky

FORMS = "sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO (such as 2019-05-11T01:59:16Z) or source"
# Turbidity of a clear sky, where the option gives none.
_DEFAULT_TURBIDITY = 3.0
# First year, and the year after the last, that are accepted: the ephemeris is exact there and times
# fit into 64-bit nanoseconds.
_YEARS = (1900, 2200)


def target_sky(
    spec: str, *, geo: GeoReference | None, source: SkyEstimate | None, height_px: int
) -> tuple[SkyDome, str, dict[str, Any]]:
    """Return the sky that a specification names: the dome in frame `world`, a one-line description,
    and the facts to record (sun azimuth from true north, elevation, turbidity, assumptions).

    Azimuths are clockwise from true north. For a log of unknown heading world axes are taken as
    ENU, and the facts record this. `source` is returned at its own resolution.

    Raises:
        InputError: the form is not one of FORMS, or requires what the log does not have.
    """
    if spec == "source":
        return _source_sky(source)
    if spec.startswith("sun:"):
        azimuth_deg, elevation_deg, turbidity = _parse_sun(spec)
        facts: dict[str, Any] = {}
    elif spec.startswith("time:"):
        time_ns = parse_time(spec)
        if geo is None:
            raise InputError(
                "the log has no place on Earth, so a time does not give a sun",
                where=spec,
                remedy="Use sun:AZIMUTH,ELEVATION instead.",
            )
        position = solar_position(geo.latitude_deg, geo.longitude_deg, time_ns)
        azimuth_deg, elevation_deg = position.azimuth_deg, position.elevation_deg
        turbidity, facts = _DEFAULT_TURBIDITY, {"utc_ns": time_ns}
        if elevation_deg <= 0:
            raise InputError(
                "the sun is below the horizon then: twilight and night skies are not modelled",
                where=spec,
                got=f"an elevation of {elevation_deg:.1f} degrees at the log's place",
                remedy="Choose another time (UTC unless it says otherwise), or give an HDR file.",
            )
    else:
        raise InputError("the sky is not a known form", where=spec, expected=FORMS)
    direction, assumed = towards_sun(azimuth_deg, elevation_deg, geo)
    facts |= assumed
    dome = clear_sky(direction, turbidity, height_px=height_px)
    facts |= {
        "azimuth_deg": azimuth_deg,
        "elevation_deg": elevation_deg,
        "turbidity": turbidity,
    }
    name = f"clear sky, sun at {azimuth_deg:.1f}, {elevation_deg:.1f}, turbidity {turbidity:g}"
    return dome, name, facts


def towards_sun(
    azimuth_deg: float, elevation_deg: float, geo: GeoReference | None
) -> tuple[Float[np.ndarray, "3"], dict[str, str]]:
    """Return the unit vector towards the sun in `world`, and the assumption made if the heading is
    unknown."""
    if geo is not None and geo.enu_from_world is not None:
        return direction_world(azimuth_deg, elevation_deg, geo.enu_from_world), {}
    assumed = {"assumed": "the heading is unknown: world x is taken as east"}
    return direction_enu(azimuth_deg, elevation_deg), assumed


def with_edited_sun(
    dome: SkyDome, direction_world: Float[np.ndarray, "3"] | None, factor: float
) -> SkyDome:
    """Return the sky with its sun moved, or made weaker or stronger (paper, appendix: human
    control).

    The sun is the part that `split_sun` extracts: the disc, and its glow within 4 degrees where it
    exceeds the surrounding sky. All of it is emitted by the new disc; wider glow stays in place.

    Args:
        direction_world: unit vector towards the new position, above the horizon; None keeps the
            position.
        factor: multiplies the sun's irradiance; 0 removes the sun.

    Raises:
        InputError: the sky has no sun.
    """
    rest, sun = split_sun(dome)
    if sun is None:
        raise InputError(
            "the sky has no sun that could be moved or changed",
            where="--move-sun, --sun-factor",
            expected="a sky with a sun, such as sun:AZIMUTH,ELEVATION",
        )
    if factor == 0:
        return SkyDome(rest, None)
    direction = sun.direction_world if direction_world is None else direction_world
    light = (sun.irradiance * np.float32(factor)).astype(np.float32)
    return add_sun(rest, Sun(direction, light, sun.angular_radius_deg))


def _source_sky(source: SkyEstimate | None) -> tuple[SkyDome, str, dict[str, Any]]:
    if source is None:
        raise InputError(
            "there is no twin whose estimated sky this names",
            where="source",
            expected="sun:AZIMUTH,ELEVATION[,TURBIDITY] or an HDR file",
        )
    facts: dict[str, Any] = {
        "azimuth_deg": source.sun_azimuth_deg,
        "elevation_deg": source.sun_elevation_deg,
        "origin": source.origin,
    }
    return source.dome, "the estimated source sky", facts


def _parse_sun(spec: str) -> tuple[float, float, float]:
    numbers = sun_numbers(spec.removeprefix("sun:"), spec, FORMS, (2, 3))
    azimuth_deg, elevation_deg, turbidity = (*numbers, _DEFAULT_TURBIDITY)[:3]
    return azimuth_deg, elevation_deg, turbidity


def parse_time(spec: str) -> int:
    """Return nanoseconds UTC of time:ISO; a time without an offset is UTC.

    Raises:
        InputError: it is no ISO 8601 time of the years 1900 to 2199.
    """
    try:
        moment = datetime.fromisoformat(spec.removeprefix("time:"))
    except ValueError as error:
        raise InputError("the time cannot be read", where=spec, expected=FORMS) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    if not _YEARS[0] <= moment.year < _YEARS[1]:
        raise InputError(
            "the time is out of range",
            where=spec,
            got=f"the year {moment.year}",
            expected=f"{_YEARS[0]} to {_YEARS[1] - 1}",
        )
    return round(moment.timestamp() * 1e6) * 1000


def dome_from_array(radiance: Float32[np.ndarray, "h w 3"], name: str) -> SkyDome:
    """Return the dome of a sky file's pixels (after `store.images.read_sky`), frame `world`, with
    its sun if it has one.

    Args:
        name: name of the file, for errors.

    Raises:
        InputError: the array is not 2:1, not finite, negative, or too bright.
    """
    try:
        dome = SkyDome(radiance, None)
    except InputError as error:
        raise error.at(name) from error
    return replace(dome, sun=find_sun(radiance))


def scale_to_source(
    dome: SkyDome,
    source: SkyDome | None,
    mode: Literal["auto", "none"] | float,
    luminance_of: Callable[[SkyDome], float] | None = None,
) -> tuple[SkyDome, float]:
    """Return the dome times a factor, and the factor.

    "auto" gives the dome the source's luminance; "none" keeps scene units as stored (a clear sky
    with the sun at 45 degrees then lights a white level surface to a luminance of about 1); a
    number multiplies.

    Args:
        luminance_of: measures the luminance of a scene under a dome; by default, of white level
            ground.

    Raises:
        InputError: the number is not positive, a sky is black, or "auto" has no source.
    """
    if mode == "none" or (mode == "auto" and dome is source):
        return dome, 1.0
    if isinstance(mode, str):
        if source is None:
            raise InputError(
                "there is no source sky to match",
                remedy="Give --sky-scale none or a number.",
            )
        measure = luminance_of or _level_luminance
        target, wanted = measure(dome), measure(source)
        if target <= 0 or wanted <= 0:
            raise InputError(
                "a sky that lights nothing cannot be matched",
                where="--sky-scale",
                got=f"luminance {target:g} of the sky, {wanted:g} of the source",
                expected="both above 0",
                remedy="Give --sky-scale none or a number.",
            )
        factor = wanted / target
    else:
        factor = float(mode)
        if not np.isfinite(factor) or factor <= 0:
            raise InputError(
                "the sky's scale must be positive",
                where="--sky-scale",
                got=mode,
                expected="a finite number above 0",
            )
    return dome.scaled(factor), factor


def _level_luminance(dome: SkyDome) -> float:
    return float(luminance(dome.horizontal_irradiance()))


def sun_azimuth_deg(direction: Float[np.ndarray, "3"], geo: GeoReference | None) -> float | None:
    """Azimuth of a `world` direction, clockwise from true north; None if the heading is unknown."""
    if geo is None or geo.enu_from_world is None:
        return None
    return azimuth_elevation(geo.enu_from_world.rotate(direction)).azimuth_deg
