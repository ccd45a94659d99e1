"""Estimation of a log's HDR sky dome from observed sky, an analytic completion and the sun."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.optimize import nnls

from lightsim.core.colour import luminance
from lightsim.core.dome import Sun, add_sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.solar import angle_between_deg
from lightsim.core.twin import LightPrior, Panorama, SkyEstimate
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.blend import blend_observed, shrink_masked, unseen_weight
from lightsim.lighting.sky.clear_sky import (
    GROUND_ALBEDO,
    clear_sky_parts,
    level_irradiance,
    overcast_shape,
    with_ground,
)
from lightsim.lighting.sun.direction import SunDirection, find_sun_blob
from lightsim.progress import Progress, SilentProgress

# Chosen on streets 0 and 1 and log 002; measured only in combination
# (docs/benchmarks/lighting.md).

# Turbidity of a typical clear sky.
_TYPICAL_TURBIDITY = 3.0
# Standard deviation of the log ratio of sun to sky among clear skies.
_SUN_TO_SKY_LOG_STD = 0.8
# Log of the fraction of the sun's irradiance that a cloud before it transmits.
_CLOUD_LOG_FACTOR = float(np.log(0.15))
# Standard deviation, in logs, that is added for errors which no fit or network includes.
_MODEL_LOG_STD = 0.2
# Rows of the domes whose peak the networks predict (lighting/sample.py).
_PEAK_ROWS = 64
# Rows of the reduced panorama to which the analytic sky is fitted.
_FIT_HEIGHT_PX = 64
# Candidate turbidities of the clear part.
_TURBIDITIES = (2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
# Angle around the sun in which the sky is not fitted, in degrees: forward scattering and glare
# dominate there.
_SUN_GAP_DEG = 6.0


@dataclass(frozen=True)
class SkyConfig:
    """Settings of the sky estimate."""

    height_px: int = 256
    """Rows of the dome."""


@dataclass(frozen=True, eq=False)
class AnalyticFit:
    """Clear and overcast sky fitted to the observed sky.

    Args:
        radiance: the fitted sky without sun, lower half black.
        turbidity: turbidity of the clear part.
        overcast_fraction: part of the level illuminance that comes from the overcast part.
        clear_sun_irradiance: RGB irradiance of the clear part's sun, without cloud before it.
        residual: median relative residual of the luminance.
        observed_count: number of fitted cells.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    turbidity: float
    overcast_fraction: float
    clear_sun_irradiance: Float32[np.ndarray, "3"]
    residual: float
    observed_count: int


@dataclass(frozen=True, eq=False)
class _SunStrength:
    """Irradiance of the sun as estimated from the sky alone, without shadows.

    Args:
        irradiance: RGB, including the expected attenuation by cloud.
        log_std: one standard deviation of the log of its luminance.
        log_clear: log of a clear sun's irradiance over `irradiance`.
        clear_log_std: one standard deviation of the log of a clear sun.
        notes: evidence that was used.
    """

    irradiance: Float32[np.ndarray, "3"]
    log_std: float
    log_clear: float
    clear_log_std: float
    notes: tuple[str, ...]


def estimate_sky(
    panorama: Panorama,
    sun: SunDirection,
    config: SkyConfig,
    *,
    prediction: SkyPrediction | None = None,
    progress: Progress | None = None,
) -> tuple[SkyEstimate, LightPrior]:
    """Estimate the source sky in scene units from the panorama, and its remaining uncertainty.

    An analytic clear + overcast sky is fitted per channel to the observed, unsaturated sky; the
    dome shows observed sky where there is any. The lower half is the mean of the observed ground.
    The sun's irradiance is that of clear skies, attenuated by the probability of cloud, combined
    with a network's `prediction` (in the panorama's unit) if there is one. Its uncertainty is
    large; shadows and materials, if a log has them, reduce it (appearance.intrinsic.balance).
    """
    steps = (progress or SilentProgress()).track(range(2), "estimating the sky")
    next(steps)
    analytic = fit_analytic_sky(panorama, sun.direction_world, config)
    next(steps)
    sky = blend_observed(panorama, analytic.radiance)
    ground = _ground_radiance(panorama, sky)
    strength = _sun_from_sky(analytic, sky, sun)
    if prediction is not None:
        strength = _with_prediction(strength, prediction)
    dome = add_sun(with_ground(sky, ground), Sun(sun.direction_world, strength.irradiance))
    for _ in steps:
        continue
    level_log_std = _level_log_std(panorama)
    estimate = SkyEstimate(
        dome,
        sun.azimuth_deg,
        sun.elevation_deg,
        sun.origin,
        sun.uncertainty_deg,
        float(np.hypot(strength.log_std, level_log_std)),
        level_irradiance(sky).astype(np.float32),
        level_log_std,
        (*sun.notes, *_sky_notes(panorama, analytic, sun), *strength.notes),
    )
    return estimate, LightPrior(
        unseen_weight(panorama, config.height_px).astype(np.float32),
        level_log_std,
        strength.log_clear,
        strength.clear_log_std,
        0.5 if sun.sunny_probability is None else 1.0 - sun.sunny_probability,
    )


