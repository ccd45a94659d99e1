"""Sun and unseen sky in one posterior: what shadows, known materials and clear skies say.

What cameras saw, sky and the light of surrounding surfaces, is data and stays. Unknown are the
sun and the sky that no camera saw, a log factor each. Clear skies give a prior of both, cloud
before the sun another; lit and shadowed neighbours tell the sun against all other light, but only
where it casts shadows; base colours of pavement and walls, which come from dividing by that light,
tell the level of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.labels import Observed, infer_labels, visibility_prior
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
from lightsim.core.twin import LightFreedom

# Candidates of the log of the factor on the unseen sky.
_LOG_UNSEEN = np.linspace(-1.2, 1.2, 25)
# Of these at which pairs are asked; what they say changes smoothly between.
_PAIR_FITS = 5
# Of the sun that pairs give, however many there are: gloss, mostly. Not measured alone.
_PAIR_LOG_STD = 0.15
# What cloud before the sun leaves of it.
_CLOUD_LOG_FACTOR, _CLOUD_LOG_STD = float(np.log(0.15)), 1.5
# Of the estimated light as a whole. Not measured.
_LIGHT_HUE_STD = 0.1
# Between labels and light.
_TURNS = 3
# Probability that there are shadows all the same, so that pairs are what they are taken for.
_SHADOWS_UNDER_CLOUD = 0.5
# Of the log of blue over red of the sun that pairs ask for, over that of a clear one: 0.3 to 0.4
# on streets, 1.4 on log 002, whose sun is veiled.
_PAIR_HUE_STD = 0.4
# Of this and of the strength, where labels made the pairs and no sun.
_CHANCE_LOG_STD = 1.5
# Fewer lit/shadowed pairs say nothing.
_MIN_PAIRS = 60
_BLOCK_M = 4.0
_WEIGHTS = LUMINANCE_WEIGHTS.astype(np.float64)


def balance_light(
    observed: Observed,
    freedom: LightFreedom,
    path_world: Float[np.ndarray, "p 3"],
    config: IntrinsicConfig,
) -> LightBalance:
    """Alternate between the labels of patches and the light that they ask for.

    Args:
        path_world: positions of the cameras, for what lies under and beside their way.
    """
    prior = visibility_prior(observed, config)
    own = observed
    block = space_blocks(observed.surfels.position, _BLOCK_M)
    classes = list(class_members(observed.surfels, path_world))
    found, lit = LightBalance.unchanged(), prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    for turn in range(_TURNS + 1):
        if turn:
            observed = own.reflecting(found, lit)
            lit = infer_labels(observed, found, prior, config, messages)
        pairs = shadow_pairs(observed, lit, block)
        members = [ClassRadiance.of(c.kind, c.rows, observed, lit) for c in classes]
        found = solve_balance(pairs, members, freedom)
    return found


@dataclass(frozen=True, eq=False)
class ClassRadiance:
    """Surfels of one class of surface: what they show, and the parts of their light.

    Args:
        kind: the class.
        radiance: linear RGB.
        known: light from the sky that was seen and from other surfaces.
        unseen_sky: light from the rest of the sky.
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
        observed: Observed,
        lit: Float64[np.ndarray, " n"],
    ) -> ClassRadiance:
        """Of some surfels."""
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
        """Median over the class, per channel, at factors on the two."""
        light = self.known + unseen_sky * self.unseen_sky + sun * self.sun
        return np.median(np.log(self.radiance / np.maximum(light, 1e-6)), axis=0)


def solve_balance(
    pairs: ShadowPairs, classes: Sequence[ClassRadiance], freedom: LightFreedom
) -> LightBalance:
    """The mean of the posterior over (log unseen sky, log sun), on a grid, and its spread.

    The colour of the sun is that of the pairs; what then is left of a colour cast on classes that
    are nearly grey is shared between them and the light by their variances. A veiled sun's pairs
    may say nothing: labels follow the pictures, so that bright patches pass for lit and confirm
    whatever sun is asked for, of any colour.
    """
    has_pairs = len(pairs) >= _MIN_PAIRS
    told, untold = _log_prior(freedom)
    if has_pairs:
        by_sun, by_chance = _log_pairs(pairs)
        told, untold = told + by_sun, untold + by_chance
    logs = np.stack([told, untold]) + sum(_log_class(members) for members in classes)
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    is_told = float(weight[0].sum()) if has_pairs else 0.0
    unseen, unseen_std = _moments(_LOG_UNSEEN, weight.sum(axis=(0, 2)))
    sun, sun_std = _moments(LOG_SUN, weight.sum(axis=(0, 1)))
    hue = np.ones(3)
    if has_pairs:
        hue, _ = fit_sun_to_pairs(pairs, float(np.exp(unseen)))
        hue = (hue / np.exp(np.log(hue) @ _WEIGHTS)) ** is_told
    sun_rgb, unseen_rgb = np.exp(sun) * hue, np.full(3, np.exp(unseen))
    cast = _colour_cast(classes, sun_rgb, unseen_rgb)
    count = len(pairs) if is_told > 0.5 else 0
    return LightBalance(sun_rgb * cast, unseen_rgb * cast, sun_std, unseen_std, count)


def _log_prior(
    freedom: LightFreedom,
) -> tuple[Float64[np.ndarray, "u s"], Float64[np.ndarray, "u s"]]:
    """With shadows and without: a clear sun follows the sky, and casts some; cloud before it takes
    nearly any part of its light."""
    unseen = _LOG_UNSEEN[:, None]
    clear = _normal(LOG_SUN - freedom.log_clear_sun - unseen, freedom.sun_log_std)
    cloud = _normal(LOG_SUN - freedom.log_clear_sun - _CLOUD_LOG_FACTOR, _CLOUD_LOG_STD)
    p = float(np.clip(freedom.cloud_probability, 1e-9, 1 - 1e-9))
    level = np.log(_normal(unseen, freedom.unseen_log_std))
    shadows = (1 - p) * clear + p * _SHADOWS_UNDER_CLOUD * cloud
    none = p * (1 - _SHADOWS_UNDER_CLOUD) * np.broadcast_to(cloud, clear.shape)
    return np.log(shadows) + level, np.log(none) + level


def _normal(
    value: Float64[np.ndarray, "*n"], std: float | Float64[np.ndarray, "*#n"]
) -> Float64[np.ndarray, "*n"]:
    """Density, no narrower than the grid can show, and nowhere 0."""
    std = np.maximum(std, 0.05)
    return np.exp(-0.5 * (value / std) ** 2) / (std * np.sqrt(2 * np.pi)) + 1e-300


def _log_pairs(
    pairs: ShadowPairs,
) -> tuple[Float64[np.ndarray, "u s"], Float64[np.ndarray, "u 1"]]:
    """Log density of what the pairs ask for: if a sun of some strength made them, and if labels
    did."""
    unseen = np.linspace(_LOG_UNSEEN[0], _LOG_UNSEEN[-1], _PAIR_FITS)
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
    """Factor on the light, of luminance 1, that takes its part of the cast on grey classes."""
    log_cast, precision = np.zeros(3), 1.0 / _LIGHT_HUE_STD**2
    for members in classes:
        kind = members.kind
        own = 0.0 if np.isinf(kind.hue_std) else 1.0 / kind.hue_std**2
        colour = members.log_base_colour(sun, unseen_sky)
        log_cast += own * (colour - colour.mean() - np.asarray(kind.log_hue))
        precision += own
    cast = np.exp(log_cast / precision)
    return cast / np.exp(np.log(cast) @ _WEIGHTS)
