"""Likelihood of sun directions from light and shade on the reconstructed surfaces.

Two points of one plane and one material have equal base colours on average, so that the contrast of
their radiance is that of their light: log L_i - log L_j = log(d_i + s c_i v_i) - log(d_j + s c_j
v_j). Here d is the diffuse light (sky view factor plus light of the surroundings, in units of the
level sky), s the sun's strength in these units, c the cosine of incidence, and v the visibility of
the sun, found by casting rays through the meshes. For every direction of a grid, the likelihood of
the observed contrasts is computed; the alternative hypothesis, an overcast sky, has a sun of
strength 0.

Errors of base colour and mesh are correlated between neighbouring pairs. The posterior is therefore
the mean over bootstrap samples of blocks of space (BayesBag, Huggins & Miller 2023,
doi:10.1214/21-BA1301), which is wide if few blocks contain evidence or if the model is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy import sparse
from scipy.spatial import KDTree

from lightsim.core.casting import RayCaster
from lightsim.lighting.directions import count_for_spacing, fibonacci_hemisphere, log_vmf
from lightsim.lighting.sun.surface_samples import RAY_OFFSET_M, SampleConfig, SurfaceSamples
from lightsim.progress import Progress, SilentProgress


@dataclass(frozen=True)
class _ContrastModel:
    """Model of contrasts between surface points.

    The values were chosen on streets 0 and 1 and log 002 and measured only in combination
    (docs/benchmarks/lighting.md).
    """

    strengths: tuple[float, float, float, float] = (0.6, 1.5, 3.5, 8.0)
    """Candidate strengths: irradiance of a high sun over the level sky's. An overcast sky has
    0."""
    min_blocks: int = 5
    """Blocks with pairs, at least; with fewer, the likelihood is uniform."""
    max_cells: int = 60
    """Coarse cells that are refined, at most; a limit on time."""
    uniform_fraction: float = 0.02
    """Weight of a uniform density in the result: no direction is excluded, because the model may
    be wrong."""
    log_independent: float = 4.6
    """Log of the number of directions with uncorrelated shadows, about a hundred."""
    pairs_per_point: int = 2
    """Partners of each point."""
    pair_distance_m: tuple[float, float] = (0.3, 3.0)
    """Distance of the nearest and of the farthest partner, in metres."""
    same_plane_cosine: float = 0.97
    """Cosine between the normals of two points of one plane, at least (14 degrees)."""
    same_plane_offset_m: float = 0.15
    """Distance of a point to the plane of its partner, at most, in metres."""
    block_m: float = 4.0
    """Side of the blocks, in metres, within which errors are taken as fully correlated."""
    pairs_per_block: float = 3.0
    """Maximum effective number of independent pairs in a block."""
    wrong_fraction: float = 0.3
    """Fraction of pairs with a wrong cast shadow, because of unobserved occluders."""
    bounce: float = 0.35
    """Light of the surroundings where the sky is hidden, in units of the level sky."""
    fine_deg: float = 1.2
    """Spacing of the refined directions, in degrees."""
    mesh_std_deg: float = 1.5
    """Error of the direction that errors of the meshes cause, in degrees."""


_MODEL = _ContrastModel()


@dataclass(frozen=True)
class ShadowLikelihoodConfig:
    """Settings of the shadow likelihood."""

    samples: SampleConfig = field(default_factory=SampleConfig)
    """Sampling of the surface points."""
    coarse_count: int = 700
    """Directions of the first round, over the hemisphere (5.4 degrees apart)."""
    bootstraps: int = 200
    """Number of bootstrap samples of the blocks."""


@dataclass(frozen=True, eq=False)
class ShadowLikelihood:
    """Likelihood of sun directions, from light and shade on surfaces.

    Args:
        direction_world: candidate directions.
        log_likelihood: log likelihood of each, given a sun that casts shadows; 0 for a uniform sky.
        sunny_probability: probability of a sun that casts shadows, at even prior odds.
        pair_count, block_count: number of pairs and blocks behind it.
    """

    direction_world: Float[np.ndarray, "d 3"]
    log_likelihood: Float[np.ndarray, " d"]
    sunny_probability: float
    pair_count: int
    block_count: int


def likelihood_of_suns(
    samples: SurfaceSamples,
    caster: RayCaster,
    config: ShadowLikelihoodConfig,
    rng: np.random.Generator,
    *,
    progress: Progress | None = None,
) -> ShadowLikelihood:
    """Return the likelihood of sun directions given the light and shade on the samples."""
    first, second = _pairs(samples, rng)
    coarse = fibonacci_hemisphere(config.coarse_count)
    weight = np.full(len(coarse), 2 * np.pi / len(coarse))
    # Bootstrap over blocks: each sample draws as many blocks as there are, with repetition.
    blocks = _block_numbers(samples, first)
    block_count = int(blocks.max()) + 1 if len(blocks) else 0
    if block_count < _MODEL.min_blocks:
        return ShadowLikelihood(coarse, np.zeros(len(coarse)), 0.5, len(first), block_count)
    model = _PairModel(samples, caster, first, second, blocks, config)
    counts = rng.multinomial(
        block_count, np.full(block_count, 1.0 / block_count), size=config.bootstraps
    ).astype(np.float32)
    steps = (progress or SilentProgress()).track(range(3), "estimating the sun from shadows")
    next(steps)
    likelihood = model.block_likelihoods(coarse)
    rough = _resampled(likelihood, counts)
    next(steps)
    sunny, reliability = _reliability(likelihood, model.block_likelihoods(coarse, is_flipped=True))
    next(steps)
    # Coarse cells with most of the mass are replaced by the fine directions nearest to them.
    chosen = _best_cells(rough, weight)
    fine = fibonacci_hemisphere(count_for_spacing(_MODEL.fine_deg))
    fine = fine[np.isin(KDTree(coarse).query(fine)[1], chosen)]
    exact = _resampled(model.block_likelihoods(fine), counts)
    for _ in steps:
        continue
    rest = np.ones(len(coarse), dtype=bool)
    rest[chosen] = False
    fine_sr = len(chosen) * weight[0] / max(1, len(fine))
    directions = np.concatenate([coarse[rest], fine])
    weight = np.concatenate([weight[rest], np.full(len(fine), fine_sr)])
    joint = np.concatenate([rough[:, rest], exact], axis=1)
    density = _blurred(
        directions, _mean_density(reliability * joint, weight), weight, _MODEL.mesh_std_deg
    )
    relative = (1 - _MODEL.uniform_fraction) * density * 2 * np.pi + _MODEL.uniform_fraction
    return ShadowLikelihood(directions, np.log(relative), sunny, len(first), block_count)


def _pairs(
    samples: SurfaceSamples, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Draw random pairs of points on one plane of one material."""
    nothing = np.zeros(0, np.int64)
    if len(samples) < 2:
        return nothing, nothing
    near_m, far_m = _MODEL.pair_distance_m
    tree = KDTree(samples.position_world)
    found = tree.query_pairs(far_m, output_type="ndarray").astype(np.int64)
    i, j = found[:, 0], found[:, 1]
    offset = samples.position_world[j] - samples.position_world[i]
    normal = samples.normal_world
    keep = np.linalg.norm(offset, axis=1) >= near_m
    keep &= np.einsum("ij,ij->i", normal[i], normal[j]) >= _MODEL.same_plane_cosine
    keep &= np.abs(np.einsum("ij,ij->i", normal[i], offset)) <= _MODEL.same_plane_offset_m
    keep &= samples.material[i] == samples.material[j]
    i, j = i[keep], j[keep]
    order = rng.permutation(len(i))[: _MODEL.pairs_per_point * len(samples)]
    return i[order], j[order]


