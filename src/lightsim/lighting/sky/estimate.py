"""The HDR sky dome of a log: observed sky, analytic completion and the sun."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.optimize import nnls

from lightsim.core.colour import luminance
from lightsim.core.dome import Sun, add_sun, irradiance
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.core.solar import angle_between_deg
from lightsim.core.twin import LightFreedom, Panorama, SkyEstimate
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.blend import blend_observed, shrink_masked, unseen_weight
from lightsim.lighting.sky.clear_sky import clear_sky_parts, overcast_shape, with_ground
from lightsim.lighting.sun.direction import SunDirection, find_sun_blob
from lightsim.progress import Progress, SilentProgress

_USUAL_TURBIDITY, _USUAL_LOG_STD = 3.0, 0.8
"""Of clear skies; spread of the ratio of sun to sky among them."""
_CLOUD_LOG_FACTOR = float(np.log(0.15))
"""What clouds before the sun leave of it."""
_PEAK_ROWS = 64
"""Rows of the domes that networks predict peaks of (lighting/sample.py)."""


# Chosen with streets 0 and 1 and log 002 in view; only what all do together is measured
# (docs/benchmarks/lighting.md).

# Rows of the shrunk panorama that the analytic sky is fitted to.
_FIT_HEIGHT_PX = 64
# Candidates for the clear part.
_TURBIDITIES = (2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
# Sky nearer to the sun is not fitted: its glow is that of cloud and lens.
_SUN_GAP_DEG = 6.0
# Assumed where the ground was not seen.
_GROUND_ALBEDO = 0.2


@dataclass(frozen=True)
class SkyConfig:
    """How the dome is estimated."""

    height_px: int = 256
    """Rows of the dome."""


@dataclass(frozen=True, eq=False)
class AnalyticFit:
    """Clear and overcast parts that fit the observed sky.

    Args:
        radiance: the fitted sky without sun, lower half black.
        turbidity: of the clear part.
        overcast_fraction: part of the level illuminance that the overcast part brings.
        clear_sun_irradiance: the sun of the clear part, no cloud before it.
        residual: median relative residual of the luminance.
        observed_count: fitted cells.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    turbidity: float
    overcast_fraction: float
    clear_sun_irradiance: Float32[np.ndarray, "3"]
    residual: float
    observed_count: int


