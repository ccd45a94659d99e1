"""Cues for the sun direction: log likelihoods of directions, under a sun that casts shadows and
under an overcast sky.

A cue is evaluated on cells of a given size. Every cue takes the cells' half width as a blur, so
that a narrow peak does not fall between cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree

from lightsim.core.equirect import uv_from_directions
from lightsim.core.log import GeoReference
from lightsim.core.solar import SolarPosition
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.directions import log_vmf
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sun.direction import (
    UNKNOWN_HEADING_STD_DEG,
    SunBlob,
    find_sun_blobs,
    gradient_candidates,
)
from lightsim.lighting.sun.shadow_likelihood import ShadowLikelihood

# Assumptions; their sensitivity was not measured.

# Probability that the recorded heading is wrong, so that other cues can overrule it.
_WRONG_HEADING_FRACTION = 0.002
# Probability that the recorded place or time is wrong.
_WRONG_PLACE_FRACTION = 0.0005
# Plausibility that none of the clipped spots is the sun, on the scale of SunBlob.plausibility.
_NO_SPOT_WEIGHT = 0.15
# Maximum absolute log odds of sun against overcast from a single cue.
_MAX_LOG_ODDS = 6.0
# Log likelihood of a clear sun in observed, unsaturated sky, relative to elsewhere.
_OPEN_SKY_PENALTY = -3.0
# Standard deviation of the relative errors of a well-fitting clear sky: thin cloud and non-linear
# camera responses.
_GRADIENT_STD = 0.07
# Probability that a clear sky is the wrong model, so that its gradient carries no information.
_GRADIENT_OUTLIERS = 0.4


@runtime_checkable
class Cue(Protocol):
    """One observation that constrains the sun direction."""

    @property
    def name(self) -> str:
        """Name of the cue in the notes of the sky."""
        ...

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Return log likelihoods per direction: column 0 under a clear sun, column 1 overcast.

        Natural logarithms, relative to a uniform hemisphere. `blur_deg` is the standard deviation
        that widens narrow cues to the spacing of the directions.
        """
        ...