def _sun_from_sky(
    analytic: AnalyticFit, sky: Float32[np.ndarray, "h w 3"], sun: SunDirection
) -> _SunStrength:
    """Estimate the sun from the fitted clear part and from the typical ratio of sun to sky at its
    elevation.

    Both logs are weighted by the inverse of their variances; the expected attenuation by cloud is
    included.
    """
    radiance, clear = clear_sky_parts(
        sun.direction_world, _TYPICAL_TURBIDITY, GROUND_ALBEDO, _FIT_HEIGHT_PX
    )
    usual_ratio = _grey(clear.irradiance) / _grey(level_irradiance(radiance))
    usual = np.log(usual_ratio * _grey(level_irradiance(sky)))
    fitted = np.log(max(_grey(analytic.clear_sun_irradiance), 1e-9))
    # Heuristic: a poor or mostly overcast fit carries little information about a clear sun.
    fit_std = 0.2 + 8.0 * analytic.residual + 2.0 * analytic.overcast_fraction
    weight = _SUN_TO_SKY_LOG_STD**2 / (_SUN_TO_SKY_LOG_STD**2 + fit_std**2)
    sunny = sun.sunny_probability
    if sunny is None:
        sunny = 1.0 - analytic.overcast_fraction
    # Precision-weighted mean of the logs of the typical and of the fitted sun.
    log_clear = usual + weight * (fitted - usual)
    log_cloud = (1.0 - sunny) * _CLOUD_LOG_FACTOR
    # Standard deviation of a two-valued variable: the sun is either clear or behind cloud.
    cloud_log_std = abs(_CLOUD_LOG_FACTOR) * np.sqrt(sunny * (1.0 - sunny))
    clear_log_std = float(np.hypot(np.sqrt(weight) * fit_std, _MODEL_LOG_STD))
    rgb = clear.irradiance.astype(np.float64)
    rgb *= np.exp(log_clear + log_cloud) / _grey(rgb)
    note = (
        f"sun irradiance from the sky alone: that of clear skies (turbidity"
        f" {analytic.turbidity:g}), with probability {sunny:.2f} of no cloud before it"
    )
    return _SunStrength(
        rgb.astype(np.float32),
        float(np.hypot(clear_log_std, cloud_log_std)),
        -log_cloud,
        clear_log_std,
        (note,),
    )


def _with_prediction(strength: _SunStrength, prediction: SkyPrediction) -> _SunStrength:
    """Combine the estimate with the brightest pixel that a network predicts, weighted by
    precision."""
    direction = prediction.sun_direction.astype(np.float64)
    # The predicted peak is a radiance; times the solid angle of its pixel it is an irradiance.
    row = int(np.arccos(np.clip(direction[2], 0.0, 1.0)) / np.pi * _PEAK_ROWS)
    peak = prediction.log_peak + np.log(solid_angles_sr(_PEAK_ROWS)[min(row, _PEAK_ROWS - 1), 0])
    peak_std = float(np.hypot(prediction.log_peak_std, _MODEL_LOG_STD))
    own = np.log(_grey(strength.irradiance))
    weight = strength.log_std**2 / (strength.log_std**2 + peak_std**2)
    change = float(weight * (peak - own))
    note = (
        f"the network predicts a sun irradiance that differs by {peak - own:+.2f} (log; weight"
        f" {weight:.2f})"
    )
    return replace(
        strength,
        irradiance=(strength.irradiance * np.exp(change)).astype(np.float32),
        log_std=float(np.sqrt(weight) * peak_std),
        log_clear=strength.log_clear - change,
        notes=(*strength.notes, note),
    )


def _grey(rgb: Float[np.ndarray, "3"]) -> float:
    return float(luminance(rgb))


def fit_analytic_sky(
    panorama: Panorama, sun_direction_world: Float[np.ndarray, "3"], config: SkyConfig
) -> AnalyticFit:
    """Fit a clear + b overcast (a, b >= 0) per channel, with the turbidity of least median error.

    Relative residuals are reweighted twice, so that clouds and masts count less.
    """
    observed, is_used = _shrunk_sky(panorama, sun_direction_world)
    low, full = _FIT_HEIGHT_PX, config.height_px
    overcast = overcast_shape(low)[is_used].astype(np.float64)
    best: tuple[float, float, Float[np.ndarray, "3 2"]] | None = None
    # Only the turbidity is searched: the model is linear in the weights.
    for turbidity in _TURBIDITIES:
        clear, _ = clear_sky_parts(sun_direction_world, turbidity, GROUND_ALBEDO, low)
        weights = _fit_channels(observed, clear[is_used].astype(np.float64), overcast)
        model = clear[is_used] * weights[:, 0] + overcast * weights[:, 1]
        error = np.abs(model - observed) / np.maximum(observed, 1e-6)
        score = float(np.median(error)) if len(observed) else 0.0
        if best is None or score < best[0] - 1e-4:
            best = (score, turbidity, weights)
    assert best is not None
    residual, turbidity, weights = best
    if not len(observed):
        turbidity, weights = (
            _TYPICAL_TURBIDITY,
            np.tile([_unseen_scale(panorama, sun_direction_world), 0.0], (3, 1)),
        )
    clear, clear_sun = clear_sky_parts(sun_direction_world, turbidity, GROUND_ALBEDO, full)
    cloud = overcast_shape(full) * weights[:, 1]
    radiance = (clear * weights[:, 0] + cloud).astype(np.float32)
    total = float(level_irradiance(radiance).sum())
    fraction = float(level_irradiance(cloud).sum() / max(total, 1e-12))
    sun_rgb = clear_sun.irradiance * weights[:, 0].mean()
    return AnalyticFit(
        radiance, turbidity, fraction, sun_rgb.astype(np.float32), residual, len(observed)
    )


