"""Errors of an estimated sky against ephemeris, the sun in the picture, or a true sky."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, irradiance, split_sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.solar import angle_between_deg
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError

# Rows of the grid of normals on the white sphere.
_SPHERE_HEIGHT = 16
_NAMES = {
    "sun_error_ephemeris_deg": "sun against ephemeris, degrees",
    "sun_error_observed_deg": "sun against the one in the pictures, degrees",
    "sun_error_truth_deg": "sun against truth, degrees",
    "sun_irradiance_error_ev": "sun irradiance, stops over truth",
    "sky_irradiance_error_ev": "sky irradiance on level ground, stops over truth",
    "horizontal_error_ev": "all light on level ground, stops over truth",
    "sky_colour_error_deg": "angle between sky colours, degrees",
    "sphere_rmse": "white sphere, relative RMSE",
    "sphere_si_rmse": "white sphere, relative RMSE at the best scale",
}


@dataclass(frozen=True)
class SkyReport:
    """Errors of a sky; None means that there was no reference.

    Args:
        sun_error_ephemeris_deg: angle to the sun computed from time and place.
        sun_error_observed_deg: angle to the sun found in an image.
        sun_error_truth_deg: angle to the true sun.
        sun_irradiance_error_ev: log2 of estimated over true luminance of the sun's irradiance.
        sky_irradiance_error_ev: the same for the sky without sun on level ground.
        horizontal_error_ev: the same for sky and sun on level ground.
        sky_colour_error_deg: angle between the RGB irradiances of the two skies.
        sphere_rmse: RMSE of the radiance of a white diffuse sphere, relative to its RMS.
        sphere_si_rmse: the same after the optimal common factor.
    """

    sun_error_ephemeris_deg: float | None = None
    sun_error_observed_deg: float | None = None
    sun_error_truth_deg: float | None = None
    sun_irradiance_error_ev: float | None = None
    sky_irradiance_error_ev: float | None = None
    horizontal_error_ev: float | None = None
    sky_colour_error_deg: float | None = None
    sphere_rmse: float | None = None
    sphere_si_rmse: float | None = None

    def to_table(self) -> str:
        """Return the measured errors as Markdown."""
        lines = ["| sky | error |", "|---|---:|"]
        values = {name: value for name, value in asdict(self).items() if value is not None}
        return "\n".join(
            lines + [f"| {_NAMES[name]} | {value:.3f} |" for name, value in values.items()]
        )

    def to_json(self) -> str:
        """Return all errors as JSON; errors without a reference are null."""
        return json.dumps(asdict(self), indent=2)


def evaluate_sky(
    estimate: SkyEstimate,
    *,
    truth: SkyDome | None = None,
    ephemeris_world: Float[np.ndarray, "3"] | None = None,
    observed_sun_world: Float[np.ndarray, "3"] | None = None,
) -> SkyReport:
    """Measure the errors of an estimated sky against the given references.

    Args:
        truth: the true dome in the same frame and unit.
        ephemeris_world: direction towards the sun computed from time and place.
        observed_sun_world: direction towards the sun found in an image.

    Raises:
        InputError: no reference is given.
    """
    if truth is None and ephemeris_world is None and observed_sun_world is None:
        raise InputError(
            "there is no reference for the sky",
            remedy="Give --truth of a synthetic log. Otherwise the log needs GPS and a heading, or "
            "the sun in its pictures.",
        )
    dome = estimate.dome
    measured = _compare_domes(dome, truth) if truth is not None else {}
    return SkyReport(
        sun_error_ephemeris_deg=_sun_angle_deg(dome, ephemeris_world),
        sun_error_observed_deg=_sun_angle_deg(dome, observed_sun_world),
        **measured,
    )


def _compare_domes(dome: SkyDome, truth: SkyDome) -> dict[str, float | None]:
    """Return the measures that require the true dome."""
    sky, sun = split_sun(dome)
    true_sky, true_sun = split_sun(truth)
    up = np.array([0.0, 0.0, 1.0])
    # Without the sun, which has its own error.
    light, true_light = irradiance(sky, up), irradiance(true_sky, up)
    sphere, true_sphere = sphere_radiance(dome), sphere_radiance(truth)
    sun_error_ev = None
    if sun is not None and true_sun is not None:
        sun_error_ev = _stops(sun.irradiance, true_sun.irradiance)
    return {
        "sun_error_truth_deg": _sun_angle_deg(dome, true_sun.direction_world)
        if true_sun is not None
        else None,
        "sun_irradiance_error_ev": sun_error_ev,
        "sky_irradiance_error_ev": _stops(light, true_light),
        "horizontal_error_ev": _stops(dome.horizontal_irradiance(), truth.horizontal_irradiance()),
        "sky_colour_error_deg": angle_between_deg(light, true_light),
        "sphere_rmse": relative_rmse(sphere, true_sphere),
        "sphere_si_rmse": relative_rmse(sphere, true_sphere, is_scale_free=True),
    }


def sphere_radiance(dome: SkyDome) -> Float[np.ndarray, "n 3"]:
    """Return the radiance of a white diffuse sphere (irradiance / pi) on a grid of normals.

    The sun is integrated separately as a direction, because pixels of a coarse dome would blur it.
    """
    sky, sun = split_sun(dome)
    normals = pixel_directions(_SPHERE_HEIGHT).reshape(-1, 3)
    directions = pixel_directions(dome.height_px).reshape(-1, 3)
    solid = np.repeat(solid_angles_sr(dome.height_px), 2 * dome.height_px, axis=0)
    weighted = sky.reshape(-1, 3).astype(np.float64) * solid
    # Clamped cosine: light from below the horizon of a normal does not count.
    total = np.clip(normals @ directions.T, 0.0, None) @ weighted
    if sun is not None:
        cosine = np.clip(normals @ sun.direction_world, 0.0, None)
        total += cosine[:, None] * sun.irradiance
    return total / np.pi


def relative_rmse(
    predicted: Float[np.ndarray, "n 3"],
    truth: Float[np.ndarray, "n 3"],
    *,
    is_scale_free: bool = False,
) -> float:
    """Return the RMSE over the RMS of the truth on the grid of `sphere_radiance`, by solid angle.

    Args:
        is_scale_free: multiply the prediction by the optimal factor first, one for all channels.
    """
    weight = np.repeat(solid_angles_sr(_SPHERE_HEIGHT), 2 * _SPHERE_HEIGHT, axis=0)
    scale = 1.0
    if is_scale_free:
        power = float((weight * predicted**2).sum())
        scale = float((weight * predicted * truth).sum()) / power if power > 0 else 0.0
    error = float((weight * (scale * predicted - truth) ** 2).sum())
    return float(np.sqrt(error / float((weight * truth**2).sum())))


def _sun_angle_deg(dome: SkyDome, reference: Float[np.ndarray, "3"] | None) -> float | None:
    if reference is None or dome.sun is None:
        return None
    return angle_between_deg(dome.sun.direction_world, reference)


def _stops(estimate: Float[np.ndarray, "3"], truth: Float[np.ndarray, "3"]) -> float | None:
    """Return log2 of the ratio of luminances; None if either is 0."""
    a, b = (float(luminance(x.astype(np.float32))) for x in (estimate, truth))
    return float(np.log2(a / b)) if a > 0 and b > 0 else None
