"""The sun's irradiance from lit and shadowed neighbours.

Two neighbours of one surface share their base colour a on average. Lit: L1 = a (Es c + D1) / pi;
in shadow: L2 = a D2 / pi, where c is the sun's cosine and D the diffuse irradiance: each point's
own part of the sky, which is brighter near the sun and at the horizon, and the light of the
surfaces around it as cameras saw them (`LightEvidence.diffuse_light`). With q = (L1 / D1) /
(L2 / D2), a pair says q = 1 + Es c / D1. D is absolute, so Es is, too. What casts a shadow hides
part of the sky as well, mostly that near the sun: an even sky would make the sun too strong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from lightsim.core.colour import luminance
from lightsim.lighting.sun.evidence import LightEvidence
from lightsim.lighting.sun.surface_samples import BLOCK_M, SAME_PLANE_COSINE, SAME_PLANE_OFFSET_M

# Chosen with streets 0 and 1 and log 002 in view; only what all do together is measured
# (docs/benchmarks/lighting.md).

# Pairs lie no farther apart.
_MAX_PAIR_DISTANCE_M = 2.5
# More pairs are thinned at random.
_MAX_PAIRS = 6000
# Fewer pairs say nothing.
_MIN_PAIRS = 40
# Below this ratio of the sun's irradiance to the sky's, the light is called diffused.
_DIFFUSED_RATIO = 0.25


@dataclass(frozen=True, eq=False)
class SunFit:
    """The sun's strength.

    Args:
        irradiance: RGB on a surface facing the sun, scene units.
        log_std: one standard deviation of the log of its luminance.
        kind: "direct" (shadows seen), "diffused" (lit and shadowed points look alike) or
            "unknown" (no pairs; irradiance is zero and means nothing).
        pair_count: pairs used.
        notes: what was seen.
    """

    irradiance: Float32[np.ndarray, "3"]
    log_std: float
    kind: str
    pair_count: int
    notes: tuple[str, ...]


_RATIOS = np.geomspace(0.01, 40.0, 121)
"""Candidates of the sun's luminance over the sky's on level ground."""
_OUTLIER_SHARES = (0.05, 0.2, 0.4, 0.6)
"""Fraction of pairs whose shadow label is wrong: registration, unseen roofs."""
_NOISE_LOG_STDS = (0.1, 0.2, 0.35, 0.6)
"""Spread of base colour between the points of a pair."""


def fit_sun(
    evidence: LightEvidence,
    diffuse: Float[np.ndarray, "n 3"],
    sky_irradiance: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    *,
    sunny_probability: float | None = None,
) -> SunFit:
    """The sun's irradiance by a robust fit to lit/shadowed pairs.

    The luminance ratio sun : sky has a posterior on a grid: pairs follow a mixture of the model
    and of wrong labels (log q about 0), with unknown fraction and spread, both integrated out. The
    channels then follow from the pairs that the model explains.

    Args:
        diffuse: irradiance of every point without the sun.
        sky_irradiance: on level ground, sun excluded.
        sunny_probability: prior for a sun that casts shadows, from elsewhere.
    """
    lit, shaded = _pairs(evidence, rng)
    if len(lit) < _MIN_PAIRS:
        return SunFit(
            np.zeros(3, np.float32),
            np.inf,
            "unknown",
            len(lit),
            (f"only {len(lit)} pairs of lit and shadowed neighbours were seen",),
        )
    diffuse = np.maximum(diffuse, 0.02 * sky_irradiance)
    cosine = evidence.sun_cosine[lit]
    radiance = np.maximum(evidence.radiance.astype(np.float64), 1e-6)
    excess = (radiance[lit] / diffuse[lit]) / (radiance[shaded] / diffuse[shaded])
    grey = _grey(radiance[lit]) / _grey(diffuse[lit])
    log_q = np.log(grey / (_grey(radiance[shaded]) / _grey(diffuse[shaded])))
    sky_luminance = float(_grey(sky_irradiance[None])[0])
    gain = cosine * sky_luminance / _grey(diffuse[lit])
    blocks = _block_count(evidence.position_world[lit], BLOCK_M)
    ratio, log_std, fraction = _posterior(log_q, gain, blocks, _log_prior(sunny_probability))
    rgb = _channels(excess, diffuse[lit], cosine, log_q, gain, ratio)
    rgb *= ratio * sky_luminance / max(float(_grey(rgb[None])[0]), 1e-12)
    kind = "direct" if ratio >= _DIFFUSED_RATIO else "diffused"
    note = (
        f"{len(lit)} pairs in {blocks} places: sun/sky luminance {ratio:.2f}, {kind}"
        f" (log std {log_std:.2f}, {100 * fraction:.0f} % of the pairs contradict)"
    )
    return SunFit(rgb.astype(np.float32), log_std, kind, len(lit), (note,))


def _grey(rgb: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return luminance(rgb).astype(np.float64)


def _pairs(
    evidence: LightEvidence, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Indices of lit points and of their nearest shadowed neighbours on the same surface."""
    lit_found: list[np.ndarray] = []
    shaded_found: list[np.ndarray] = []
    for group in np.unique(evidence.group):
        members = evidence.group == group
        facing = evidence.sun_cosine > 0.1
        lit = np.nonzero(members & evidence.is_lit & facing)[0]
        shaded = np.nonzero(members & ~evidence.is_lit & facing)[0]
        if len(lit) == 0 or len(shaded) == 0:
            continue
        tree = KDTree(evidence.position_world[shaded])
        distance, nearest = tree.query(evidence.position_world[lit], k=min(3, len(shaded)))
        distance, nearest = distance.reshape(len(lit), -1), nearest.reshape(len(lit), -1)
        first = np.repeat(lit, distance.shape[1])
        second = shaded[nearest.ravel()]
        keep = (distance.ravel() <= _MAX_PAIR_DISTANCE_M) & _same_surface(evidence, first, second)
        lit_found.append(first[keep])
        shaded_found.append(second[keep])
    if not lit_found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    first, second = np.concatenate(lit_found), np.concatenate(shaded_found)
    if len(first) > _MAX_PAIRS:
        chosen = rng.choice(len(first), _MAX_PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    return first, second


def _same_surface(
    evidence: LightEvidence,
    first: Int[np.ndarray, " n"],
    second: Int[np.ndarray, " n"],
) -> np.ndarray:
    normal = evidence.normal_world[first]
    cosine = np.einsum("ij,ij->i", normal, evidence.normal_world[second])
    offset = evidence.position_world[second] - evidence.position_world[first]
    height_m = np.abs(np.einsum("ij,ij->i", normal, offset))
    return (cosine >= SAME_PLANE_COSINE) & (height_m <= SAME_PLANE_OFFSET_M)


def _block_count(points: Float[np.ndarray, "n 3"], block_m: float) -> int:
    return len(np.unique(np.floor(points / block_m).astype(np.int64), axis=0))


def _log_prior(sunny_probability: float | None) -> Float[np.ndarray, " r"]:
    """Of the ratios: a clear sun brings 1 to 15 times the sky's light, clouds leave less than
    about half of it."""
    log_ratio = np.log(_RATIOS)
    if sunny_probability is None:
        return np.zeros(len(log_ratio))
    p = float(np.clip(sunny_probability, 0.01, 0.99))
    clear = np.exp(-0.5 * ((log_ratio - np.log(4.0)) / 0.7) ** 2)
    cloudy = np.exp(-0.5 * (np.maximum(log_ratio - np.log(0.3), 0.0) / 0.5) ** 2)
    return np.log(p * clear / clear.sum() + (1 - p) * cloudy / cloudy.sum())


def _posterior(
    log_q: Float[np.ndarray, " n"],
    gain: Float[np.ndarray, " n"],
    blocks: int,
    log_prior: Float[np.ndarray, " r"],
) -> tuple[float, float, float]:
    """Median of the sun/sky ratio, its log standard deviation, and the fraction of outliers.

    The likelihood is tempered to one observation per block: neighbouring pairs share paint,
    normals and mesh errors.
    """
    predicted = np.log1p(_RATIOS[:, None] * gain[None, :])
    tables, fractions = [], []
    for fraction in _OUTLIER_SHARES:
        for std in _NOISE_LOG_STDS:
            model = np.exp(-0.5 * ((log_q - predicted) / std) ** 2)
            wrong = np.exp(-0.5 * (log_q / std) ** 2)
            floor = 1e-3
            density = ((1 - fraction) * model + fraction * wrong + floor) / std
            evidence = np.log(density).mean(axis=1) * min(blocks, len(log_q))
            tables.append(evidence + log_prior + np.log(1.0 - fraction))
            fractions.append(fraction)
    table = np.array(tables)
    weights = np.exp(table - table.max())
    posterior = weights.sum(axis=0)
    posterior /= posterior.sum()
    median = float(np.exp(np.interp(0.5, np.cumsum(posterior), np.log(_RATIOS))))
    mean = float(posterior @ np.log(_RATIOS))
    std = float(np.sqrt(posterior @ (np.log(_RATIOS) - mean) ** 2))
    # The model itself (diffuse surfaces, uniform sky) is not better than about 10 %.
    fraction = float((weights.sum(1) @ np.array(fractions)) / weights.sum())
    return median, float(np.hypot(std, 0.1)), fraction


def _channels(
    excess: Float[np.ndarray, "n 3"],
    diffuse: Float[np.ndarray, "n 3"],
    cosine: Float[np.ndarray, " n"],
    log_q: Float[np.ndarray, " n"],
    gain: Float[np.ndarray, " n"],
    ratio: float,
) -> Float[np.ndarray, "3"]:
    """RGB of the sun up to a factor: the median over the pairs nearer to the model than to
    "no sun"; the sky's own colour where too few are."""
    predicted = np.log1p(ratio * gain)
    explained = np.abs(log_q - predicted) < np.abs(log_q)
    per_pair = (excess - 1.0) * diffuse / cosine[:, None]
    if explained.sum() < 20 or ratio < 0.1:
        return np.median(diffuse, axis=0)
    rgb = np.median(per_pair[explained], axis=0)
    return np.maximum(rgb, 0.05 * rgb.max())
