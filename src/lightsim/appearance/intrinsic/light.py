"""The source light on a surface by its parts, and the strength of the sun that lit and shadowed
neighbours ask for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.errors import InputError

_GRID = np.linspace(np.log(0.01), np.log(10.0), 47)
"""Candidates of the log of the factor."""
_STEPS, _ROUNDS = 25, 4
_LEAST_SKY = 0.04
"""Share of open sky that the deepest corner gets (further bounces)."""
_TONE_STD, _HUE_STD = 0.3, 0.12
_MOST_WRONG = 0.6
"""Share of the pairs at which a rendered shadow may be wrong altogether."""
_REMAINDER = 0.02
"""Likelihood of a pair across materials, relative to the peak of the model."""


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Light on n points, irradiance / pi: what a white Lambert surface shows.

    Args:
        sun: of the sun by the cosine law, without visibility.
        visibility: fraction of the sun's disc seen, one column for each belief about what
            stands there: the measured surfaces alone, and the inferred ones, too.
        sky: of the open sky.
        bounce_of_sun: sunlight from other surfaces.
        bounce_of_sky: skylight from other surfaces.
        bounce_albedo: grey base colour that other surfaces were given for the bounce.
    """

    sun: Float32[np.ndarray, "n 3"]
    visibility: Float32[np.ndarray, "n 2"]
    sky: Float32[np.ndarray, "n 3"]
    bounce_of_sun: Float32[np.ndarray, "n 3"]
    bounce_of_sky: Float32[np.ndarray, "n 3"]
    bounce_albedo: float

    def __post_init__(self) -> None:
        parts = (self.sun, self.visibility, self.sky, self.bounce_of_sun, self.bounce_of_sky)
        if any(not np.isfinite(part).all() or (part < 0).any() for part in parts):
            raise InputError(
                "the light of a mesh is negative or not finite",
                expected="finite values of 0 or more from sun, sky and other surfaces",
            )

    def diffuse(self, scales: LightScales) -> Float64[np.ndarray, "n 3"]:
        """All light but the direct sun."""
        bounce = self.bounce_of_sky + scales.sun * self.bounce_of_sun
        return (self.sky + scales.bounce * bounce).astype(np.float64)

    def direct(self, scales: LightScales) -> Float64[np.ndarray, "n 3"]:
        """The sun where nothing hides it."""
        return (scales.sun * self.sun).astype(np.float64)

    def total(
        self, scales: LightScales, visibility: Float[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 3"]:
        return self.diffuse(scales) + visibility[:, None] * self.direct(scales)

    def floored(self) -> SurfaceLight:
        """With a little sky everywhere: corners that no traced ray left are not black."""
        least = _LEAST_SKY * np.percentile(self.sky, 95, axis=0).astype(np.float32)
        return replace(self, sky=np.maximum(self.sky, least))

    def at(self, rows: Int64[np.ndarray, " m"]) -> SurfaceLight:
        """Of some of the points."""
        return SurfaceLight(
            self.sun[rows],
            self.visibility[rows],
            self.sky[rows],
            self.bounce_of_sun[rows],
            self.bounce_of_sky[rows],
            self.bounce_albedo,
        )


LightAt = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], SurfaceLight]
"""Light at points with unit normals, in the frame of the mesh."""


@dataclass(frozen=True, eq=False)
class LightScales:
    """What the estimated sun must be multiplied with for lit and shadowed sides of a surface to
    agree; the sky is the gauge, because cameras see it.

    Args:
        sun: RGB factor on the sun's irradiance.
        log_std: one standard deviation of the log of the factor.
        pair_count: lit/shadowed pairs behind it; 0 says that the factor is assumed.
        bounce: RGB factor on the bounced light, which was rendered with grey surroundings.
    """

    sun: Float64[np.ndarray, "3"]
    log_std: float
    pair_count: int
    bounce: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.ones(3))

    @staticmethod
    def assumed(log_std: float) -> LightScales:
        """The estimated sun as it is."""
        return LightScales(np.ones(3), log_std, 0)


@dataclass(frozen=True, eq=False)
class ShadowPairs:
    """A lit and a shadowed patch of one surface each.

    Args:
        lit, shadowed: indices of surfels.
        tone_step: log of the ratio of base colours, lit over shadowed, that LiDAR predicts.
        weight: of the pair.
    """

    lit: Int64[np.ndarray, " p"]
    shadowed: Int64[np.ndarray, " p"]
    tone_step: Float64[np.ndarray, " p"]
    weight: Float64[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.lit)


