"""Sun and unseen sky as lit and shadowed neighbours on the surfaces ask for.

Pairs of a lit and a shadowed patch tell the ratio of the sun to all other light, and hardly
anything else, so that what the estimate leaves open must say which of the two was wrong: the sun,
whose strength was read from other pairs, or the part of the sky that no camera saw. What cameras
did see, sky and the light of surrounding surfaces, is data and stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.labels import Observed, infer_labels, visibility_prior
from lightsim.appearance.intrinsic.light import LightBalance, SurfaceLight
from lightsim.core.twin import LightFreedom

_GRID = np.linspace(np.log(0.01), np.log(10.0), 47)
"""Candidates of the log of the factor on sun over sky."""
_STEPS, _ROUNDS = 25, 4
_REFLECTANCE_STD, _HUE_STD = 0.3, 0.12
"""Spread of log base colour between the patches of a pair, and of its colour part."""
_MOST_WRONG = 0.6
"""Fraction of the pairs at which a rendered shadow may be wrong altogether."""
_REMAINDER = 0.02
"""Likelihood of a pair across materials, relative to the peak of the model."""
_MODEL_LOG_STD = 0.15
"""Of the ratio that pairs give, however many there are: gloss, and patches that straddle edges.
With the true sky and 20,000 pairs the demo street asks for 0.85 times the true sun."""
_CLOUD_LOG_FACTOR, _CLOUD_LOG_STD = float(np.log(0.15)), 1.5
"""What cloud before the sun leaves of it."""
_FIRM = 0.8
"""Difference of the probabilities of being lit that makes a pair."""
_TURNS = 3
"""Between labels and light."""
_MIN_PAIRS = 60
"""Fewer lit/shadowed pairs say nothing."""
_MAX_PAIRS = 15_000
_BLOCK_M = 4.0
"""Pairs within a block of this size count as one observation."""


def balance_light(
    observed: Observed, freedom: LightFreedom, config: IntrinsicConfig
) -> LightBalance:
    """Alternate between the labels of patches and the light that they ask for."""
    prior = visibility_prior(observed, config)
    block = light_blocks(observed.surfels.position, _BLOCK_M)
    found, lit = LightBalance.unchanged(), prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    for turn in range(_TURNS + 1):
        if turn:
            lit = infer_labels(observed, found, prior, config, messages)
        pairs = shadow_pairs(observed, lit)
        if len(pairs) >= _MIN_PAIRS:
            found = fit_balance(pairs, observed.log_radiance, observed.light, block, freedom)
    return found


@dataclass(frozen=True, eq=False)
class ShadowPairs:
    """A lit and a shadowed patch of one surface each.

    Args:
        lit, shadowed: indices of surfels.
        reflectance_step: log of the ratio of base colours, lit over shadowed, that LiDAR predicts.
        weight: of the pair.
    """

    lit: Int64[np.ndarray, " p"]
    shadowed: Int64[np.ndarray, " p"]
    reflectance_step: Float64[np.ndarray, " p"]
    weight: Float64[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.lit)


def fit_balance(
    pairs: ShadowPairs,
    log_radiance: Float64[np.ndarray, "n 3"],
    light: SurfaceLight,
    block: Int64[np.ndarray, " n"],
    freedom: LightFreedom,
) -> LightBalance:
    """The light at which lit and shadowed patches have one base colour, channel by channel.

    A pair says log(L_lit / L_shadowed) - step = log((s S + D_lit) / D_shadowed). Rendered shadows
    may lie where there is none, so pairs follow a mixture: of this model, of no step at all (at
    most `_MOST_WRONG` of them), and of a wide remainder (changes of material). The best common
    factor is searched on a grid; the channels follow as medians over the pairs that the model
    explains. Pairs of one block of space share their errors and count as one observation for
    the uncertainty.
    """
    wanted = (
        log_radiance[pairs.lit] - log_radiance[pairs.shadowed] - pairs.reflectance_step[:, None]
    )
    lit, shadowed = light.at(pairs.lit), light.at(pairs.shadowed)
    fits = []
    for path in _paths(freedom):
        model = _StepModel(lit, shadowed, path)
        factor, log_std = _fit_ratio(pairs, wanted, model, block)
        fits.append((path.log_density(float(np.log(factor[1]))), path, np.log(factor), log_std))
    _, path, log_ratio, log_std = max(fits, key=lambda fit: fit[0])
    error = float(np.hypot(log_std, _MODEL_LOG_STD))
    kept = log_ratio * path.log_std**2 / (path.log_std**2 + error**2)
    kept += path.mean * error**2 / (path.log_std**2 + error**2)
    sun, unseen = path.factors(np.exp(kept))
    log_std = path.log_std * error / float(np.hypot(path.log_std, error))
    return LightBalance(sun, unseen, log_std, len(pairs))


@dataclass(frozen=True)
class _Path:
    """How sun and unseen sky share a factor on their ratio.

    Args:
        sun, unseen_sky: powers of the factor that they take.
        mean, log_std: of the log of the factor, before any pair was seen.
        probability: of this explanation.
    """

    sun: float
    unseen_sky: float
    mean: float
    log_std: float
    probability: float

    def factors(
        self, ratio: Float64[np.ndarray, "3"]
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """RGB factors on sun and unseen sky that change their ratio by `ratio`."""
        return ratio**self.sun, ratio**self.unseen_sky

    def log_density(self, log_ratio: float) -> float:
        """Of a ratio that the pairs ask for, with their own error."""
        std = float(np.hypot(self.log_std, _MODEL_LOG_STD))
        z = (log_ratio - self.mean) / std
        return float(np.log(max(self.probability, 1e-9) / std) - 0.5 * z * z)


def _paths(freedom: LightFreedom) -> tuple[_Path, _Path]:
    """A clear sun, both estimates a little off; and cloud before the sun.

    The estimate reads the sun against the sky: log sun = c log k + e, where k is the factor on the
    unseen sky and c the freedom's `sun_follows`. Of all pairs (k, e) with a given ratio
    e - (1 - c) log k, the likeliest shares it by the variances.
    """
    left = 1.0 - freedom.sun_follows
    sky, sun = (left * freedom.unseen_log_std) ** 2, max(freedom.sun_log_std, 1e-3) ** 2
    power = -(sky / left if left else 0.0) / (sun + sky)
    clear = _Path(
        1.0 + power, power, 0.0, float(np.sqrt(sun + sky)), 1.0 - freedom.cloud_probability
    )
    cloud = _Path(1.0, 0.0, _CLOUD_LOG_FACTOR, _CLOUD_LOG_STD, freedom.cloud_probability)
    return clear, cloud


def _fit_ratio(
    pairs: ShadowPairs,
    wanted: Float64[np.ndarray, "p 3"],
    model: _StepModel,
    block: Int64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "3"], float]:
    """RGB factor on sun over sky along the model's path, and the log standard deviation."""
    scores = [
        _score(wanted - model.log_step(np.full(3, np.exp(log_factor))), wanted, pairs.weight)
        for log_factor in _GRID
    ]
    factor = np.full(3, np.exp(_GRID[int(np.argmax(scores))]))
    residual, weight = wanted, pairs.weight
    for _ in range(_ROUNDS):
        residual = wanted - model.log_step(factor)
        weight = pairs.weight * _explained(residual, wanted) + 1e-9
        factor = _balance(wanted, weight, model)
    spread = float(np.sqrt((weight * residual[:, 1] ** 2).sum() / weight.sum()))
    places = np.bincount(np.unique(block[pairs.lit], return_inverse=True)[1], weight)
    count = places.sum() ** 2 / np.maximum((places**2).sum(), 1e-12)
    return factor, spread / model.slope(factor) / float(np.sqrt(max(count, 1.0)))


