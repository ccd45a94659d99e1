"""Physical models of cloudless and overcast skies, and their absolute brightness.

The clear sky is the Hosek-Wilkie model as Mitsuba's `sunsky` emitter evaluates it (Hosek & Wilkie
2012, doi:10.1145/2185520.2185591; solar disc: Hosek & Wilkie 2013, doi:10.1109/MCG.2013.18). Sky
and sun come from one model, so their ratio is absolute. One factor converts both into scene units:
a white level Lambert surface under a sun at 45 degrees, turbidity 3 and ground albedo 0.2 has a
luminance of 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.dome import SOLAR_RADIUS_DEG, SkyDome, Sun, add_sun, irradiance
from lightsim.core.equirect import pixel_directions
from lightsim.core.mitsuba_variants import mitsuba_with
from lightsim.errors import InputError

# Scene units per unit of the model: pi / (level luminance irradiance of the model at 45 degrees,
# turbidity 3, albedo 0.2).
SCENE_UNITS_PER_MODEL_UNIT = 2.840
# Albedo of the ground under analytic skies, and of ground that was not observed; a common value of
# grey asphalt and vegetation.
GROUND_ALBEDO = 0.2
# Turbidities for which the model is tabulated.
TURBIDITY_RANGE = (1.0, 10.0)


def clear_sky(
    sun_direction_world: Float[np.ndarray, "3"], turbidity: float = 3.0, height_px: int = 256
) -> SkyDome:
    """Return a cloudless sky with its sun, frame `world`, scene units (see the module docstring).

    The lower half shows a Lambert ground of `GROUND_ALBEDO` lit by this sky.

    Raises:
        InputError: the sun is below the horizon (twilight is not modelled), or the turbidity lies
            outside 1 to 10.
    """
    radiance, sun = clear_sky_parts(sun_direction_world, turbidity, GROUND_ALBEDO, height_px)
    level = level_irradiance(radiance) + sun.irradiance * sun.direction_world[2]
    return add_sun(with_ground(radiance, GROUND_ALBEDO * level / np.pi), sun)


def clear_sky_parts(
    sun_direction_world: Float[np.ndarray, "3"],
    turbidity: float,
    ground_albedo: float,
    height_px: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Sun]:
    """Return the radiance of a cloudless sky without its sun (lower half black), and the sun.

    Raises:
        InputError: see `clear_sky`.
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
        "sun_aperture": 2 * SOLAR_RADIUS_DEG,
    }
    upper = pixel_directions(height_px)[: height_px // 2]
    # Sky and disc are evaluated separately: on the dome's grid the disc would be undersampled.
    with mitsuba_with("scalar_rgb") as mitsuba:
        sky = _evaluate(mitsuba, common | {"sun_scale": 0.0}, upper.reshape(-1, 3))
        disc = _evaluate(mitsuba, common | {"sky_scale": 0.0}, direction[None])
    radiance = np.zeros((height_px, 2 * height_px, 3), np.float32)
    radiance[: height_px // 2] = sky.reshape(*upper.shape)
    solid_angle_sr = 2 * np.pi * (1 - np.cos(np.radians(SOLAR_RADIUS_DEG)))
    sun = Sun(direction, (disc[0] * solid_angle_sr).astype(np.float32))
    return radiance, sun


def overcast_shape(height_px: int) -> Float32[np.ndarray, "h w 3"]:
    """Radiance of the CIE overcast sky relative to its zenith, lower half black.

    (1 + 2 sin elevation) / 3 (Moon & Spencer 1942; ISO 15469:2004, sky type 16).
    """
    elevation_sine = pixel_directions(height_px)[..., 2:3]
    shape = np.where(elevation_sine > 0, (1 + 2 * elevation_sine) / 3, 0.0)
    return np.repeat(shape, 3, axis=-1).astype(np.float32)


def level_irradiance(radiance: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"]:
    """RGB irradiance of a dome on level ground."""
    return irradiance(radiance, np.array([0.0, 0.0, 1.0]))


def with_ground(
    radiance: Float32[np.ndarray, "h w 3"], ground_radiance: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the dome with one RGB radiance in its lower half."""
    filled = radiance.copy()
    filled[radiance.shape[0] // 2 :] = ground_radiance.astype(np.float32)
    return filled


def _checked_direction(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    unit = direction / np.linalg.norm(direction)
    elevation_deg = float(np.degrees(np.arcsin(unit[2])))
    if elevation_deg <= 0:
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
    """Radiance of an emitter along directions, scene units."""
    loaded = mitsuba.load_dict(emitter)
    interaction = mitsuba.SurfaceInteraction3f()
    values = np.empty((len(directions), 3))
    for i, (x, y, z) in enumerate((-directions).tolist()):
        interaction.wi = [x, y, z]
        values[i] = loaded.eval(interaction)
    # Skies of low suns leave the sRGB gamut: negative channels are clipped.
    return (np.maximum(values, 0.0) * SCENE_UNITS_PER_MODEL_UNIT).astype(np.float32)
