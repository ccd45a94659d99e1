"""Operations on target skies: direction and edit of the sun, conversion of pixels, scaling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun, add_sun, split_sun
from lightsim.core.log import GeoReference
from lightsim.core.solar import direction_enu, direction_world
from lightsim.errors import InputError


def towards_sun(
    azimuth_deg: float, elevation_deg: float, geo: GeoReference | None
) -> tuple[Float[np.ndarray, "3"], str | None]:
    """Return the unit vector in `world` towards a sun whose azimuth is clockwise from true north.
    The second result is the assumption made if the heading is unknown, otherwise None."""
    if geo is not None and geo.enu_from_world is not None:
        return direction_world(azimuth_deg, elevation_deg, geo.enu_from_world), None
    assumed = "the heading is unknown: world +x is assumed to be east"
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


def dome_from_array(radiance: Float32[np.ndarray, "h w 3"], name: str) -> SkyDome:
    """Return the dome of a sky file's pixels, with its sun if it has one, in frame `world`.

    Args:
        radiance: linear sRGB, as `store.images.read_sky` returns it.
        name: of the file, for errors.

    Raises:
        InputError: not 2:1, not finite, negative, too bright, or black above the horizon.
    """
    try:
        dome = SkyDome(radiance, None)
    except InputError as error:
        raise error.at(name) from error
    if not dome.horizontal_irradiance().max() > 0:
        raise InputError(
            "all light of the sky is below the horizon",
            where=name,
            expected="the sky in the upper half of the picture",
            remedy="Turn the picture the right way up; row 0 is the zenith.",
        )
    return replace(dome, sun=split_sun(dome)[1])


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
                "a sky without light cannot be matched",
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