def _two_columns(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    return np.stack([values, values], axis=1)


def _with_outliers(
    log_density: Float[np.ndarray, " n"], outlier_fraction: float
) -> Float[np.ndarray, " n"]:
    """Mix a density with a uniform hemisphere; the result is relative to the uniform density."""
    # A uniform hemisphere has the log density -log(2 pi) per steradian.
    relative = np.log1p(-outlier_fraction) + log_density + np.log(2 * np.pi)
    return np.logaddexp(relative, np.log(max(outlier_fraction, 1e-12)))


@dataclass(frozen=True, eq=False)
class EphemerisCue:
    """Sun position by place and time: the elevation is known, the azimuth is as uncertain as the
    heading."""

    position: SolarPosition
    geo: GeoReference
    name: str = "place and time"

    @property
    def heading_std_deg(self) -> float | None:
        """Standard deviation of the heading, in degrees; None if the heading is unknown."""
        if self.geo.enu_from_world is None:
            return None
        residual = self.geo.heading_residual_deg
        return UNKNOWN_HEADING_STD_DEG if residual is None else float(residual)

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Return a normal density in elevation and azimuth, relative to a uniform hemisphere; equal
        for a clear sun and an overcast sky.

        Without a heading all azimuths are equally likely. A wrong heading or place has a small
        probability, so that other cues can prevail.
        """
        level_deg = float(np.hypot(self.geo.sun_std_deg, blur_deg))
        elevation = np.degrees(np.arcsin(np.clip(directions_world[:, 2], -1, 1)))
        height = -0.5 * ((elevation - self.position.elevation_deg) / level_deg) ** 2
        height -= np.log(level_deg)
        # An angle on the sphere is a larger angle of azimuth near the zenith; bounded there.
        cosine = np.maximum(np.cos(np.radians(self.position.elevation_deg)), 0.05)
        if self.geo.enu_from_world is None or self.heading_std_deg is None:
            turn = np.full(len(height), -np.log(360.0 * cosine))
        else:
            in_enu = self.geo.enu_from_world.rotate(directions_world)
            azimuth = np.degrees(np.arctan2(in_enu[:, 0], in_enu[:, 1]))
            off = (azimuth - self.position.azimuth_deg + 180.0) % 360.0 - 180.0
            std = float(np.linalg.norm([self.heading_std_deg, level_deg / cosine]))
            right = -0.5 * (off / std) ** 2 - np.log(std * np.sqrt(2 * np.pi) * cosine)
            turn = np.logaddexp(
                np.log1p(-_WRONG_HEADING_FRACTION) + right,
                np.log(_WRONG_HEADING_FRACTION / 360.0 / cosine),
            )
        # From a density per square degree to one per steradian.
        log_density = height + turn - 0.5 * np.log(2 * np.pi) + 2 * np.log(180.0 / np.pi)
        return _two_columns(_with_outliers(log_density, _WRONG_PLACE_FRACTION))


def ephemeris_cue(geo: GeoReference, position: SolarPosition) -> EphemerisCue:
    """Return the cue of the sun's position by place and time, or as given by the user.

    Raises:
        InputError: the sun is below the horizon.
    """
    if position.elevation_deg <= 0:
        raise InputError(
            "the sun is below the horizon: twilight and night are not modelled",
            got=f"elevation {position.elevation_deg:.2f} degrees",
            expected="an elevation above 0",
            remedy="Build with --gps none, which estimates the light from the pictures alone.",
        )
    return EphemerisCue(position, geo)


@dataclass(frozen=True, eq=False)
class BlobCue:
    """Clipped spots of the sky, one of which may be the sun.

    A cut spot (`SunBlob.is_cut`) may be the rim of a glow whose centre was not observed.
    """

    blobs: Sequence[SunBlob]
    name: str = "clipped spots"

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Return lobes around the spots, weighted by plausibility, plus a uniform density for the
        case that none is the sun.

        The likelihood of a clear sun is increased by up to 1.5 nats near the most plausible spot,
        if that spot is not cut.
        """
        weight = np.array([blob.plausibility for blob in self.blobs])
        none = _NO_SPOT_WEIGHT / (_NO_SPOT_WEIGHT + weight.sum())
        parts = [self._around(blob, directions_world, blur_deg) for blob in self.blobs]
        density = np.tensordot(weight / weight.sum(), np.exp(parts), axes=1)
        values = np.log((1 - none) * density * 2 * np.pi + none)
        # An isolated, round spot is rare under cloud.
        best = max(self.blobs, key=lambda blob: blob.plausibility)
        odds = 0.0 if best.is_cut else float(np.clip(np.log(best.plausibility + 0.5), 0.0, 1.5))
        near = directions_world @ best.direction_world > np.cos(np.radians(6.0 + blur_deg))
        return np.stack([values + odds * near, values], axis=1)

    @staticmethod
    def _around(
        blob: SunBlob, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, " n"]:
        """Log density of the sun given one spot: a narrow and a wide lobe, 0.7 to 0.3."""
        cosine = directions_world @ blob.direction_world
        near_deg = float(np.hypot(0.5, blob.radius_deg * (0.8 if blob.is_cut else 0.33)))
        wide_deg = 15.0 if blob.is_cut else 4.0
        return np.logaddexp(
            np.log(0.7) + log_vmf(cosine, float(np.hypot(near_deg, blur_deg))),
            np.log(0.3) + log_vmf(cosine, float(np.hypot(wide_deg, blur_deg))),
        )


@dataclass(frozen=True, eq=False)
class OpenSkyCue:
    """Observed, unsaturated sky, which contains no clear sun."""

    panorama: Panorama
    name: str = "sky without a sun"

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """`_OPEN_SKY_PENALTY` for a clear sun in unsaturated sky, else 0; no blur."""
        is_open = mask_at(
            self.panorama.is_sky & self.panorama.is_seen & ~self.panorama.is_clipped,
            directions_world,
        )
        return np.stack([_OPEN_SKY_PENALTY * is_open, np.zeros(len(is_open))], axis=1)


def mask_at(
    mask: Bool[np.ndarray, "h w"], directions_world: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Values of the mask at directions."""
    height, width = mask.shape
    uv = uv_from_directions(directions_world)
    column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
    row = np.minimum((uv[:, 1] * height).astype(np.int64), height - 1)
    return mask[row, column]


class _Interpolated:
    """Interpolation of log likelihoods between scattered directions by the three nearest."""

    def __init__(
        self, directions_world: Float[np.ndarray, "d 3"], values: Float[np.ndarray, " d"]
    ) -> None:
        self._tree, self._values = KDTree(directions_world), values

    def at(self, directions_world: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Mean of the three nearest values, weighted by inverse squared distance."""
        distance, index = self._tree.query(directions_world, k=3)
        weight = 1.0 / np.maximum(distance, 1e-4) ** 2
        return (weight * self._values[index]).sum(axis=1) / weight.sum(axis=1)


class GradientCue:
    """Brightness gradient of the observed, unsaturated sky, compared with clear skies."""

    name = "gradient of the sky"

    def __init__(self, panorama: Panorama) -> None:
        directions, residual = gradient_candidates(panorama)
        log_weight = -(residual - residual.min()) / (2 * _GRADIENT_STD**2)
        # All rings have the same number of candidates, so that a candidate represents a solid
        # angle in proportion to the cosine of its elevation.
        fraction = np.exp(log_weight) * np.sqrt(1 - directions[:, 2] ** 2)
        density = np.exp(log_weight) / fraction.sum() * np.sqrt(1 - directions[:, 2] ** 2).sum()
        self._values = _Interpolated(
            directions, np.log((1 - _GRADIENT_OUTLIERS) * density + _GRADIENT_OUTLIERS)
        )

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Return the likelihood of the fitted clear skies, interpolated between candidates, without
        blur; equal for a clear sun and an overcast sky."""
        return _two_columns(self._values.at(directions_world))


class ShadowCue:
    """Cast shadows and shading of the reconstructed surfaces."""

    name = "light and shade"

    def __init__(self, likelihood: ShadowLikelihood) -> None:
        self.likelihood = likelihood
        self._values = _Interpolated(likelihood.direction_world, likelihood.log_likelihood)

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Shadow likelihood plus the log odds of a clear sun; half the shadow likelihood under
        cloud; no blur."""
        values = self._values.at(directions_world)
        # Thin cloud softens shadows without moving them, so the likelihood holds at half weight.
        return np.stack(
            [values + _log_odds(self.likelihood.sunny_probability), 0.5 * values], axis=1
        )


@dataclass(frozen=True, eq=False)
class NetworkCue:
    """Prediction of a trained network for the completed panorama."""

    prediction: SkyPrediction
    temper: float = 0.7
    name: str = "network"

    def log_likelihood(
        self, directions_world: Float[np.ndarray, "n 3"], blur_deg: float
    ) -> Float[np.ndarray, "n 2"]:
        """Predicted density, widened by `temper` and the blur, and the log odds of a clear sun."""
        cosine = directions_world @ self.prediction.sun_direction.astype(np.float64)
        kappa = max(self.prediction.concentration * self.temper, 1e-3)
        std_deg = float(np.hypot(np.degrees(1 / np.sqrt(kappa)), blur_deg))
        values = _with_outliers(log_vmf(cosine, std_deg), 0.1)
        odds = self.temper * _log_odds(self.prediction.sunny_probability)
        return np.stack([values + odds, values], axis=1)


def _log_odds(probability: float) -> float:
    safe = float(np.clip(probability, 1e-6, 1 - 1e-6))
    return float(np.clip(np.log(safe / (1 - safe)), -_MAX_LOG_ODDS, _MAX_LOG_ODDS))


def panorama_cues(panorama: Panorama) -> list[Cue]:
    """Return the cues that a panorama alone provides; none if no sky was observed."""
    seen = panorama.is_sky & panorama.is_seen
    if not seen.any():
        return []
    cues: list[Cue] = [OpenSkyCue(panorama)]
    blobs = find_sun_blobs(panorama)
    if blobs:
        cues.append(BlobCue(blobs))
    try:
        cues.append(GradientCue(panorama))
    except InputError:
        # The sky is saturated, or too little was observed: its gradient carries no information.
        return cues
    return cues
