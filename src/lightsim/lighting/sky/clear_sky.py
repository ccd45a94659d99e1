"""Physical skies without clouds and with nothing but clouds, and how bright they are.

The clear sky is the Hosek-Wilkie family as Mitsuba's `sunsky` emitter evaluates it (Hosek &
Wilkie 2012, doi:10.1145/2185520.2185591; solar disc: Hosek & Wilkie 2013,
doi:10.1109/MCG.2013.18). Sky and sun come from one model, so their ratio is absolute. One factor
brings both into scene units: a white level Lambert surface under a sun at 45 degrees, turbidity 3
and ground albedo 0.2 shows a luminance of 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.dome import SOLAR_RADIUS_DEG, SkyDome, Sun, add_sun, irradiance
from lightsim.core.equirect import pixel_directions
from lightsim.core.mitsuba_variants import mitsuba_with
from lightsim.errors import InputError

SCENE_UNITS_PER_MODEL_UNIT = 2.840
"""pi / (level luminance irradiance of the model at 45 degrees, turbidity 3, albedo 0.2)."""
LUMINANCE_CD_M2 = 683.0 * 106.857 / SCENE_UNITS_PER_MODEL_UNIT
"""Luminance of one scene unit of a clear sky: the model's RGB is spectral radiance in
W / (m2 sr nm), weighted by CIE y and divided by the sum of y over nanometres, 106.857."""
TURBIDITY_RANGE = (1.0, 10.0)
_LOWEST_SUN_DEG = 0.0
_DISC_APERTURE_DEG = 2 * SOLAR_RADIUS_DEG


def clear_sky(
    sun_direction_world: Float[np.ndarray, "3"],
    turbidity: float = 3.0,
    ground_albedo: float = 0.2,
    height_px: int = 256,
) -> SkyDome:
    """A cloudless sky with its sun, frame `world`, scene units (see the module's first lines).

    The lower half shows a Lambert ground of `ground_albedo` under this very sky.

    Raises:
        InputError: the sun is below the horizon (twilight is not modelled), or the turbidity lies
            outside 1 to 10.
    """
    radiance, sun = clear_sky_parts(sun_direction_world, turbidity, ground_albedo, height_px)
    level = irradiance(radiance, np.array([0.0, 0.0, 1.0]))
    level += sun.irradiance * sun.direction_world[2]
    return add_sun(with_ground(radiance, ground_albedo * level / np.pi), sun)


def clear_sky_parts(
    sun_direction_world: Float[np.ndarray, "3"],
    turbidity: float,
    ground_albedo: float,
    height_px: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Sun]:
    """Radiance of the sky without its sun (lower half black), and the sun.

    Raises:
        InputError: as `clear_sky`.
    """
    direction = _checked_direction(sun_direction_world)
    low, high = TURBIDITY_RANGE
    if not low <= turbidity <= high:
        raise InputError(
            "the turbidity is out of range", got=turbidity, expected=f"{low} to {high}"
        )
    common = {
        "type": "sunsky",
        "turbidity": float(turbidity),
        "albedo": float(ground_albedo),
        "sun_direction": [float(x) for x in direction],
        "sun_aperture": _DISC_APERTURE_DEG,
    }
    upper = pixel_directions(height_px)[: height_px // 2]
    with mitsuba_with("scalar_rgb") as mitsuba:
        sky = _evaluate(mitsuba, common | {"sun_scale": 0.0}, upper.reshape(-1, 3))
        disc = _evaluate(mitsuba, common | {"sky_scale": 0.0}, direction[None])
    radiance = np.zeros((height_px, 2 * height_px, 3), np.float32)
    radiance[: height_px // 2] = sky.reshape(*upper.shape)
    solid_angle_sr = 2 * np.pi * (1 - np.cos(np.radians(_DISC_APERTURE_DEG / 2)))
    sun = Sun(direction, (disc[0] * solid_angle_sr).astype(np.float32))
    return radiance, sun


def overcast_shape(height_px: int) -> Float32[np.ndarray, "h w 3"]:
    """CIE overcast radiance over its zenith's, lower half black.

    (1 + 2 sin elevation) / 3 (Moon & Spencer 1942; ISO 15469:2004, sky type 16).
    """
    elevation_sine = pixel_directions(height_px)[..., 2:3]
    shape = np.where(elevation_sine > 0, (1 + 2 * elevation_sine) / 3, 0.0)
    return np.repeat(shape, 3, axis=-1).astype(np.float32)


def with_ground(
    radiance: Float32[np.ndarray, "h w 3"], ground_radiance: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "h w 3"]:
    """The dome with one RGB radiance in its lower half."""
    filled = radiance.copy()
    filled[radiance.shape[0] // 2 :] = ground_radiance.astype(np.float32)
    return filled


def _checked_direction(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    unit = direction / np.linalg.norm(direction)
    elevation_deg = float(np.degrees(np.arcsin(unit[2])))
    if elevation_deg <= _LOWEST_SUN_DEG:
        raise InputError(
            "the sun is below the horizon: twilight and night skies are not modelled",
            got=f"elevation {elevation_deg:.2f} degrees",
            expected="an elevation above 0",
            remedy="Choose an earlier or later time, or give an HDR file as the sky.",
        )
    return unit


def _evaluate(
    mitsuba: Any, emitter: dict[str, Any], directions: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Radiance of an emitter along directions; low suns leave the sRGB gamut, clipped at 0."""
    loaded = mitsuba.load_dict(emitter)
    interaction = mitsuba.SurfaceInteraction3f()
    values = np.empty((len(directions), 3))
    for i, (x, y, z) in enumerate((-directions).tolist()):
        interaction.wi = [x, y, z]
        values[i] = loaded.eval(interaction)
    return (np.maximum(values, 0.0) * SCENE_UNITS_PER_MODEL_UNIT).astype(np.float32)
