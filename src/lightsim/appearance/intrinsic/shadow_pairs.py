"""Lit and shadowed neighbours: what they say about the sun against all other light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.appearance.intrinsic.labels import Observed, is_at_label_edge
from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.core.statistics import weighted_median

# Candidates of the log of the factor on the sun.
LOG_SUN = np.linspace(np.log(0.01), np.log(10.0), 47)
_STEPS, _ROUNDS = 25, 4
# Spread of log base colour between the patches of a pair, and of its colour part.
_REFLECTANCE_STD, _HUE_STD = 0.3, 0.12
# Fraction of the pairs at which a rendered shadow may be wrong altogether.
_MOST_WRONG = 0.6
# Likelihood of a pair across materials, relative to the peak of the model.
_REMAINDER = 0.02
# Difference of the probabilities of being lit that makes a pair.
_FIRM = 0.8
_MAX_PAIRS = 6_000


@dataclass(frozen=True, eq=False)
class ShadowPairs:
    """A lit and a shadowed patch of one surface each.

    Args:
        step: log of the radiance of the lit over that of the shadowed one, less the log of the
            ratio of base colours that LiDAR predicts.
        weight: of the pair.
        lit, shadowed: the light on them.
        block: number of the block of space that the lit one lies in. Pairs of a block share their
            errors and count as one observation.
    """

    step: Float64[np.ndarray, "p 3"]
    weight: Float64[np.ndarray, " p"]
    lit: SurfaceLight
    shadowed: SurfaceLight
    block: Int64[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.step)

    def predicted(
        self, sun: Float64[np.ndarray, "3"], unseen_sky: float
    ) -> Float64[np.ndarray, "p 3"]:
        """Log of the light of the lit patch over that of the shadowed one, at factors on the sun
        and on the unseen sky."""
        lit, shadowed = (
            light.diffuse + (unseen_sky - 1.0) * light.unseen_sky
            for light in (self.lit, self.shadowed)
        )
        return np.log(np.maximum(lit + sun * self.lit.sun, 1e-9) / np.maximum(shadowed, 1e-9))


def shadow_pairs(
    observed: Observed, lit: Float64[np.ndarray, " n"], block: Int64[np.ndarray, " n"]
) -> ShadowPairs:
    """Pairs of the graph of which one is firmly lit and the other firmly in shadow.

    Patches at the edge between the two hold a bit of both, as pictures and meshes are blurred, and
    would make the sun too weak; they are left out.

    Args:
        lit: probability that the sun reaches each surfel.
        block: of space, for each surfel.
    """
    first, second = observed.graph.pairs.T
    can_differ = observed.light.is_lit_enough
    is_inside = can_differ & ~is_at_label_edge(observed, lit)
    difference = np.where(is_inside[first] & is_inside[second], lit[first] - lit[second], 0.0)
    chosen = np.flatnonzero(np.abs(difference) > _FIRM)
    chosen = chosen[:: max(1, len(chosen) // _MAX_PAIRS)]
    is_first = difference[chosen] > 0
    a, b = first[chosen].astype(np.int64), second[chosen].astype(np.int64)
    bright, dark = np.where(is_first, a, b), np.where(is_first, b, a)
    by_lidar = observed.reflectance_step[chosen].astype(np.float64)
    step = observed.log_radiance[bright] - observed.log_radiance[dark]
    return ShadowPairs(
        step - np.where(is_first, -by_lidar, by_lidar)[:, None],
        observed.graph.weight[chosen].astype(np.float64),
        observed.light.at(bright),
        observed.light.at(dark),
        block[bright],
    )


def fit_sun_to_pairs(
    pairs: ShadowPairs, unseen_sky: float
) -> tuple[Float64[np.ndarray, "3"], float]:
    """RGB factor on the sun at which lit and shadowed patches have one base colour, and the
    standard deviation of its log.

    A pair says log(L_lit / L_shadowed) - step = log((s S + D_lit) / D_shadowed). Rendered shadows
    may lie where there is none, so pairs follow a mixture: of this model, of no step at all (at
    most `_MOST_WRONG` of them), and of a wide remainder (changes of material). The best common
    factor is searched on a grid; the channels follow as medians over the pairs that the model
    explains.
    """
    scores = [
        _score(pairs.step - pairs.predicted(np.full(3, np.exp(log_sun)), unseen_sky), pairs)
        for log_sun in LOG_SUN
    ]
    factor = np.full(3, np.exp(LOG_SUN[int(np.argmax(scores))]))
    residual, weight = pairs.step, pairs.weight
    for _ in range(_ROUNDS):
        residual = pairs.step - pairs.predicted(factor, unseen_sky)
        weight = pairs.weight * _explained(residual, pairs.step) + 1e-9
        factor = _balanced(pairs, weight, unseen_sky)
    spread = float(np.sqrt((weight * residual[:, 1] ** 2).sum() / weight.sum()))
    places = np.bincount(np.unique(pairs.block, return_inverse=True)[1], weight)
    count = places.sum() ** 2 / np.maximum((places**2).sum(), 1e-12)
    return factor, spread / _slope(pairs, factor, unseen_sky) / float(np.sqrt(max(count, 1.0)))


def _slope(pairs: ShadowPairs, sun: Float64[np.ndarray, "3"], unseen_sky: float) -> float:
    """Change of the median log step with the log of the sun, green channel."""
    low, high = (
        np.median(pairs.predicted(sun * factor, unseen_sky)[:, 1]) for factor in (0.95, 1.05)
    )
    return max(float(high - low) / 0.1, 0.05)


def _likelihood(residual: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
    """Of a step that the model should explain, with the spread of base colour in a material."""
    mean = residual.mean(axis=1)
    hue = ((residual - mean[:, None]) ** 2).sum(axis=1)
    return np.exp(-0.5 * (mean / _REFLECTANCE_STD) ** 2 - 0.5 * hue / _HUE_STD**2)


def _score(residual: Float64[np.ndarray, "p 3"], pairs: ShadowPairs) -> float:
    """Log likelihood at the best fraction of wrong pairs."""
    model, wrong = _likelihood(residual), _likelihood(pairs.step)
    fractions = np.linspace(0.05, _MOST_WRONG, 5)
    return max(
        float((pairs.weight * np.log((1 - f) * model + f * wrong + _REMAINDER)).sum())
        for f in fractions
    )


def _explained(
    residual: Float64[np.ndarray, "p 3"], step: Float64[np.ndarray, "p 3"]
) -> Float64[np.ndarray, " p"]:
    """Probability that the model, not another cause, made each step."""
    model, wrong = _likelihood(residual), _likelihood(step)
    return model / (model + wrong + _REMAINDER)


def _balanced(
    pairs: ShadowPairs, weight: Float64[np.ndarray, " p"], unseen_sky: float
) -> Float64[np.ndarray, "3"]:
    """The factor of each channel at which the weighted median of the residual is 0."""
    low, high = np.full(3, LOG_SUN[0]), np.full(3, LOG_SUN[-1])
    for _ in range(_STEPS):
        middle = (low + high) / 2
        residual = pairs.step - pairs.predicted(np.exp(middle), unseen_sky)
        is_too_dark = weighted_median(residual, weight) > 0
        low, high = np.where(is_too_dark, middle, low), np.where(is_too_dark, high, middle)
    return np.exp((low + high) / 2)


def space_blocks(position: Float64[np.ndarray, "n 3"], block_m: float) -> Int64[np.ndarray, " n"]:
    """A number for the block of space that each point lies in."""
    cell = np.floor(position / block_m).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    size = cell.max(axis=0, initial=0) + 1
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(size)))
