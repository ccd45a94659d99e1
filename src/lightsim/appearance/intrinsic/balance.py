"""Light balance: joint posterior of the factors on the sun and on the unseen sky.

The observed sky and the radiance of surrounding surfaces are fixed. The unknowns are one log factor
on the sun and one on the sky that no camera observes. Three sources of evidence are combined: the
prior of clear skies and of cloud before the sun; pairs of lit and shadowed neighbours, which
determine the ratio of the sun to all other light; and the base colours of pavement and walls, which
determine the level of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.labels import ObservedSurfels, infer_labels, visibility_prior
from lightsim.appearance.intrinsic.light import LightBalance
from lightsim.appearance.intrinsic.reflectance import ReflectanceClass, class_members
from lightsim.appearance.intrinsic.shadow_pairs import (
    LOG_SUN,
    ShadowPairs,
    fit_sun_to_pairs,
    shadow_pairs,
    space_blocks,
)
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.twin import LightPrior

# Candidates of the log of the factor on the unseen sky: 0.3 to 3.3.
_LOG_UNSEEN = np.linspace(-1.2, 1.2, 25)
# The standard deviations below are of natural logs. They were chosen on log 002 and synthetic
# streets; their sensitivity was not measured.

# Minimum standard deviation of the sun's factor from pairs, for any number of pairs; specular
# reflection is its main cause.
_PAIR_LOG_STD = 0.15
# Log of the expected transmission of cloud before the sun.
_CLOUD_LOG_FACTOR = float(np.log(0.15))
# Standard deviation of that transmission: cloud may transmit nearly any fraction.
_CLOUD_LOG_STD = 1.5
# Standard deviation of the hue of the estimated light as a whole.
_LIGHT_HUE_STD = 0.1
# Standard deviation of the log ratio of blue to red in the sun's factor from pairs. The log ratio
# was 0.3 to 0.4 on synthetic streets, and 1.4 on log 002, where thin cloud covers the sun and pairs
# are false (no script repeats this).
_PAIR_HUE_STD = 0.4
# Standard deviation of the factor and of its hue, if pairs are label errors.
_CHANCE_LOG_STD = 1.5
# Probability of shadows, hence of true pairs, under cloud before the sun.
_SHADOWS_UNDER_CLOUD = 0.5
# Number of updates of the labels.
_ITERATIONS = 3
# Least number of pairs.
_MIN_PAIRS = 60
# Size in metres of the blocks of space within which pairs have correlated errors.
_BLOCK_M = 4.0
_WEIGHTS = LUMINANCE_WEIGHTS.astype(np.float64)


def balance_light(
    observed: ObservedSurfels,
    light_prior: LightPrior,
    path_world: Float[np.ndarray, "p 3"],
    config: IntrinsicConfig,
) -> LightBalance:
    """Estimate factors on the sun and the unobserved sky, alternating with shadow labels.

    Args:
        observed: patches under the unbalanced light.
        light_prior: prior of the two factors.
        path_world: positions of the cameras along the drive.
        config: settings of the labels.
    """
    prior = visibility_prior(observed, config)
    own = observed
    block = space_blocks(observed.surfels.position, _BLOCK_M)
    classes = list(class_members(observed.surfels, path_world))
    found, lit = LightBalance.unchanged(), prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    for turn in range(_ITERATIONS + 1):
        if turn:
            observed = own.with_reflections(found, lit)
            lit = infer_labels(observed, found, prior, config, messages)
        pairs = shadow_pairs(observed, lit, block)
        members = [ClassRadiance.of(c.kind, c.rows, observed, lit) for c in classes]
        found = solve_balance(pairs, members, light_prior)
    return found


@dataclass(frozen=True, eq=False)
class ClassRadiance:
    """Radiance and light components of the surfels of one class of surface.

    Args:
        kind: prior of the class.
        radiance: observed linear RGB.
        known: light of the observed sky and of other surfaces.
        unseen_sky: light of the rest of the sky.
        sun: light of the sun, times the probability of being lit.
    """

    kind: ReflectanceClass
    radiance: Float64[np.ndarray, "k 3"]
    known: Float64[np.ndarray, "k 3"]
    unseen_sky: Float64[np.ndarray, "k 3"]
    sun: Float64[np.ndarray, "k 3"]

    @staticmethod
    def of(
        kind: ReflectanceClass,
        rows: Int64[np.ndarray, " k"],
        observed: ObservedSurfels,
        lit: Float64[np.ndarray, " n"],
    ) -> ClassRadiance:
        """Collect the surfels `rows`."""
        light = observed.light.at(rows)
        return ClassRadiance(
            kind,
            np.exp(observed.log_radiance[rows]),
            np.maximum(light.diffuse - light.unseen_sky, 0.0),
            light.unseen_sky.astype(np.float64),
            light.sun * lit[rows, None],
        )

    def log_base_colour(
        self, sun: Float64[np.ndarray, "3"], unseen_sky: Float64[np.ndarray, "3"]
    ) -> Float64[np.ndarray, "3"]:
        """Return the median log base colour of each channel under a light balance."""
        light = self.known + unseen_sky * self.unseen_sky + sun * self.sun
        return np.median(np.log(self.radiance / np.maximum(light, 1e-6)), axis=0)


def solve_balance(
    pairs: ShadowPairs, classes: Sequence[ClassRadiance], light_prior: LightPrior
) -> LightBalance:
    """Return the mean and standard deviation of the posterior of (log unseen sky, log sun).

    The posterior is evaluated on a grid, for two hypotheses: true and false pairs. Under thin cloud
    bright patches are falsely labelled lit and would confirm a sun of any strength and hue. The
    sun's hue is estimated from the pairs. The remaining colour cast on nearly grey classes is
    divided between their base colours and the light by their variances.
    """
    has_pairs = len(pairs) >= _MIN_PAIRS
    with_shadows, without = _log_prior(light_prior)
    if has_pairs:
        by_sun, by_chance = _log_pairs(pairs)
        with_shadows, without = with_shadows + by_sun, without + by_chance
    logs = np.stack([with_shadows, without]) + sum(_log_class(members) for members in classes)
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    p_pairs = float(weight[0].sum()) if has_pairs else 0.0
    unseen, unseen_std = _moments(_LOG_UNSEEN, weight.sum(axis=(0, 2)))
    sun, sun_std = _moments(LOG_SUN, weight.sum(axis=(0, 1)))
    hue = np.ones(3)
    if has_pairs:
        hue, _ = fit_sun_to_pairs(pairs, float(np.exp(unseen)))
        hue = (hue / np.exp(np.log(hue) @ _WEIGHTS)) ** p_pairs
    sun_rgb, unseen_rgb = np.exp(sun) * hue, np.full(3, np.exp(unseen))
    cast = _colour_cast(classes, sun_rgb, unseen_rgb)
    count = len(pairs) if p_pairs > 0.5 else 0
    return LightBalance(sun_rgb * cast, unseen_rgb * cast, sun_std, unseen_std, count)


def _log_prior(
    light_prior: LightPrior,
) -> tuple[Float64[np.ndarray, "u s"], Float64[np.ndarray, "u s"]]:
    """Log prior of (log unseen sky, log sun), with and without shadows in the scene.

    A clear sun casts shadows, and its factor is tied to the sky's. Cloud before the sun attenuates
    it by nearly any factor.
    """
    unseen = _LOG_UNSEEN[:, None]
    clear = _normal(LOG_SUN - light_prior.log_clear_sun - unseen, light_prior.sun_log_std)
    cloud = _normal(LOG_SUN - light_prior.log_clear_sun - _CLOUD_LOG_FACTOR, _CLOUD_LOG_STD)
    p = float(np.clip(light_prior.cloud_probability, 1e-9, 1 - 1e-9))
    level = np.log(_normal(unseen, light_prior.unseen_log_std))
    shadows = (1 - p) * clear + p * _SHADOWS_UNDER_CLOUD * cloud
    none = p * (1 - _SHADOWS_UNDER_CLOUD) * np.broadcast_to(cloud, clear.shape)
    return np.log(shadows) + level, np.log(none) + level


def _normal(
    value: Float64[np.ndarray, "*n"], std: float | Float64[np.ndarray, "*#n"]
) -> Float64[np.ndarray, "*n"]:
    """Return a normal density, at least as wide as the grid's spacing, and nowhere 0."""
    std = np.maximum(std, 0.05)
    return np.exp(-0.5 * (value / std) ** 2) / (std * np.sqrt(2 * np.pi)) + 1e-300


