"""The source light on a surface by its parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.errors import InputError

_LEAST_SKY = 0.04
"""Fraction of open sky that the deepest corner gets (further bounces)."""
_LEAST_LIT = 0.05
"""Of the sun's light to all other light, from which on a label changes the sum noticeably."""


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Light on n points, irradiance / pi: what a white Lambert surface shows.

    Args:
        sun: of the sun by the cosine law, without visibility.
        visibility: fraction of the sun's disc seen, one column for each belief about what
            stands there: the measured surfaces alone, and the inferred ones, too.
        sky: of the open sky.
        unseen_sky: what of `sky` comes from directions in which no camera saw the sky.
        bounce: from other surfaces, as the cameras saw them shine.
    """

    sun: Float32[np.ndarray, "n 3"]
    visibility: Float32[np.ndarray, "n 2"]
    sky: Float32[np.ndarray, "n 3"]
    unseen_sky: Float32[np.ndarray, "n 3"]
    bounce: Float32[np.ndarray, "n 3"]

    def __post_init__(self) -> None:
        parts = (self.sun, self.visibility, self.sky, self.unseen_sky, self.bounce)
        if any(not np.isfinite(part).all() or (part < 0).any() for part in parts):
            raise InputError(
                "the light of a mesh is negative or not finite",
                expected="finite values of 0 or more from sun, sky and other surfaces",
            )

    @property
    def diffuse(self) -> Float64[np.ndarray, "n 3"]:
        """All light but the direct sun."""
        return (self.sky + self.bounce).astype(np.float64)

    def total(self, visibility: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """At a visibility of the sun."""
        return self.diffuse + visibility[:, None] * self.sun

    @property
    def is_lit_enough(self) -> Bool[np.ndarray, " n"]:
        """Where the sun's visibility changes the light by more than a few percent."""
        return self.sun[:, 1] > _LEAST_LIT * self.diffuse[:, 1]

    def balanced(self, balance: LightBalance) -> SurfaceLight:
        """With another sun and another unseen sky."""
        unseen = (self.unseen_sky * balance.unseen_sky).astype(np.float32)
        return replace(
            self,
            sun=(self.sun * balance.sun).astype(np.float32),
            sky=np.maximum(self.sky - self.unseen_sky, 0.0) + unseen,
            unseen_sky=unseen,
        )

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
            self.unseen_sky[rows],
            self.bounce[rows],
        )


LightAt = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], SurfaceLight]
"""Light at points with unit normals, in the frame of the mesh."""


@dataclass(frozen=True, eq=False)
class LightBalance:
    """Factors on an estimated light that shadows and known materials ask for.

    Args:
        sun: RGB, on the sun's irradiance.
        unseen_sky: RGB, on the radiance of the sky where no camera saw it.
        sun_log_std, unseen_sky_log_std: one standard deviation of their logs.
        pair_count: lit/shadowed pairs behind it.
    """

    sun: Float64[np.ndarray, "3"]
    unseen_sky: Float64[np.ndarray, "3"]
    sun_log_std: float
    unseen_sky_log_std: float
    pair_count: int

    @staticmethod
    def unchanged() -> LightBalance:
        """The estimated light as it is."""
        return LightBalance(np.ones(3), np.ones(3), np.inf, np.inf, 0)
