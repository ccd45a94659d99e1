"""Which patches of a surface the sun reached: labels on surfels, and the sun's strength with them.

A shadow's edge is where the log of the radiance steps, in all channels, by what the light model
predicts, and where LiDAR intensity does not step; a change of material is where it does. Both
are pairwise statements between patches of one surface, so the labels form a Markov random field.
Rendered visibility is its prior: firm inside, open near the rendered shadow's edges, and firmer
about shadows than about light, because what no sensor saw can only add shadows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lightsim.appearance.intrinsic.config import DelightConfig
from lightsim.appearance.intrinsic.light import (
    LightScales,
    ShadowPairs,
    SurfaceLight,
    fit_sun_scale,
    is_lit_enough,
    light_blocks,
)
from lightsim.appearance.intrinsic.surfels import Graph, Surfels

_FIRM = 0.8
_ENCLOSED = 0.4
"""Share of bounced light that meets a surface again, in a street."""
_MOST_REFLECTED = 0.3
"""Greatest mean base colour of a street's surfaces."""
_SWEEPS, _DAMPING = 16, 0.2
_MAX_PAIRS = 15_000
_CHUNK_PAIRS = 1 << 16
"""Pairs whose energies are found together: some 10 MB of intermediate results, whatever the log."""
_BLOCK_M = 4.0
"""Pairs within a block of this size count as one observation."""


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test). The bench
# benchmarks/bench_delight.py varies those that are still settings.

# Probability that an inferred (unmeasured) surface is there, as far as shadows go.
_TRUST_INFERRED = 0.75
# Probability that a patch is lit although every rendering shadows it.
_LEAST_LIT = 0.02
# What these say of one patch counts this much: neighbours share their errors.
_PRIOR_WEIGHT = 0.25
# Spread of log base colour within a material.
_TONE_STD = 0.2
# Spread of its colour part.
_HUE_STD = 0.08
# Weight of what pictures say against the rendered prior.
_STRENGTH = 1.5
# Turns between labels and the sun's strength.
_ROUNDS = 3
# Fewer lit/shadowed pairs say nothing about the sun's strength.
_MIN_PAIRS = 60
# Greatest energy of a pair, nats: what a change of material costs.
_MAX_PAIR_ENERGY = 3.0
# Energy of a shadow's edge itself, nats.
_EDGE_ENERGY = 0.3


@dataclass(frozen=True, eq=False)
class Observed:
    """Surfels with all that is known of them.

    Args:
        log_radiance: natural logarithm.
        tone_step: for each pair of the graph, log of base colour of the second over the first,
            as LiDAR intensity predicts it; 0 where that says nothing.
        light: of the source sky at each surfel.
    """

    surfels: Surfels
    graph: Graph
    log_radiance: Float64[np.ndarray, "n 3"]
    tone_step: Float32[np.ndarray, " e"]
    light: SurfaceLight
    surfel_m: float


@dataclass(frozen=True, eq=False)
class Labels:
    """The outcome on surfels.

    Args:
        lit: probability that the sun reaches each.
        prior: the same before the pictures were asked.
        scales: of the light.
    """

    lit: Float64[np.ndarray, " n"]
    prior: Float64[np.ndarray, " n"]
    scales: LightScales


def label_shadows(
    observed: Observed, config: DelightConfig, scales: LightScales | None = None
) -> Labels:
    """Alternate between the sun's strength and the labels.

    Args:
        scales: known from a larger surface; None to find them.
    """
    prior = visibility_prior(observed, config)
    block = light_blocks(observed.surfels.position, _BLOCK_M)
    found = scales or _fit(observed, prior, block, LightScales.assumed(np.inf))
    lit = prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    for _ in range(_ROUNDS):
        lit = infer_labels(observed, prior, found, config, messages)
        if scales is None:
            found = _fit(observed, lit, block, found)
    return Labels(lit, prior, found)


def _fit(
    observed: Observed,
    lit: Float64[np.ndarray, " n"],
    block: Int64[np.ndarray, " n"],
    before: LightScales,
) -> LightScales:
    """Sun and bounce for given labels; the sun stays where too few pairs speak."""
    bounce = bounce_factor(observed, lit, before)
    pairs = shadow_pairs(observed, lit)
    if len(pairs) < _MIN_PAIRS:
        return replace(before, bounce=bounce)
    return fit_sun_scale(pairs, observed.log_radiance, observed.light, block, bounce)


