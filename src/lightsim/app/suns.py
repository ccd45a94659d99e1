"""The sun of a state: its position, and the sky option of a sun that was dragged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lightsim.core.log import GeoReference
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import SolarPosition, azimuth_elevation
from lightsim.core.twin import SkyEstimate
from lightsim.lighting.target_sky import towards_sun
from lightsim.simulation.skies import clear_sun, parse_sky

MIN_ELEVATION_DEG = 1.0
"""Lowest sun that can be chosen: lower ones are twilight, which is not modelled."""
DEFAULT_TURBIDITY = 3.0
"""Turbidity of a clear sky that replaces the recorded one."""


def sun_of(sky: SkyChoice, geo: GeoReference | None, source: SkyEstimate) -> SolarPosition | None:
    """Return the sun of a sky by its words; None for a sky file, whose pixels determine it, and for
    a source sky without sun."""
    request = parse_sky(sky)
    if request.moved_sun is not None:
        return SolarPosition(*request.moved_sun)
    clear = clear_sun(request, geo)
    if clear is not None:
        return SolarPosition(clear[0], clear[1])
    if request.path is not None or source.dome.sun is None:
        return None
    return position_of(source.dome.sun.direction_world, geo)


def direction_of(sun: SolarPosition, geo: GeoReference | None) -> Float[np.ndarray, "3"]:
    """Return the unit vector in frame `world` towards a sun."""
    return towards_sun(sun.azimuth_deg, sun.elevation_deg, geo)[0]


def position_of(direction_world: Float[np.ndarray, "3"], geo: GeoReference | None) -> SolarPosition:
    """Return azimuth and elevation of a direction: the inverse of `direction_of`."""
    if geo is None or geo.enu_from_world is None:
        return azimuth_elevation(direction_world)
    return azimuth_elevation(geo.enu_from_world.rotate(direction_world))


def with_dragged_sun(sky: SkyChoice, sun: SolarPosition, turbidity: float) -> SkyChoice:
    """Return the sky after its sun was dragged: in a file the sun is moved; the recorded sky and a
    time become a clear sky."""
    elevation = min(max(sun.elevation_deg, MIN_ELEVATION_DEG), 90.0)
    place = f"{sun.azimuth_deg % 360.0:.1f},{elevation:.1f}"
    if parse_sky(sky).path is not None:
        return replace(sky, move_sun=place)
    return replace(sky, sky=f"sun:{place},{turbidity:g}", move_sun="")


def turbidity_of(sky: SkyChoice) -> float:
    """Return the turbidity of a clear sky; the default for other skies."""
    sun = parse_sky(sky).sun
    return DEFAULT_TURBIDITY if sun is None else sun[2]
