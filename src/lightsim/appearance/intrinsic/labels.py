"""Shadow labels: the probability that the sun reaches each patch of a surface.

At a shadow edge the log radiance of all channels changes as the light model predicts. This relates
two patches of one surface, so the labels form a Markov random field. Its prior is the rendered
visibility: strong inside rendered shadows, weak near their edges, and weaker in rendered light,
because unobserved occluders can only add shadows. Implausible base colours of pavement and walls
are evidence against a label.
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
from lightsim.appearance.intrinsic.reflectance import MaterialVariation, Members
from lightsim.appearance.intrinsic.surfels import Graph, Surfels
from lightsim.core.colour import LUMINANCE_WEIGHTS

# Pairs whose energies are computed together: some 10 MB of intermediate results for any log.
_CHUNK_PAIRS = 1 << 16

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1). benchmarks/bench_decompose.py varies
# those that are settings.

# Probability that the shadow of an inferred (unmeasured) surface exists.
_P_INFERRED_CASTS = 0.75
# Probability that a patch is lit although it is shadowed in every rendering.
_P_LIT_IN_SHADOW = 0.02
# Weight of a patch's own log odds during propagation: errors of neighbours are correlated.
_PRIOR_WEIGHT = 0.25
# Variation of the base colour within a material, between near patches.
_VARIATION = MaterialVariation(log_std=0.2, hue_std=0.08)
# Factor on the energies of pairs, relative to the rendered prior.
_STRENGTH = 1.5

# Energy of a change of material, in nats: the maximum energy of a pair.
_MAX_PAIR_ENERGY = 3.0
# Distance between patches of opposite labels, in patch sizes, within which both may contain the
# edge.
_EDGE_SURFELS = 2.5
# Standard deviation of the filter of base colours for reflections, in metres.
_COLOUR_REACH_M = 1.0
# Range of these base colours.
_COLOURS = (0.05, 0.9)

# Energy of a shadow edge between two patches, in nats: prefers smooth labels.
_EDGE_ENERGY = 0.3


@dataclass(frozen=True, eq=False)
class ObservedSurfels:
    """Surfels with the evidence for their labels.

    Args:
        surfels, graph: patches, and the pairs that are compared.
        log_radiance: natural logarithm of the linear RGB radiance.
        materials: surfels of known material classes.
        own_light: source light at each surfel.
        light: `own_light` with reflections converted (`SurfaceLight.reflections_as_diffuse`), so
            that log radiance = log base colour + log light.
        surfel_m: size of a surfel.
    """

    surfels: Surfels
    graph: Graph
    log_radiance: Float64[np.ndarray, "n 3"]
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
    ) -> ObservedSurfels:
        """Combine surfels with the unbalanced light."""
        log_radiance = np.log(np.maximum(surfels.radiance, 1e-3))
        observed = ObservedSurfels(
            surfels, graph, log_radiance, materials, own_light, own_light, surfel_m
        )
        return observed.with_reflections(LightBalance.unchanged(), rendered_visibility(own_light))

    def with_reflections(
        self, balance: LightBalance, visibility: Float64[np.ndarray, " n"]
    ) -> ObservedSurfels:
        """Convert reflections to light, with the base colours of a balance and a sun visibility.

        The base colours are smoothed, because errors of the visibility leave shadows in them. The
        light itself is not balanced.
        """
        if self.own_light.reflected is None:
            return self
        balanced = self.own_light.balanced(balance)
        colour = np.clip(balanced.base_colour(self.surfels.radiance, visibility), *_COLOURS)
        smooth = [
            np.exp(smoothed(np.log(channel), self.graph, _COLOUR_REACH_M)) for channel in colour.T
        ]
        return replace(self, light=self.own_light.reflections_as_diffuse(np.stack(smooth, axis=1)))


@dataclass(frozen=True, eq=False)
class Labels:
    """Shadow labels of surfels.

    Args:
        lit: posterior probability that the sun reaches each surfel.
        prior: prior probability.
    """

    lit: Float64[np.ndarray, " n"]
    prior: Float64[np.ndarray, " n"]


def label_shadows(
    observed: ObservedSurfels,
    config: IntrinsicConfig,
    prior: Float64[np.ndarray, " n"] | None = None,
) -> Labels:
    """Infer labels under the unbalanced light. `prior` overrides `visibility_prior`."""
    prior = visibility_prior(observed, config) if prior is None else prior
    messages = np.zeros((len(observed.graph.pairs), 2), np.float32)
    lit = prior
    # Three calls of belief propagation; each starts from the messages of the previous call.
    for _ in range(3):
        lit = infer_labels(observed, LightBalance.unchanged(), prior, config, messages)
    return Labels(lit, prior)


def visibility_prior(
    observed: ObservedSurfels, config: IntrinsicConfig
) -> Float64[np.ndarray, " n"]:
    """Return the prior probability that each patch is lit, from the rendered visibility."""
    return softened_prior(rendered_visibility(observed.light), observed.graph, config)


def softened_prior(
    visibility: Float64[np.ndarray, " n"], graph: Graph, config: IntrinsicConfig
) -> Float64[np.ndarray, " n"]:
    """Return the prior probability of being lit, given an estimate of the sun visibility.

    It accounts for the position error of shadow edges and for unobserved occluders.
    """
    smooth = smoothed(visibility, graph, config.edge_error_m)
    return _P_LIT_IN_SHADOW + (1 - config.unseen_shadow - _P_LIT_IN_SHADOW) * smooth


def rendered_visibility(light: SurfaceLight) -> Float64[np.ndarray, " n"]:
    """Return the expected sun visibility, given the probability of inferred surfaces."""
    measured, inferred = light.visibility.astype(np.float64).T
    return _P_INFERRED_CASTS * inferred + (1 - _P_INFERRED_CASTS) * measured


def smoothed(
    values: Float64[np.ndarray, " n"], graph: Graph, radius_m: float
) -> Float64[np.ndarray, " n"]:
    """Return the mean over each surfel and its neighbours, weighted by a Gaussian of distance."""
    weight = np.exp(-0.5 * (graph.distance_m / radius_m) ** 2)
    first, second = graph.pairs.T
    total, mass = values.copy(), np.ones(len(values))
    for i, j in ((first, second), (second, first)):
        total += np.bincount(i, weight * values[j], minlength=len(values))
        mass += np.bincount(i, weight, minlength=len(values))
    return total / mass


def infer_labels(
    observed: ObservedSurfels,
    balance: LightBalance,
    prior: Float64[np.ndarray, " n"],
    config: IntrinsicConfig,
    messages: Float32[np.ndarray, "e 2"],
) -> Float64[np.ndarray, " n"]:
    """Return the probability of being lit, by loopy belief propagation.

    Args:
        observed: evidence.
        balance: factors on the light.
        prior: probability of being lit.
        config: settings.
        messages: 0, or the result of the last call; updated in place.
    """
    from lightsim.appearance.intrinsic.kernels import propagate

    energy = pair_energies(observed, balance, config)
    own = np.log(prior / (1 - prior)) + _material_log_odds(observed, balance, config)
    belief = np.empty(len(own))
    # 16 sweeps, damping 0.2; later calls continue from the messages.
    propagate(_PRIOR_WEIGHT * own, observed.graph.pairs, energy, messages, belief, 16, 0.2)
    # Messages use a fraction of a patch's own log odds; the result contains them in full.
    belief += (1 - _PRIOR_WEIGHT) * own
    lit = 1 / (1 + np.exp(-np.clip(belief, -30, 30)))
    return without_islands(observed, lit, prior, config.island_m2)


def _material_log_odds(
    observed: ObservedSurfels, balance: LightBalance, config: IntrinsicConfig
) -> Float64[np.ndarray, " n"]:
    """Return log odds of lit against shadowed from the base colours of known materials.

    They are 0 in deep shade, where the quotient of radiance and light is inaccurate.
    """
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


def is_at_label_edge(
    observed: ObservedSurfels, lit: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return the mask of patches near a patch of the opposite label, where images are blurred."""
    graph = observed.graph
    near = graph.pairs[graph.distance_m < _EDGE_SURFELS * observed.surfel_m]
    differs = np.abs(lit[near[:, 0]] - lit[near[:, 1]]) > 0.5
    is_at_edge = np.zeros(len(lit), dtype=bool)
    is_at_edge[near[differs].ravel()] = True
    return is_at_edge


def without_islands(
    observed: ObservedSurfels,
    lit: Float64[np.ndarray, " n"],
    prior: Float64[np.ndarray, " n"],
    least_m2: float,
) -> Float64[np.ndarray, " n"]:
    """Reset small connected regions to the prior if their label contradicts the rendering."""
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
    observed: ObservedSurfels, balance: LightBalance, config: IntrinsicConfig
) -> Float32[np.ndarray, "e 2 2"]:
    """Return the energy of each pair by the labels of its two patches, in nats.

    Within a material, the step of log base colour that two labels imply is close to the step that
    LiDAR predicts. The energy saturates, because a pair may cross materials.
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
                cost = _VARIATION.misfit(step) / reach
                cost = _STRENGTH * -np.log(np.exp(-cost) + exp(-_MAX_PAIR_ENERGY))
                energy[part, a, b] = graph.weight[part] * (cost + _EDGE_ENERGY * (a != b))
    return energy