def _block_numbers(
    samples: SurfaceSamples, first: Int64[np.ndarray, " p"]
) -> Int64[np.ndarray, " p"]:
    """Index of the block of each pair's first point."""
    if not len(first):
        return np.zeros(0, np.int64)
    cell = np.floor(samples.position_world[first] / _MODEL.block_m).astype(np.int64)
    return np.unique(cell, axis=0, return_inverse=True)[1].ravel().astype(np.int64)


class _PairModel:
    """Log likelihood of the observed contrasts for any sun, per block."""

    def __init__(
        self,
        samples: SurfaceSamples,
        caster: RayCaster,
        first: Int64[np.ndarray, " p"],
        second: Int64[np.ndarray, " p"],
        blocks: Int64[np.ndarray, " p"],
        config: ShadowLikelihoodConfig,
    ) -> None:
        self._samples, self._caster = samples, caster
        self._config = config
        self._first, self._second = first, second
        self._used = np.unique(np.concatenate([first, second]))
        diffuse = samples.sky_view_factor + _MODEL.bounce * (1 - samples.sky_view_factor)
        self._diffuse = np.maximum(diffuse, 0.05).astype(np.float32)
        seen = samples.log_radiance[first] - samples.log_radiance[second]
        # The contrast beyond that of the diffuse light is caused by the sun or by paint.
        flat = np.log(self._diffuse[first] / self._diffuse[second])
        excess = seen - flat
        # Median absolute deviation times 1.4826, a robust standard deviation: few pairs lie across
        # a shadow edge.
        noise = np.clip(1.4826 * np.median(np.abs(excess)), 0.05, 0.5)
        self._scale = np.float32(1.0 / noise)
        self._excess = (excess * self._scale).astype(np.float32)
        self._inverse_null = 1.0 / _density(self._excess)
        fraction = np.minimum(1.0, _MODEL.pairs_per_block / np.bincount(blocks)).astype(np.float32)
        self._block_count = len(fraction)
        self._sum_blocks = sparse.csr_matrix(
            (fraction[blocks], (blocks, np.arange(len(blocks)))), dtype=np.float32
        )

    def block_likelihoods(
        self, directions: Float[np.ndarray, "d 3"], *, is_flipped: bool = False
    ) -> Float32[np.ndarray, "b d s"]:
        """Return log likelihood ratios against an overcast sky; `is_flipped` negates the sun's log
        contrasts."""
        likelihood = np.zeros(
            (self._block_count, len(directions), len(_MODEL.strengths)), np.float32
        )
        sign = -self._scale if is_flipped else self._scale
        for d, direction in enumerate(directions):
            sun = self._sun_on_points(direction)
            through = _transmission(float(direction[2]))
            for s, strength in enumerate(_MODEL.strengths):
                step = sign * np.log1p(np.float32(strength * through) * sun)
                ratio = self._ratio(step[self._first] - step[self._second])
                likelihood[:, d, s] = self._sum_blocks @ np.log(ratio)
        return likelihood

    def _sun_on_points(self, direction: Float[np.ndarray, "3"]) -> Float32[np.ndarray, " n"]:
        """Cosine times visibility of the sun, over the diffuse light, for each point."""
        samples = self._samples
        sun = np.zeros(len(samples), np.float32)
        cosine = samples.normal_world[self._used] @ direction
        facing = self._used[cosine > 0.02]
        start = samples.position_world[facing] + RAY_OFFSET_M * samples.normal_world[facing]
        hidden = self._caster.is_occluded(start, np.broadcast_to(direction, start.shape).copy())
        sun[facing] = np.where(hidden, 0.0, cosine[cosine > 0.02])
        return sun / self._diffuse

    def _ratio(self, step: Float32[np.ndarray, " p"]) -> Float32[np.ndarray, " p"]:
        wrong = np.float32(_MODEL.wrong_fraction)
        return (1 - wrong) * _density(self._excess - step) * self._inverse_null + wrong


