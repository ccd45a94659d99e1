"""Text description of a sky without a log: `lightsim sky show`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from lightsim.core.solar import azimuth_elevation
from lightsim.lighting.night import is_night_panorama
from lightsim.simulation.target_sky import TargetSky

# Azimuth of world +x, in degrees, if world +y is taken as north.
_EAST_DEG = 90.0


def describe_sky(sky: TargetSky) -> Iterator[str]:
    """Yield lines of text: the file and its changes, light on level ground, and the sun as an
    argument of `--sky sun:`."""
    height, width = sky.dome.radiance.shape[:2]
    facts, record, path = sky.facts, sky.record, sky.facts.path
    yield f"sky: {facts.sky}, {width}x{height} px"
    if facts.description is not None:
        yield f"description: {facts.description}"
    heading_deg = facts.file_heading_deg
    yield _north(heading_deg, is_file=path is not None)
    for note in facts.notes:
        yield f"note: {note}"
    if path is not None and is_night_panorama(sky.dome):
        yield "note: looks like a night panorama: the detected sun may be a lamp"
    unit = "scene units" if path is None else "the file's radiance"
    level, of_sky = record["horizontal_irradiance"], record["sky_irradiance"]
    yield f"irradiance on level ground: {_digits(level)} (red green blue, {unit} x sr)"
    yield f"of it from the sky without the sun: {_digits(of_sky)}"
    if sky.sun is None:
        yield "sun: none found"
        return
    yield f"sun irradiance on a surface that faces it: {_digits(record['sun_irradiance'])}"
    yield _sun(sky.sun.direction_world, _EAST_DEG if heading_deg is None else heading_deg)


def _north(heading_deg: float | None, *, is_file: bool) -> str:
    if heading_deg is None:
        taken = "not in the file; world +y is assumed" if is_file else "world +y"
        return f"north: {taken}, so the centre column looks east"
    return f"north: the centre column looks towards azimuth {heading_deg % 360:.1f} degrees"


def _sun(direction_world: Float[np.ndarray, "3"], heading_deg: float) -> str:
    """Return azimuth and elevation of the sun; `heading_deg` is the azimuth of world +x."""
    found = azimuth_elevation(direction_world)
    azimuth = f"{(found.azimuth_deg - _EAST_DEG + heading_deg) % 360:.1f}"
    # Rounding to one digit may give 360.0, which is 0.0.
    azimuth = "0.0" if azimuth == "360.0" else azimuth
    elevation = f"{found.elevation_deg:.1f}"
    line = f"sun: azimuth {azimuth}, elevation {elevation} degrees"
    # `sun:` accepts elevations above 0 only.
    return f"{line} (--sky sun:{azimuth},{elevation})" if float(elevation) > 0 else line


def _digits(rgb: Sequence[float]) -> str:
    """Format RGB with three significant digits each, without a power of ten from 0.001 to 1e5."""
    return " ".join(
        np.format_float_positional(value, 3, unique=False, fractional=False, trim="k").rstrip(".")
        if 1e-3 <= value < 1e5
        else f"{value:.3g}"
        for value in rgb
    )
