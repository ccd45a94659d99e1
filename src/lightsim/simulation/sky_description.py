"""A sky without a log in words: `lightsim sky show`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import azimuth_elevation
from lightsim.lighting.night import looks_like_night
from lightsim.simulation.skies import TargetSky
from lightsim.store.sky import read_heading

_EAST_DEG = 90.0
"""Azimuth of world +x where world +y is taken as north."""
_PLAIN = (1e-3, 1e5)
"""Numbers that are written without a power of ten."""


def describe_sky(choice: SkyChoice, sky: TargetSky) -> Iterator[str]:
    """Yield lines: what was read and changed, light on level ground, and the sun in the words of
    `--sky sun:`."""
    height, width = sky.dome.radiance.shape[:2]
    yield f"sky: {choice.sky}, {width}x{height} px"
    if "description" in sky.facts:
        yield f"description: {sky.facts['description']}"
    heading_deg = None if choice.path is None else read_heading(choice.path)
    yield _north(choice, heading_deg)
    for note in sky.facts.get("notes", ()):
        yield f"note: {note}"
    if choice.path is not None and looks_like_night(sky.dome):
        yield "note: looks like a night panorama: what is taken as the sun may be a lamp"
    unit = "scene units" if choice.path is None else "the file's radiance"
    level, of_sky = sky.facts["horizontal_irradiance"], sky.facts["sky_irradiance"]
    yield f"irradiance on level ground: {_digits(level)} (red green blue, {unit} x sr)"
    yield f"of it from the sky without the sun: {_digits(of_sky)}"
    direction, light = sky.facts["sun_direction_world"], sky.facts["sun_irradiance"]
    if direction is None:
        yield "sun: none found"
        return
    yield f"sun irradiance on a surface that faces it: {_digits(light)}"
    yield _sun(direction, _EAST_DEG if heading_deg is None else heading_deg)


def _north(choice: SkyChoice, heading_deg: float | None) -> str:
    if heading_deg is None:
        taken = "world +y" if choice.path is None else "not in the file; world +y is taken"
        return f"north: {taken}, so the centre column looks east"
    return f"north: the centre column looks towards azimuth {heading_deg % 360:.1f} degrees"


def _sun(direction_world: Sequence[float], heading_deg: float) -> str:
    """Azimuth clockwise from north; `heading_deg` is that of world +x."""
    found = azimuth_elevation(np.asarray(direction_world, dtype=np.float64))
    azimuth = f"{(found.azimuth_deg - _EAST_DEG + heading_deg) % 360:.1f}"
    azimuth = "0.0" if azimuth == "360.0" else azimuth
    elevation = f"{found.elevation_deg:.1f}"
    line = f"sun: azimuth {azimuth}, elevation {elevation} degrees"
    # sun: takes no elevation of 0 or less.
    return f"{line} (--sky sun:{azimuth},{elevation})" if float(elevation) > 0 else line


def _digits(rgb: Sequence[float]) -> str:
    """Three digits of each number; powers of ten only where they save more than they hide."""
    return " ".join(
        np.format_float_positional(value, 3, unique=False, fractional=False, trim="k").rstrip(".")
        if _PLAIN[0] <= value < _PLAIN[1]
        else f"{value:.3g}"
        for value in rgb
    )