def _transmission(sine: float) -> float:
    """Direct sunlight relative to a sun at the zenith, after the atmosphere.

    Air mass by Kasten & Young 1989 (doi:10.1364/AO.28.004735), optical depth 0.1 per air mass. A
    sun at the horizon therefore casts no strong shadows.
    """
    elevation_deg = float(np.degrees(np.arcsin(np.clip(sine, 0.0, 1.0))))
    air_mass = 1.0 / (sine + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)
    return float(np.exp(-0.1 * (air_mass - 1.0)))


def _density(z: Float32[np.ndarray, " p"]) -> Float32[np.ndarray, " p"]:
    """Return the unnormalised density of contrast errors: Student's t with 3 degrees of freedom,
    and one fifth with three times its width for outliers of base colour."""
    square = z * z
    narrow, wide = 1 + square * np.float32(1 / 3), 1 + square * np.float32(1 / 27)
    return np.float32(0.8) / (narrow * narrow) + np.float32(0.2 / 3) / (wide * wide)


def _reliability(
    found: Float32[np.ndarray, "b d s"], flipped: Float32[np.ndarray, "b d s"]
) -> tuple[float, float]:
    """Return the probability of a sun that casts shadows at even odds, and the weight of the
    likelihood.

    A sun of negated contrast is a control with the same shapes, base colours and number of
    directions: its likelihood arises by chance. The largest likelihood of the sun is compared with
    that of the control; that of a true sun exceeds it by more than expected from the number of
    independent directions.
    """
    best = float(found.sum(axis=0).max())
    chance = max(float(flipped.sum(axis=0).max()), 0.0)
    # Chance maxima of independent directions are about their log; larger ones indicate that the
    # log likelihoods are too large by this factor.
    excess = max(1.0, chance / _MODEL.log_independent)
    log_odds = (best - chance) / excess - _MODEL.log_independent
    probability = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -20.0, 20.0)))
    return float(probability), float(np.clip((best - chance) / max(best, 1e-6), 0.0, 1.0))