def _fit_channels(
    observed: Float[np.ndarray, "n 3"],
    clear: Float[np.ndarray, "n 3"],
    overcast: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "3 2"]:
    """Non-negative weights (clear, overcast) of each channel by robust least squares."""
    weights = np.zeros((3, 2))
    for channel in range(3 if len(observed) else 0):
        target = np.maximum(observed[:, channel], 1e-4)
        columns = np.stack([clear[:, channel], overcast[:, channel]], axis=1) / target[:, None]
        robust_weight = np.ones(len(target))
        for _ in range(3):
            root = np.sqrt(robust_weight)
            weights[channel], _ = nnls(columns * root[:, None], root)
            # Huber weights: relative errors above 10 % count linearly.
            robust_weight = 1.0 / np.maximum(np.abs(columns @ weights[channel] - 1.0) / 0.1, 1.0)
    return weights


def _shrunk_sky(
    panorama: Panorama, sun_direction_world: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "h w"]]:
    """Observed unsaturated sky away from the sun, averaged to the fit's grid, and the mask of used
    cells."""
    low = _FIT_HEIGHT_PX
    usable = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    mean, coverage = shrink_masked(panorama.radiance, usable, low)
    directions = pixel_directions(low)
    is_far = directions @ sun_direction_world < np.cos(np.radians(_SUN_GAP_DEG))
    is_used = (coverage > 0.3) & is_far & (directions[..., 2] > 0)
    return mean[is_used].astype(np.float64), is_used


def _unseen_scale(panorama: Panorama, sun_direction_world: Float[np.ndarray, "3"]) -> float:
    """Return the scale of the clear sky if no sky was observed: under it, surfaces of albedo 0.2,
    half of them in shadow, have the observed mean radiance."""
    sky, sun = clear_sky_parts(
        sun_direction_world, _TYPICAL_TURBIDITY, GROUND_ALBEDO, _FIT_HEIGHT_PX
    )
    # Half of the surfaces are taken to be in shadow; the cosine is bounded for low suns.
    sine = max(float(sun_direction_world[2]), 0.2)
    level = level_irradiance(sky) + 0.5 * sun.irradiance * sine
    surfaces = panorama.radiance[panorama.is_seen & ~panorama.is_sky]
    if not len(surfaces):
        return 1.0
    seen = float(luminance(surfaces).mean())
    return seen * np.pi / GROUND_ALBEDO / float(luminance(level.astype(np.float32)))


def _level_log_std(panorama: Panorama) -> float:
    """Log standard deviation of the sky's irradiance: 0.3 if no sky was observed (error of
    extrapolation from the strip at the horizon), reduced by the observed fraction."""
    height = panorama.radiance.shape[0]
    weight = np.clip(pixel_directions(height)[..., 2], 0.0, None) * solid_angles_sr(height)
    seen = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    return float(0.3 * (1.0 - weight[seen].sum() / weight.sum()))


def _ground_radiance(
    panorama: Panorama, sky: Float32[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "3"]:
    """Mean radiance observed below the horizon; if too little was observed, of a Lambert ground
    under the sky."""
    below = panorama.is_seen & ~panorama.is_sky
    below[: below.shape[0] // 2] = False
    if below.mean() > 0.02:
        return panorama.radiance[below].astype(np.float64).mean(axis=0)
    return GROUND_ALBEDO * level_irradiance(sky) / np.pi


def _sky_notes(panorama: Panorama, analytic: AnalyticFit, sun: SunDirection) -> tuple[str, ...]:
    """Notes on the fit and on the clipped spot nearest to the sun."""
    fitted = (
        f"sky: turbidity {analytic.turbidity:g}, {100 * analytic.overcast_fraction:.0f} % of its"
        f" light overcast, median residual {100 * analytic.residual:.0f} % over"
        f" {analytic.observed_count} cells"
    )
    if not analytic.observed_count:
        fitted = "no unsaturated sky was observed: a clear sky of turbidity 3 is assumed"
    blob = find_sun_blob(panorama, sun.direction_world)
    if blob is None:
        return (fitted, "the sun's disc was not observed")
    off_deg = angle_between_deg(blob.direction_world, sun.direction_world)
    cut = ", partly hidden" if blob.is_cut else ""
    return (
        fitted,
        f"a clipped spot (radius {blob.radius_deg:.1f} degrees{cut}) is {off_deg:.2f} degrees"
        " from the sun",
    )