def fit_sun_scale(
    pairs: ShadowPairs,
    log_radiance: Float64[np.ndarray, "n 3"],
    light: SurfaceLight,
    block: Int64[np.ndarray, " n"],
    bounce: Float64[np.ndarray, "3"],
) -> LightScales:
    """The factor at which lit and shadowed patches have one base colour, channel by channel.

    A pair says log(L_lit / L_shadowed) - step = log((s S + D_lit) / D_shadowed). Rendered shadows
    may lie where there is none, so pairs follow a mixture: of this model, of no step at all (at
    most `_MOST_WRONG` of them), and of a wide remainder (changes of material). The best common
    factor is searched on a grid; the channels follow as medians over the pairs that the model
    explains. Pairs of one block of space share their errors and count as one observation for
    the uncertainty.
    """
    wanted = log_radiance[pairs.lit] - log_radiance[pairs.shadowed] - pairs.tone_step[:, None]
    model = _StepModel(light.at(pairs.lit), light.at(pairs.shadowed), bounce)
    scores = [
        _score(wanted - model.log_step(np.full(3, np.exp(log_scale))), wanted, pairs.weight)
        for log_scale in _GRID
    ]
    sun = np.full(3, np.exp(_GRID[int(np.argmax(scores))]))
    residual, share = wanted, pairs.weight
    for _ in range(_ROUNDS):
        residual = wanted - model.log_step(sun)
        share = pairs.weight * _explained(residual, wanted) + 1e-9
        sun = _balance(wanted, share, model)
    spread = float(np.sqrt((share * residual[:, 1] ** 2).sum() / share.sum()))
    places = np.bincount(np.unique(block[pairs.lit], return_inverse=True)[1], share)
    count = places.sum() ** 2 / np.maximum((places**2).sum(), 1e-12)
    log_std = spread / model.slope(sun) / float(np.sqrt(max(count, 1.0)))
    return LightScales(sun, float(log_std), len(pairs), bounce)


@dataclass(frozen=True, eq=False)
class _StepModel:
    """Light of the lit and of the shadowed patch of each pair."""

    lit: SurfaceLight
    shadowed: SurfaceLight
    bounce: Float64[np.ndarray, "3"]

    def log_step(self, sun: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "p 3"]:
        """Log of the light of the lit patch over that of the shadowed one."""
        scales = LightScales(sun, 0.0, 0, self.bounce)
        lit = self.lit.diffuse(scales) + self.lit.direct(scales)
        return np.log(np.maximum(lit, 1e-9) / np.maximum(self.shadowed.diffuse(scales), 1e-9))

    def slope(self, sun: Float64[np.ndarray, "3"]) -> float:
        """Change of the median log step with the log of the factor, green channel."""
        low, high = (np.median(self.log_step(sun * factor)[:, 1]) for factor in (0.95, 1.05))
        return max(float(high - low) / 0.1, 0.05)


def _likelihood(residual: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
    """Of a step that the model should explain, with the spread of base colour in a material."""
    mean = residual.mean(axis=1)
    hue = ((residual - mean[:, None]) ** 2).sum(axis=1)
    return np.exp(-0.5 * (mean / _TONE_STD) ** 2 - 0.5 * hue / _HUE_STD**2)


def _score(
    residual: Float64[np.ndarray, "p 3"],
    wanted: Float64[np.ndarray, "p 3"],
    weight: Float64[np.ndarray, " p"],
) -> float:
    """Log likelihood at the best share of wrong pairs."""
    model, wrong = _likelihood(residual), _likelihood(wanted)
    shares = np.linspace(0.05, _MOST_WRONG, 5)
    return max(
        float((weight * np.log((1 - share) * model + share * wrong + _REMAINDER)).sum())
        for share in shares
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
    share = np.cumsum(weight[order], axis=0) / weight.sum()
    row = np.minimum((share < 0.5).sum(axis=0), len(values) - 1)
    return np.take_along_axis(np.take_along_axis(values, order, 0), row[None], 0)[0]


def light_blocks(position: Float64[np.ndarray, "n 3"], block_m: float) -> Int64[np.ndarray, " n"]:
    """A number for the block of space that each point lies in."""
    cell = np.floor(position / block_m).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    size = cell.max(axis=0, initial=0) + 1
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(size)))


def is_lit_enough(light: SurfaceLight, scales: LightScales) -> Bool[np.ndarray, " n"]:
    """Where the label changes the light by more than a few percent."""
    return light.direct(scales)[:, 1] > 0.05 * light.diffuse(scales)[:, 1]