def bounce_factor(
    observed: Observed, lit: Float64[np.ndarray, " n"], scales: LightScales
) -> Float64[np.ndarray, "3"]:
    """Bounced light of surroundings of the scene's own mean colour over that of the grey ones it
    was rendered with, further bounces included as a geometric series.

    The mean is geometric, because the brightest estimates are the least certain ones, and not
    above what streets reflect: too dark a sky would feed on itself otherwise.
    """
    surfels, light = observed.surfels, observed.light
    colour = np.exp(observed.log_radiance) / np.maximum(light.total(scales, lit), 1e-6)
    weight = surfels.area_m2 * surfels.confidence + 1e-12
    logs = np.log(np.clip(colour, 0.02, 0.9))
    mean = np.exp((logs * weight[:, None]).sum(axis=0) / weight.sum())
    mean *= min(1.0, _MOST_REFLECTED / float(mean.mean()))
    return mean / (1 - _ENCLOSED * mean) / light.bounce_albedo


def shadow_pairs(observed: Observed, lit: Float64[np.ndarray, " n"]) -> ShadowPairs:
    """Pairs of the graph of which one is firmly lit and the other firmly in shadow."""
    first, second = observed.graph.pairs.T
    can_differ = is_lit_enough(observed.light, LightScales.assumed(0.0))
    difference = np.where(can_differ[first] & can_differ[second], lit[first] - lit[second], 0.0)
    chosen = np.flatnonzero(np.abs(difference) > _FIRM)
    chosen = chosen[:: max(1, len(chosen) // _MAX_PAIRS)]
    is_first = difference[chosen] > 0
    a, b = first[chosen].astype(np.int64), second[chosen].astype(np.int64)
    step = observed.tone_step[chosen].astype(np.float64)
    return ShadowPairs(
        np.where(is_first, a, b),
        np.where(is_first, b, a),
        np.where(is_first, -step, step),
        observed.graph.weight[chosen].astype(np.float64),
    )


def visibility_prior(observed: Observed, config: DelightConfig) -> Float64[np.ndarray, " n"]:
    """Probability that a patch is lit, from the renderings alone."""
    believed = rendered_visibility(observed.light)
    smooth = _smoothed(believed, observed.graph, config.edge_error_m)
    return _LEAST_LIT + (1 - config.unseen_shadow - _LEAST_LIT) * smooth


def rendered_visibility(light: SurfaceLight) -> Float64[np.ndarray, " n"]:
    """Of the sun, with inferred surfaces as far as they are believed."""
    measured, inferred = light.visibility.astype(np.float64).T
    return _TRUST_INFERRED * inferred + (1 - _TRUST_INFERRED) * measured


def _smoothed(
    values: Float64[np.ndarray, " n"], graph: Graph, radius_m: float
) -> Float64[np.ndarray, " n"]:
    """Mean over the neighbourhood, by a Gaussian of the distance."""
    weight = np.exp(-0.5 * (graph.distance_m / radius_m) ** 2)
    first, second = graph.pairs.T
    total, mass = values.copy(), np.ones(len(values))
    for i, j in ((first, second), (second, first)):
        total += np.bincount(i, weight * values[j], minlength=len(values))
        mass += np.bincount(i, weight, minlength=len(values))
    return total / mass


def infer_labels(
    observed: Observed,
    prior: Float64[np.ndarray, " n"],
    scales: LightScales,
    config: DelightConfig,
    messages: Float32[np.ndarray, "e 2"],
) -> Float64[np.ndarray, " n"]:
    """Probability of being lit by loopy belief propagation.

    Args:
        messages: 0, or those of the last call; updated in place.
    """
    from lightsim.appearance.intrinsic.kernels import propagate

    energy = pair_energies(observed, scales, config)
    unary = _PRIOR_WEIGHT * np.log(prior / (1 - prior))
    belief = np.empty(len(unary))
    propagate(unary, observed.graph.pairs, energy, messages, belief, _SWEEPS, _DAMPING)
    belief += (1 - _PRIOR_WEIGHT) * np.log(prior / (1 - prior))
    lit = 1 / (1 + np.exp(-np.clip(belief, -30, 30)))
    return without_islands(observed, lit, prior, config.island_m2)


def without_islands(
    observed: Observed,
    lit: Float64[np.ndarray, " n"],
    prior: Float64[np.ndarray, " n"],
    least_m2: float,
) -> Float64[np.ndarray, " n"]:
    """Small patches whose label every rendering contradicts take the prior."""
    surfels, graph = observed.surfels, observed.graph
    first, second = graph.pairs.T
    is_lit = lit > 0.5
    near = (graph.distance_m < 2.0 * observed.surfel_m) & (is_lit[first] == is_lit[second])
    ends = first[near], second[near]
    links = coo_matrix((np.ones(len(ends[0]), np.bool_), ends), (len(lit), len(lit)))
    count, piece = connected_components(links, directed=False)
    area = np.bincount(piece, surfels.area_m2, minlength=count)
    mean = np.bincount(piece, prior * surfels.area_m2, minlength=count) / np.maximum(area, 1e-9)
    contradicts = (mean[piece] > 0.5) != is_lit
    return np.where((area[piece] < least_m2) & contradicts, prior, lit)


def pair_energies(
    observed: Observed, scales: LightScales, config: DelightConfig
) -> Float32[np.ndarray, "e 2 2"]:
    """Energy of each pair by the labels of its two patches, in nats.

    The step of the log base colour that labels imply, minus the step that LiDAR predicts, is
    small within a material; beyond a cap, the pair is taken to cross materials.
    """
    light, graph = observed.light, observed.graph
    diffuse = np.maximum(light.diffuse(scales), 1e-6)
    log_light = np.log(np.stack([diffuse, diffuse + light.direct(scales)], axis=1))
    log_colour = (observed.log_radiance[:, None] - log_light).astype(np.float32)
    energy = np.empty((len(graph.pairs), 2, 2), np.float32)
    for start in range(0, len(energy), _CHUNK_PAIRS):
        part = slice(start, start + _CHUNK_PAIRS)
        first, second = graph.pairs[part].T
        reach = 1 + graph.distance_m[part] / np.float32(config.reach_m)
        for a in (0, 1):
            for b in (0, 1):
                step = log_colour[second, b] - log_colour[first, a]
                cost = _misfit(step - observed.tone_step[part, None]) / reach
                cost = _STRENGTH * -np.log(np.exp(-cost) + exp(-_MAX_PAIR_ENERGY))
                energy[part, a, b] = graph.weight[part] * (cost + _EDGE_ENERGY * (a != b))
    return energy


def _misfit(step: Float32[np.ndarray, "e 3"]) -> Float32[np.ndarray, " e"]:
    """Squared step of brightness and of colour, in units of their spread."""
    mean = step.mean(axis=1)
    chroma = step - mean[:, None]
    return 0.5 * (mean / _TONE_STD) ** 2 + 0.5 * (chroma**2).sum(axis=1) / _HUE_STD**2


def predict_tone_steps(
    graph: Graph,
    log_radiance: Float64[np.ndarray, "n 3"],
    tone: Float64[np.ndarray, " n"],
    visibility: Float32[np.ndarray, "n 2"],
) -> tuple[Float32[np.ndarray, " e"], float]:
    """Step of log base colour across each pair that LiDAR intensity predicts, and the gain.

    The gain is the regression of radiance steps on intensity steps over pairs that every
    rendering puts on the same side of the sun; noise of the intensity shrinks it, as it should.
    """
    first, second = graph.pairs.T
    step = (tone[second] - tone[first]).astype(np.float32)
    known = np.isfinite(step)
    step = np.where(known, np.clip(step, -2.0, 2.0), 0.0).astype(np.float32)
    same = (np.abs(visibility[first] - visibility[second]) < 0.1).all(axis=1) & known
    if same.sum() < 100:
        return np.zeros_like(step), 0.0
    level = log_radiance.mean(axis=1)
    seen = np.clip((level[second] - level[first])[same], -1.0, 1.0)
    known_step = step[same].astype(np.float64)
    gain = float((seen * known_step).sum() / np.maximum((known_step**2).sum(), 1e-9))
    gain = float(np.clip(gain, 0.0, 1.0))
    return np.float32(gain) * step, gain