def _log_pairs(pairs: ShadowPairs) -> tuple[Float64[np.ndarray, "u s"], Float64[np.ndarray, "u 1"]]:
    """Return the log density of the pairs' fit given that shadows, or label errors, cause them."""
    # The fit changes smoothly with the unseen sky: five fits are interpolated.
    unseen = np.linspace(_LOG_UNSEEN[0], _LOG_UNSEEN[-1], 5)
    fits = [fit_sun_to_pairs(pairs, float(np.exp(value))) for value in unseen]
    log_factor = np.log([factor for factor, _ in fits])

    def at_candidates(values: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, "u 1"]:
        return np.interp(_LOG_UNSEEN, unseen, values)[:, None]

    sun = at_candidates(log_factor @ _WEIGHTS)
    hue = at_candidates(log_factor[:, 2] - log_factor[:, 0])
    error = at_candidates(np.array([error for _, error in fits]))
    std = np.hypot(error, _PAIR_LOG_STD)
    by_sun = np.log(_normal(LOG_SUN - sun, std) * _normal(hue, np.hypot(std, _PAIR_HUE_STD)))
    by_chance = np.log(_normal(sun, _CHANCE_LOG_STD) * _normal(hue, _CHANCE_LOG_STD))
    return by_sun, by_chance


def _log_class(members: ClassRadiance) -> Float64[np.ndarray, "u s"]:
    kind = members.kind
    off = np.empty((len(_LOG_UNSEEN), len(LOG_SUN)))
    radiance, known, unseen, sun = (
        part @ _WEIGHTS
        for part in (members.radiance, members.known, members.unseen_sky, members.sun)
    )
    for row, log_unseen in enumerate(_LOG_UNSEEN):
        light = (known + np.exp(log_unseen) * unseen)[:, None] + sun[:, None] * np.exp(LOG_SUN)
        off[row] = np.median(np.log(radiance[:, None] / np.maximum(light, 1e-6)), axis=0)
    return -0.5 * ((off - np.log(kind.median)) / kind.log_std) ** 2


def _moments(
    values: Float64[np.ndarray, " n"], weight: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    mean = float(values @ weight)
    return mean, float(np.sqrt((values - mean) ** 2 @ weight))


def _colour_cast(
    classes: Sequence[ClassRadiance],
    sun: Float64[np.ndarray, "3"],
    unseen_sky: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "3"]:
    """Return the factor of luminance 1 on the light that explains its part of the colour cast."""
    log_cast, precision = np.zeros(3), 1.0 / _LIGHT_HUE_STD**2
    for members in classes:
        kind = members.kind
        own = 0.0 if np.isinf(kind.hue_std) else 1.0 / kind.hue_std**2
        colour = members.log_base_colour(sun, unseen_sky)
        log_cast += own * (colour - colour.mean() - np.asarray(kind.log_hue))
        precision += own
    cast = np.exp(log_cast / precision)
    return cast / np.exp(np.log(cast) @ _WEIGHTS)
