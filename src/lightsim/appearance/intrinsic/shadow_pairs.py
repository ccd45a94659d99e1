"""Ratio of the sun to all other light, estimated from pairs of lit and shadowed patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.appearance.intrinsic.labels import ObservedSurfels, is_at_label_edge
from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.appearance.intrinsic.reflectance import MaterialVariation
from lightsim.core.statistics import weighted_median

# The values below were chosen on synthetic streets; their sensitivity was not measured.

# Candidates of the log of the factor on the sun: 0.01 to 10 in steps of 0.15 (natural log).
LOG_SUN = np.linspace(np.log(0.01), np.log(10.0), 47)
# Variation of the base colour between the patches of a pair.
_VARIATION = MaterialVariation(log_std=0.3, hue_std=0.12)
# Maximum fraction of pairs that are not caused by a shadow.
_MAX_FALSE_FRACTION = 0.6
# Likelihood of a pair across materials, relative to the peak of the model.
_REMAINDER = 0.02
# Minimum difference between the lit probabilities of a pair.
_MIN_LIT_DIFFERENCE = 0.8
# Number of pairs from which they are thinned, to save time.
_MAX_PAIRS = 6_000


@dataclass(frozen=True, eq=False)
class ShadowPairs:
    """Pairs of one lit and one shadowed patch of a surface.

    Args:
        step: log ratio of the radiances (lit over shadowed).
        weight: of each pair.
        lit, shadowed: light on the two patches.
        block: index of the lit patch's block of space. Pairs of one block have correlated errors
            and count as one observation.
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
        """Return the log ratio of the light (lit over shadowed) under a light balance."""
        lit, shadowed = (
            light.diffuse + (unseen_sky - 1.0) * light.unseen_sky
            for light in (self.lit, self.shadowed)
        )
        return np.log(np.maximum(lit + sun * self.lit.sun, 1e-9) / np.maximum(shadowed, 1e-9))


def shadow_pairs(
    observed: ObservedSurfels, lit: Float64[np.ndarray, " n"], block: Int64[np.ndarray, " n"]
) -> ShadowPairs:
    """Return the pairs of the graph with one firmly lit and one firmly shadowed patch.

    Patches at a shadow edge are excluded: images and meshes are blurred there, which would bias the
    sun's strength low.

    Args:
        lit: probability that the sun reaches each surfel.
        block: index of the block of space of each surfel (`space_blocks`).
    """
    first, second = observed.graph.pairs.T
    can_differ = observed.light.is_lit_enough
    is_inside = can_differ & ~is_at_label_edge(observed, lit)
    difference = np.where(is_inside[first] & is_inside[second], lit[first] - lit[second], 0.0)
    chosen = np.flatnonzero(np.abs(difference) > _MIN_LIT_DIFFERENCE)
    chosen = chosen[:: max(1, len(chosen) // _MAX_PAIRS)]
    is_first = difference[chosen] > 0
    a, b = first[chosen].astype(np.int64), second[chosen].astype(np.int64)
    bright, dark = np.where(is_first, a, b), np.where(is_first, b, a)
    return ShadowPairs(
        observed.log_radiance[bright] - observed.log_radiance[dark],
        observed.graph.weight[chosen].astype(np.float64),
        observed.light.at(bright),
        observed.light.at(dark),
        block[bright],
    )


def fit_sun_to_pairs(
    pairs: ShadowPairs, unseen_sky: float
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Fit the RGB factor on the sun at which lit and shadowed patches have one base colour.

    A pair with factor s satisfies log(L_lit / L_shadowed) - step = log((s S + D_lit) / D_shadowed).
    Rendered shadows may be false, so the pairs are modelled by a mixture of this relation, of no
    step (at most `_MAX_FALSE_FRACTION`), and of a wide density (changes of material). A grid search
    yields the best grey factor. Each channel is then a median over the pairs that the relation
    explains.

    Returns:
        The factor, and the standard deviation of its log.
    """
    scores = [
        _score(pairs.step - pairs.predicted(np.full(3, np.exp(log_sun)), unseen_sky), pairs)
        for log_sun in LOG_SUN
    ]
    factor = np.full(3, np.exp(LOG_SUN[int(np.argmax(scores))]))
    residual, weight = pairs.step, pairs.weight
    # Four rounds of reweighting by the probability that the model explains each pair.
    for _ in range(4):
        residual = pairs.step - pairs.predicted(factor, unseen_sky)
        weight = pairs.weight * _explained(residual, pairs.step) + 1e-9
        factor = _balanced(pairs, weight, unseen_sky)
    residual_std = float(np.sqrt((weight * residual[:, 1] ** 2).sum() / weight.sum()))
    # Effective number of independent observations, one a block (Kish's formula).
    places = np.bincount(np.unique(pairs.block, return_inverse=True)[1], weight)
    count = places.sum() ** 2 / np.maximum((places**2).sum(), 1e-12)
    log_std = residual_std / _slope(pairs, factor, unseen_sky) / float(np.sqrt(max(count, 1.0)))
    return factor, log_std


def _slope(pairs: ShadowPairs, sun: Float64[np.ndarray, "3"], unseen_sky: float) -> float:
    """Derivative of the median predicted step by the log of the sun, green channel."""
    low, high = (
        np.median(pairs.predicted(sun * factor, unseen_sky)[:, 1]) for factor in (0.95, 1.05)
    )
    return max(float(high - low) / 0.1, 0.05)


def _score(residual: Float64[np.ndarray, "p 3"], pairs: ShadowPairs) -> float:
    """Log likelihood at the best fraction of false pairs."""
    model, wrong = (np.exp(-_VARIATION.misfit(step)) for step in (residual, pairs.step))
    fractions = np.linspace(0.05, _MAX_FALSE_FRACTION, 5)
    return max(
        float((pairs.weight * np.log((1 - f) * model + f * wrong + _REMAINDER)).sum())
        for f in fractions
    )


def _explained(
    residual: Float64[np.ndarray, "p 3"], step: Float64[np.ndarray, "p 3"]
) -> Float64[np.ndarray, " p"]:
    """Posterior probability that the model explains each step."""
    model, wrong = (np.exp(-_VARIATION.misfit(values)) for values in (residual, step))
    return model / (model + wrong + _REMAINDER)


def _balanced(
    pairs: ShadowPairs, weight: Float64[np.ndarray, " p"], unseen_sky: float
) -> Float64[np.ndarray, "3"]:
    """Factor of each channel at which the weighted median of the residual is 0, by bisection."""
    low, high = np.full(3, LOG_SUN[0]), np.full(3, LOG_SUN[-1])
    for _ in range(25):
        middle = (low + high) / 2
        residual = pairs.step - pairs.predicted(np.exp(middle), unseen_sky)
        is_too_dark = weighted_median(residual, weight) > 0
        low, high = np.where(is_too_dark, middle, low), np.where(is_too_dark, high, middle)
    return np.exp((low + high) / 2)


def space_blocks(position: Float64[np.ndarray, "n 3"], block_m: float) -> Int64[np.ndarray, " n"]:
    """Return the index of the cubic block of space of each point."""
    cell = np.floor(position / block_m).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    size = cell.max(axis=0, initial=0) + 1
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(size)))