def _resampled(
    likelihood: Float32[np.ndarray, "b d s"], counts: Float32[np.ndarray, "k b"]
) -> Float32[np.ndarray, "k d s"]:
    """Sums over the blocks of each bootstrap sample."""
    flat = counts @ likelihood.reshape(len(likelihood), -1)
    return flat.reshape(len(counts), *likelihood.shape[1:])


def _best_cells(
    log_ratio: Float32[np.ndarray, "k d s"], weight: Float[np.ndarray, " d"]
) -> Int64[np.ndarray, " m"]:
    """Coarse directions to refine: those with most of the posterior's mass, which is flattened
    first because the coarse grid may miss narrow peaks."""
    density = _mean_density(0.5 * log_ratio, weight) * weight
    order = np.argsort(density)[::-1]
    count = int((np.cumsum(density[order]) < 0.98).sum()) + 1
    return order[: min(count, _MODEL.max_cells)].astype(np.int64)


def _mean_density(
    log_ratio: Float32[np.ndarray, "k d s"], weight: Float[np.ndarray, " d"]
) -> Float64[np.ndarray, " d"]:
    """Posterior density per sr given a sun, mean over the bootstrap samples."""
    # The maximum is subtracted first, so that the exponentials do not overflow.
    top = log_ratio.max(axis=(1, 2), keepdims=True)
    density = np.exp((log_ratio - top).astype(np.float64)).mean(axis=2)
    density /= (density @ weight)[:, None]
    return density.mean(axis=0)


def _blurred(
    directions: Float[np.ndarray, "d 3"],
    density: Float[np.ndarray, " d"],
    weight: Float[np.ndarray, " d"],
    std_deg: float,
) -> Float[np.ndarray, " d"]:
    """Density blurred by the mesh errors that all blocks have in common."""
    kernel = np.exp(log_vmf(np.clip(directions @ directions.T, -1, 1), std_deg))
    # Coarse cells are wider than the kernel; normalised rows retain their mass there.
    mass = kernel * weight[None]
    return (mass / mass.sum(axis=1, keepdims=True)) @ density
