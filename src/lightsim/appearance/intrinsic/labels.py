"""Which patches of a surface the sun reached: labels on surfels.

A shadow's edge is where the log of the radiance steps, in all channels, by what the light model
predicts, and where LiDAR intensity does not step; a change of material is where it does. Both
are pairwise statements between patches of one surface, so the labels form a Markov random field.
Rendered visibility is its prior: firm inside, open near the rendered shadow's edges, and firmer
about shadows than about light, because what no sensor saw can only add shadows. Base colours that
pavement and walls cannot have speak against a label, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.light import LightBalance, SurfaceLight
from lightsim.appearance.intrinsic.reflectance import Members
from lightsim.appearance.intrinsic.surfels import Graph, Surfels
from lightsim.core.colour import LUMINANCE_WEIGHTS

_SWEEPS, _DAMPING = 16, 0.2
# Pairs whose energies are found together: some 10 MB of intermediate results, whatever the log.
_CHUNK_PAIRS = 1 << 16


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test). The bench
# benchmarks/bench_decompose.py varies those that are still settings.

# Probability that an inferred (unmeasured) surface is there, as far as shadows go.
_TRUST_INFERRED = 0.75
# Probability that a patch is lit although every rendering shadows it.
_LEAST_LIT = 0.02
# What these say of one patch counts this much: neighbours share their errors.
_PRIOR_WEIGHT = 0.25
# Spread of log base colour within a material.
_REFLECTANCE_STD = 0.2
# Spread of its colour part.
_HUE_STD = 0.08
# Weight of what pictures say against the rendered prior.
_STRENGTH = 1.5
# Rounds of belief propagation, each from the messages of the last.
_ROUNDS = 3
# Greatest energy of a pair, nats: what a change of material costs.
_MAX_PAIR_ENERGY = 3.0
# Patches so near to one of the other label, in their own size, straddle the edge.
_EDGE_SURFELS = 2.5
# Reach of the base colours that reflections are compared with, and their limits.
_COLOUR_REACH_M = 1.0
_COLOURS = (0.05, 0.9)
_LEAST_RADIANCE = 1e-3
# Energy of a shadow's edge itself, nats.
_EDGE_ENERGY = 0.3


@dataclass(frozen=True, eq=False)
class Observed:
    """Surfels with all that is known of them.

    Args:
        log_radiance: natural logarithm.
        reflectance_step: for each pair of the graph, log of base colour of the second over the
            first, as LiDAR intensity predicts it; 0 where that says nothing.
        materials: surfels whose class of material is known.
        own_light: of the source sky at each surfel.
        light: the same with reflections as light (`SurfaceLight.on_lambert`), so that log radiance
            is log base colour and log light.
    """

    surfels: Surfels
    graph: Graph
    log_radiance: Float64[np.ndarray, "n 3"]
    reflectance_step: Float32[np.ndarray, " e"]
    materials: Sequence[Members]
    own_light: SurfaceLight
    light: SurfaceLight
    surfel_m: float

    @staticmethod
    def of(
        surfels: Surfels,
        graph: Graph,
        materials: Sequence[Members],
        own_light: SurfaceLight,
        surfel_m: float,
    ) -> Observed:
        """Surfels under a light that is taken as it is; LiDAR says nothing yet."""
        log_radiance = np.log(np.maximum(surfels.radiance, _LEAST_RADIANCE))
        step = np.zeros(len(graph.pairs), np.float32)
        observed = Observed(
            surfels, graph, log_radiance, step, materials, own_light, own_light, surfel_m
        )
        return observed.reflecting(LightBalance.unchanged(), rendered_visibility(own_light))

    def reflecting(self, balance: LightBalance, visibility: Float64[np.ndarray, " n"]) -> Observed:
        """With reflections on the base colours that a balance and a visibility of the sun ask for,
        smoothed, since they hold a wrong visibility's shadows. The light stays unbalanced."""
        if self.own_light.reflected is None:
            return self
        balanced = self.own_light.balanced(balance)
        colour = np.clip(balanced.base_colour(self.surfels.radiance, visibility), *_COLOURS)
        smooth = [
            np.exp(smoothed(np.log(channel), self.graph, _COLOUR_REACH_M)) for channel in colour.T
        ]
        return replace(self, light=self.own_light.on_lambert(np.stack(smooth, axis=1)))


@dataclass(frozen=True, eq=False)
class Labels:
    """The outcome on surfels.

    Args:
        lit: probability that the sun reaches each.
        prior: the same before the pictures were asked.
    """

    lit: Float64[np.ndarray, " n"]
    prior: Float64[np.ndarray, " n"]


def label_shadows(
    observed: Observed, config: IntrinsicConfig, prior: Float64[np.ndarray, " n"] | None = None
) -> Labels:
    """Labels under the light as it is; `prior` instead of `visibility_prior`."""
    prior = visibility_prior(observed, config) if prior is None else prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    lit = prior
    for _ in range(_ROUNDS):
        lit = infer_labels(observed, LightBalance.unchanged(), prior, config, messages)
    return Labels(lit, prior)


def visibility_prior(observed: Observed, config: IntrinsicConfig) -> Float64[np.ndarray, " n"]:
    """Probability that a patch is lit, from the renderings alone."""
    return softened_prior(rendered_visibility(observed.light), observed.graph, config)