@dataclass(frozen=True, eq=False)
class _SunStrength:
    """What skies tell of their sun, before any shadow was looked at.

    Args:
        irradiance: RGB, with the likely part of cloud before it.
        log_std: one standard deviation of the log of its luminance.
        log_clear: log of a clear sun over `irradiance`.
        clear_log_std: one standard deviation of the log of a clear sun.
        notes: what was seen.
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
) -> tuple[SkyEstimate, LightFreedom]:
    """The source sky in scene units as far as the sky tells it, and how far it may be off.

    An analytic clear + overcast sky is fitted per channel to the observed, unsaturated sky; where
    sky was seen, the dome shows it. The lower half is the mean of what was seen below the horizon.
    The sun is that of clear skies, dimmed by the probability of cloud, and that of a network's
    `prediction` where there is one (in the panorama's unit); its uncertainty says so. Shadows and
    materials, where a log has them, say more (appearance.intrinsic.balance).
    """
    steps = (progress or SilentProgress()).track(range(2), "estimating the sky")
    next(steps)
    analytic = fit_analytic_sky(panorama, sun.direction_world, config)
    next(steps)
    sky = blend_observed(panorama, analytic.radiance)
    ground = _ground_radiance(panorama, sky, _GROUND_ALBEDO)
    strength = _usual_sun(analytic, sky, sun)
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
        irradiance(sky, np.array([0.0, 0.0, 1.0])).astype(np.float32),
        level_log_std,
        (*sun.notes, *_sky_notes(panorama, analytic, sun), *strength.notes),
    )
    return estimate, LightFreedom(
        unseen_weight(panorama, config.height_px).astype(np.float32),
        level_log_std,
        strength.log_clear,
        strength.clear_log_std,
        0.5 if sun.sunny_probability is None else 1.0 - sun.sunny_probability,
    )


def _usual_sun(
    analytic: AnalyticFit, sky: Float32[np.ndarray, "h w 3"], sun: SunDirection
) -> _SunStrength:
    """The sun of the fitted clear part, as far as it fits, and the usual ratio of sun to sky at
    that elevation; cloud, where likely, dims both."""
    up = np.array([0.0, 0.0, 1.0])
    radiance, clear = clear_sky_parts(
        sun.direction_world, _USUAL_TURBIDITY, _GROUND_ALBEDO, _FIT_HEIGHT_PX
    )
    usual_ratio = _grey(clear.irradiance) / _grey(irradiance(radiance, up))
    usual = np.log(usual_ratio * _grey(irradiance(sky, up)))
    fitted = np.log(max(_grey(analytic.clear_sun_irradiance), 1e-9))
    fit_std = 0.2 + 8.0 * analytic.residual + 2.0 * analytic.overcast_fraction
    weight = _USUAL_LOG_STD**2 / (_USUAL_LOG_STD**2 + fit_std**2)
    sunny = sun.sunny_probability
    if sunny is None:
        sunny = 1.0 - analytic.overcast_fraction
    log_clear = usual + weight * (fitted - usual)
    log_cloud = (1.0 - sunny) * _CLOUD_LOG_FACTOR
    spread = abs(_CLOUD_LOG_FACTOR) * np.sqrt(sunny * (1.0 - sunny))
    clear_log_std = float(np.hypot(np.sqrt(weight) * fit_std, 0.2))
    rgb = clear.irradiance.astype(np.float64)
    rgb *= np.exp(log_clear + log_cloud) / _grey(rgb)
    note = (
        f"the sky's own sun: that of clear skies (turbidity {analytic.turbidity:g}), with"
        f" probability {sunny:.2f} of no cloud before it"
    )
    return _SunStrength(
        rgb.astype(np.float32),
        float(np.hypot(clear_log_std, spread)),
        -log_cloud,
        clear_log_std,
        (note,),
    )


def _with_prediction(strength: _SunStrength, prediction: SkyPrediction) -> _SunStrength:
    """Joined with the brightest pixel that a network predicts, both weighted by their precision."""
    direction = prediction.sun_direction.astype(np.float64)
    row = int(np.arccos(np.clip(direction[2], 0.0, 1.0)) / np.pi * _PEAK_ROWS)
    peak = prediction.log_peak + np.log(solid_angles_sr(_PEAK_ROWS)[min(row, _PEAK_ROWS - 1), 0])
    peak_std = float(np.hypot(prediction.log_peak_std, 0.2))
    own = np.log(_grey(strength.irradiance))
    weight = strength.log_std**2 / (strength.log_std**2 + peak_std**2)
    change = float(weight * (peak - own))
    note = f"a network's peak is {peak - own:+.2f} from it (log; weight {weight:.2f})"
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
    """Per channel a clear + b overcast (a, b >= 0) with the turbidity that fits best.

    Relative residuals, reweighted twice so that clouds and masts count less.
    """
    observed, is_used = _shrunk_sky(panorama, sun_direction_world)
    low, full = _FIT_HEIGHT_PX, config.height_px
    overcast = overcast_shape(low)[is_used].astype(np.float64)
    best: tuple[float, float, Float[np.ndarray, "3 2"]] | None = None
    for turbidity in _TURBIDITIES:
        clear, _ = clear_sky_parts(sun_direction_world, turbidity, _GROUND_ALBEDO, low)
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
            3.0,
            np.tile([_unseen_scale(panorama, sun_direction_world), 0.0], (3, 1)),
        )
    clear, clear_sun = clear_sky_parts(sun_direction_world, turbidity, _GROUND_ALBEDO, full)
    cloud = overcast_shape(full) * weights[:, 1]
    radiance = (clear * weights[:, 0] + cloud).astype(np.float32)
    up = np.array([0.0, 0.0, 1.0])
    total = float(irradiance(radiance, up).sum())
    fraction = float(irradiance(cloud, up).sum() / max(total, 1e-12))
    sun_rgb = clear_sun.irradiance * weights[:, 0].mean()
    return AnalyticFit(
        radiance, turbidity, fraction, sun_rgb.astype(np.float32), residual, len(observed)
    )


def _fit_channels(
    observed: Float[np.ndarray, "n 3"],
    clear: Float[np.ndarray, "n 3"],
    overcast: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "3 2"]:
    weights = np.zeros((3, 2))
    for channel in range(3 if len(observed) else 0):
        target = np.maximum(observed[:, channel], 1e-4)
        columns = np.stack([clear[:, channel], overcast[:, channel]], axis=1) / target[:, None]
        trust = np.ones(len(target))
        for _ in range(3):
            root = np.sqrt(trust)
            weights[channel], _ = nnls(columns * root[:, None], root)
            trust = 1.0 / np.maximum(np.abs(columns @ weights[channel] - 1.0) / 0.1, 1.0)
    return weights


def _shrunk_sky(
    panorama: Panorama, sun_direction_world: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "h w"]]:
    """Observed unsaturated sky, averaged to the fit's grid, away from the sun."""
    low = _FIT_HEIGHT_PX
    usable = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    mean, coverage = shrink_masked(panorama.radiance, usable, low)
    directions = pixel_directions(low)
    is_far = directions @ sun_direction_world < np.cos(np.radians(_SUN_GAP_DEG))
    is_used = (coverage > 0.3) & is_far & (directions[..., 2] > 0)
    return mean[is_used].astype(np.float64), is_used


def _unseen_scale(panorama: Panorama, sun_direction_world: Float[np.ndarray, "3"]) -> float:
    """Without any sky seen: the scale that lets surfaces of albedo 0.2, half of them in shadow,
    shine as they do in the images."""
    sky, sun = clear_sky_parts(sun_direction_world, 3.0, 0.2, 64)
    level = irradiance(sky, np.array([0.0, 0.0, 1.0])) + 0.5 * sun.irradiance * max(
        float(sun_direction_world[2]), 0.2
    )
    surfaces = panorama.radiance[panorama.is_seen & ~panorama.is_sky]
    if not len(surfaces):
        return 1.0
    seen = float(luminance(surfaces).mean())
    return seen * np.pi / 0.2 / float(luminance(level.astype(np.float32)))


def _level_log_std(panorama: Panorama) -> float:
    """Log standard deviation of the sky's irradiance: 0.3 for a sky that was not seen at all (the
    error of extrapolating from the horizon strip), less by the fraction of it that was seen."""
    height = panorama.radiance.shape[0]
    weight = np.clip(pixel_directions(height)[..., 2], 0.0, None) * solid_angles_sr(height)
    seen = panorama.is_sky & panorama.is_seen & ~panorama.is_clipped
    return float(0.3 * (1.0 - weight[seen].sum() / weight.sum()))


def _ground_radiance(
    panorama: Panorama, sky: Float32[np.ndarray, "h w 3"], albedo: float
) -> Float[np.ndarray, "3"]:
    """Mean of what was seen below the horizon; else a Lambert ground under the sky."""
    below = panorama.is_seen & ~panorama.is_sky
    below[: below.shape[0] // 2] = False
    if below.mean() > 0.02:
        return panorama.radiance[below].astype(np.float64).mean(axis=0)
    return albedo * irradiance(sky, np.array([0.0, 0.0, 1.0])) / np.pi


def _sky_notes(panorama: Panorama, analytic: AnalyticFit, sun: SunDirection) -> tuple[str, ...]:
    fitted = (
        f"sky: turbidity {analytic.turbidity:g}, {100 * analytic.overcast_fraction:.0f} % of its"
        f" light overcast, median residual {100 * analytic.residual:.0f} % over"
        f" {analytic.observed_count} cells"
    )
    if not analytic.observed_count:
        fitted = "no unsaturated sky was seen: a clear sky of turbidity 3 is assumed"
    blob = find_sun_blob(panorama, sun.direction_world)
    if blob is None:
        return (fitted, "the sun's disc was not seen")
    off_deg = angle_between_deg(blob.direction_world, sun.direction_world)
    cut = ", cut by what hides it" if blob.is_cut else ""
    return (
        fitted,
        f"a clipped spot (radius {blob.radius_deg:.1f} degrees{cut}) lies {off_deg:.2f} degrees"
        " from the sun",
    )