@dataclass(frozen=True, eq=False)
class _StepModel:
    """Light of the lit and of the shadowed patch of each pair."""

    lit: SurfaceLight
    shadowed: SurfaceLight
    path: _Path

    def log_step(self, ratio: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "p 3"]:
        """Log of the light of the lit patch over that of the shadowed one."""
        sun, unseen = self.path.factors(ratio)
        lit = self.lit.diffuse + (unseen - 1.0) * self.lit.unseen_sky + sun * self.lit.sun
        shadowed = self.shadowed.diffuse + (unseen - 1.0) * self.shadowed.unseen_sky
        return np.log(np.maximum(lit, 1e-9) / np.maximum(shadowed, 1e-9))

    def slope(self, ratio: Float64[np.ndarray, "3"]) -> float:
        """Change of the median log step with the log of the factor, green channel."""
        low, high = (np.median(self.log_step(ratio * factor)[:, 1]) for factor in (0.95, 1.05))
        return max(float(high - low) / 0.1, 0.05)


def shadow_pairs(observed: Observed, lit: Float64[np.ndarray, " n"]) -> ShadowPairs:
    """Pairs of the graph of which one is firmly lit and the other firmly in shadow."""
    first, second = observed.graph.pairs.T
    can_differ = observed.light.is_lit_enough
    difference = np.where(can_differ[first] & can_differ[second], lit[first] - lit[second], 0.0)
    chosen = np.flatnonzero(np.abs(difference) > _FIRM)
    chosen = chosen[:: max(1, len(chosen) // _MAX_PAIRS)]
    is_first = difference[chosen] > 0
    a, b = first[chosen].astype(np.int64), second[chosen].astype(np.int64)
    step = observed.reflectance_step[chosen].astype(np.float64)
    return ShadowPairs(
        np.where(is_first, a, b),
        np.where(is_first, b, a),
        np.where(is_first, -step, step),
        observed.graph.weight[chosen].astype(np.float64),
    )


def _likelihood(residual: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
    """Of a step that the model should explain, with the spread of base colour in a material."""
    mean = residual.mean(axis=1)
    hue = ((residual - mean[:, None]) ** 2).sum(axis=1)
    return np.exp(-0.5 * (mean / _REFLECTANCE_STD) ** 2 - 0.5 * hue / _HUE_STD**2)


def _score(
    residual: Float64[np.ndarray, "p 3"],
    wanted: Float64[np.ndarray, "p 3"],
    weight: Float64[np.ndarray, " p"],
) -> float:
    """Log likelihood at the best fraction of wrong pairs."""
    model, wrong = _likelihood(residual), _likelihood(wanted)
    fractions = np.linspace(0.05, _MOST_WRONG, 5)
    return max(
        float((weight * np.log((1 - fraction) * model + fraction * wrong + _REMAINDER)).sum())
        for fraction in fractions
    )


def _explained(
    residual: Float64[np.ndarray, "p 3"], wanted: Float64[np.ndarray, "p 3"]
) -> Float64[np.ndarray, " p"]:
    """Probability that the model, not another cause, made each step."""
    model, wrong = _likelihood(residual), _likelihood(wanted)
    return model / (model + wrong + _REMAINDER)


def _balance(
    wanted: Float64[np.ndarray, "p 3"], weight: Float64[np.ndarray, " p"], model: _StepModel
) -> Float64[np.ndarray, "3"]:
    """The factor of each channel at which the weighted median of the residual is 0."""
    low, high = np.full(3, _GRID[0]), np.full(3, _GRID[-1])
    for _ in range(_STEPS):
        middle = (low + high) / 2
        is_too_dark = weighted_median(wanted - model.log_step(np.exp(middle)), weight) > 0
        low, high = np.where(is_too_dark, middle, low), np.where(is_too_dark, high, middle)
    return np.exp((low + high) / 2)


def weighted_median(
    values: Float64[np.ndarray, "p 3"], weight: Float64[np.ndarray, " p"]
) -> Float64[np.ndarray, "3"]:
    """Of each column."""
    order = np.argsort(values, axis=0)
    fraction = np.cumsum(weight[order], axis=0) / weight.sum()
    row = np.minimum((fraction < 0.5).sum(axis=0), len(values) - 1)
    return np.take_along_axis(np.take_along_axis(values, order, 0), row[None], 0)[0]


def light_blocks(position: Float64[np.ndarray, "n 3"], block_m: float) -> Int64[np.ndarray, " n"]:
    """A number for the block of space that each point lies in."""
    cell = np.floor(position / block_m).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    size = cell.max(axis=0, initial=0) + 1
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(size)))