def softened_prior(
    believed: Float64[np.ndarray, " n"], graph: Graph, config: IntrinsicConfig
) -> Float64[np.ndarray, " n"]:
    """The same from any belief about the visibility of the sun: edges are where they are to within
    the geometry's error, and there may be casters that nobody saw."""
    smooth = smoothed(believed, graph, config.edge_error_m)
    return _LEAST_LIT + (1 - config.unseen_shadow - _LEAST_LIT) * smooth


def rendered_visibility(light: SurfaceLight) -> Float64[np.ndarray, " n"]:
    """Of the sun, with inferred surfaces as far as they are believed."""
    measured, inferred = light.visibility.astype(np.float64).T
    return _TRUST_INFERRED * inferred + (1 - _TRUST_INFERRED) * measured


def smoothed(
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
    balance: LightBalance,
    prior: Float64[np.ndarray, " n"],
    config: IntrinsicConfig,
    messages: Float32[np.ndarray, "e 2"],
) -> Float64[np.ndarray, " n"]:
    """Probability of being lit by loopy belief propagation.

    Args:
        messages: 0, or those of the last call; updated in place.
    """
    from lightsim.appearance.intrinsic.kernels import propagate

    energy = pair_energies(observed, balance, config)
    own = np.log(prior / (1 - prior)) + _material_log_odds(observed, balance, config)
    belief = np.empty(len(own))
    propagate(
        _PRIOR_WEIGHT * own, observed.graph.pairs, energy, messages, belief, _SWEEPS, _DAMPING
    )
    belief += (1 - _PRIOR_WEIGHT) * own
    lit = 1 / (1 + np.exp(-np.clip(belief, -30, 30)))
    return without_islands(observed, lit, prior, config.island_m2)


def _material_log_odds(
    observed: Observed, balance: LightBalance, config: IntrinsicConfig
) -> Float64[np.ndarray, " n"]:
    """Of lit against shadowed, from the base colours that each makes of known materials; 0 in deep
    shade, where the quotient says nothing."""
    weights = LUMINANCE_WEIGHTS.astype(np.float64)
    light = observed.light.balanced(balance)
    shade = np.maximum(light.diffuse @ weights, 1e-6)
    sun, radiance = light.sun @ weights, np.exp(observed.log_radiance) @ weights
    least = config.deep_shade[0] * np.percentile(shade, 95)
    odds = np.zeros(len(shade))
    for members in observed.materials:
        kind, rows = members.kind, members.rows[shade[members.rows] > least]
        if_lit = radiance[rows] / (shade[rows] + sun[rows])
        odds[rows] = kind.log_density(if_lit) - kind.log_density(radiance[rows] / shade[rows])
    return odds


def is_at_label_edge(observed: Observed, lit: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Patches with a neighbour of the other label: pictures and meshes are blurred there."""
    graph = observed.graph
    near = graph.pairs[graph.distance_m < _EDGE_SURFELS * observed.surfel_m]
    differs = np.abs(lit[near[:, 0]] - lit[near[:, 1]]) > 0.5
    is_at_edge = np.zeros(len(lit), dtype=bool)
    is_at_edge[near[differs].ravel()] = True
    return is_at_edge


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
    observed: Observed, balance: LightBalance, config: IntrinsicConfig
) -> Float32[np.ndarray, "e 2 2"]:
    """Energy of each pair by the labels of its two patches, in nats.

    The step of the log base colour that labels imply, minus the step that LiDAR predicts, is
    small within a material; beyond a cap, the pair is taken to cross materials.
    """
    light, graph = observed.light.balanced(balance), observed.graph
    diffuse = np.maximum(light.diffuse, 1e-6)
    log_light = np.log(np.stack([diffuse, diffuse + light.sun], axis=1))
    log_colour = (observed.log_radiance[:, None] - log_light).astype(np.float32)
    energy = np.empty((len(graph.pairs), 2, 2), np.float32)
    for start in range(0, len(energy), _CHUNK_PAIRS):
        part = slice(start, start + _CHUNK_PAIRS)
        first, second = graph.pairs[part].T
        reach = 1 + graph.distance_m[part] / np.float32(config.reach_m)
        for a in (0, 1):
            for b in (0, 1):
                step = log_colour[second, b] - log_colour[first, a]
                cost = _misfit(step - observed.reflectance_step[part, None]) / reach
                cost = _STRENGTH * -np.log(np.exp(-cost) + exp(-_MAX_PAIR_ENERGY))
                energy[part, a, b] = graph.weight[part] * (cost + _EDGE_ENERGY * (a != b))
    return energy


def _misfit(step: Float32[np.ndarray, "e 3"]) -> Float32[np.ndarray, " e"]:
    """Squared step of brightness and of colour, in units of their spread."""
    mean = step.mean(axis=1)
    chroma = step - mean[:, None]
    return 0.5 * (mean / _REFLECTANCE_STD) ** 2 + 0.5 * (chroma**2).sum(axis=1) / _HUE_STD**2


def predict_reflectance_steps(
    graph: Graph,
    log_radiance: Float64[np.ndarray, "n 3"],
    log_reflectance: Float64[np.ndarray, " n"],
    visibility: Float32[np.ndarray, "n 2"],
) -> tuple[Float32[np.ndarray, " e"], float]:
    """Step of log base colour across each pair that LiDAR intensity predicts, and the gain.

    The gain is the regression of radiance steps on intensity steps over pairs that every
    rendering puts on the same side of the sun; noise of the intensity shrinks it, as it should.
    """
    first, second = graph.pairs.T
    step = (log_reflectance[second] - log_reflectance[first]).astype(np.float32)
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
