"""The trained sky dome estimator: LDR panorama -> sun, latent, and domes with this or another
sun."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from lightsim.core.dome import SkyDome, Sun, find_sun, resized
from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint import downsample_observed
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.forms import load_sky_network
from lightsim.lighting.sky.network import SkyNetwork
from lightsim.lighting.sky.paper_network import PaperSkyNetwork
from lightsim.lighting.sky.sky_terms import SkyEncoding, SkyTensors
from lightsim.lighting.weights import tensors_of

# Rotations over which predictions are averaged, as fractions of the width. The network is
# equivariant to rotations by multiples of its stride, so only other rotations add information.
_ROTATIONS = (0.0, 5 / 128, 10 / 128)
# Standard deviation of the sun's direction in the published form, which predicts no uncertainty.
# This and the next two are chosen, not measured; they are weak, so that other evidence prevails.
_PUBLISHED_STD_DEG = 30.0
# Standard deviation of its log peak.
_PUBLISHED_LOG_PEAK_STD = 1.5
# Its probability of a clear sun.
_PUBLISHED_SUNNY = 0.5
# Lowest sun of the published form, in degrees: its direction is not limited to the upper half.
_LOWEST_SUN_DEG = 1.0


@dataclass(frozen=True, eq=False)
class SkyEstimator:
    """Estimates skies from LDR panoramas (sRGB in [0, 1], row 0 up) and decodes HDR domes.

    The network of this package replaces unobserved pixels by a smooth fill; their values are
    ignored. The published network has no mask: its panoramas must be complete.

    Args:
        network: trained network.
    """

    network: SkyNetwork | PaperSkyNetwork

    @classmethod
    def load(cls, weights: str | Path) -> SkyEstimator:
        """Load the estimator from shipped weights, by name, or from a file.

        Raises:
            InputError: the weights are missing, damaged or of another network.
        """
        return cls(load_sky_network(tensors_of(weights)))

    @property
    def is_published(self) -> bool:
        """True if the network has the published form, which requires completed panoramas."""
        return isinstance(self.network, PaperSkyNetwork)

    def predict(
        self,
        ldr: Float32[np.ndarray, "h w 3"],
        seen: Bool[np.ndarray, "h w"] | None = None,
    ) -> SkyPrediction:
        """Predict sun, intensity and latent of a panorama of any size.

        The prediction of this package's network is a mean over small rotations and mirror images.

        Args:
            ldr: panorama; only its observed pixels are used.
            seen: mask of the observed pixels; None means all.

        Raises:
            InputError: the panorama is not twice as wide as high.
        """
        batch = self._tensors(ldr, seen)
        with torch.no_grad():
            if isinstance(self.network, PaperSkyNetwork):
                return _published(self.network.encode(batch))
            return _mean_prediction(self.network.encode(batch), _views(self.network, batch))

    def decode(
        self,
        prediction: SkyPrediction,
        ldr: Float32[np.ndarray, "h w 3"],
        *,
        seen: Bool[np.ndarray, "h w"] | None = None,
        sun_direction: Float[np.ndarray, "3"] | None = None,
        log_peak: float | None = None,
    ) -> Float32[np.ndarray, "h/2 w 3"]:
        """Decode the radiance of the upper half, in units of the clipping value, under this or
        another sun.

        At the network's own height the brightest pixel has luminance exp(log_peak) and lies at the
        sun; at another height the sun keeps its irradiance, so its radiance changes.

        Args:
            prediction: result of `predict` for `ldr`.
            ldr: as given to `predict`.
            seen: as given to `predict`.
            sun_direction: another unit vector towards the sun, above the horizon.
            log_peak: another peak.

        Raises:
            InputError: the requested sun is below the horizon.
        """
        direction = prediction.sun_direction if sun_direction is None else sun_direction
        if direction[2] <= 0:
            raise InputError(
                "the sun of a sky dome must be above the horizon",
                got=f"elevation {math.degrees(math.asin(max(-1.0, float(direction[2])))):.1f} deg",
                expected="an elevation above 0 deg",
            )
        batch = self._tensors(ldr, seen)
        encoding = _encoding(prediction)
        peak = torch.tensor([prediction.log_peak if log_peak is None else log_peak])
        with torch.no_grad():
            dome = self.network.dome(batch, encoding, _row(direction), peak.to(torch.float32))
        upper = dome[0].permute(1, 2, 0).numpy().astype(np.float32)
        return _at_height(upper, np.asarray(direction, np.float64), ldr.shape[0])

    def _tensors(
        self, ldr: Float32[np.ndarray, "h w 3"], seen: Bool[np.ndarray, "h w"] | None
    ) -> SkyTensors:
        """Batch of one panorama at the network's size; fields without input are 0."""
        height, width = ldr.shape[:2]
        if width != 2 * height or height % 2:
            raise InputError(
                "a panorama must be twice as wide as high, and of even height",
                got=f"{width}x{height} px",
                expected=f"for example {2 * self.network.config.height_px}x"
                f"{self.network.config.height_px} px",
            )
        rows = self.network.config.height_px
        mask = np.ones((height, width), bool) if seen is None else seen
        if height != rows:
            ldr, mask = downsample_observed(ldr, mask, rows)
        image = torch.from_numpy(np.moveaxis(ldr, -1, 0)[None].copy())
        nothing = torch.zeros(1)
        return SkyTensors(
            panorama=image,
            seen=torch.from_numpy(mask.astype(np.float32))[None, None],
            front=torch.zeros(1, 3, 1, 1),
            sky=torch.zeros(1, 3, rows // 2, 2 * rows),
            sun_direction=torch.zeros(1, 3),
            log_peak=nothing,
            is_sunny=nothing,
        )


def _views(network: SkyNetwork, batch: SkyTensors) -> list[SkyEncoding]:
    """Encodings of rotated and mirrored panoramas, with their directions rotated back."""
    width = batch.panorama.shape[3]
    found = []
    for mirrored in (False, True):
        for fraction in _ROTATIONS:
            shift = round(fraction * width)
            panorama, seen = batch.panorama, batch.seen
            if mirrored:
                panorama, seen = panorama.flip(3), seen.flip(3)
            view = batch.shown(panorama.roll(shift, 3), seen.roll(shift, 3))
            encoding = network.encode(view)
            # Columns grow clockwise: a shift to the right lowers the azimuth.
            direction = _turned(encoding.direction, 2 * math.pi * shift / width)
            if mirrored:
                direction = direction * torch.tensor([1.0, -1.0, 1.0])
            found.append(
                SkyEncoding(
                    direction,
                    encoding.log_concentration,
                    encoding.log_peak,
                    encoding.log_peak_scale,
                    encoding.sunny_logit,
                    encoding.latent,
                )
            )
    return found


def _turned(direction: Float[Tensor, "n 3"], angle_rad: float) -> Float[Tensor, "n 3"]:
    """Directions rotated counter-clockwise about z."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return direction @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _mean_prediction(first: SkyEncoding, views: list[SkyEncoding]) -> SkyPrediction:
    """Mean of the predictions; directions are weighted by concentration, so disagreement
    lowers it."""
    predicted = [_prediction(view) for view in views]
    total = np.mean([p.concentration * p.sun_direction for p in predicted], axis=0)
    length = max(float(np.linalg.norm(total)), 1e-6)
    return SkyPrediction(
        sun_direction=(total / length).astype(np.float32),
        concentration=length,
        log_peak=float(np.mean([p.log_peak for p in predicted])),
        log_peak_std=float(np.mean([p.log_peak_std for p in predicted])),
        sunny_probability=float(np.mean([p.sunny_probability for p in predicted])),
        latent=first.latent[0].numpy().astype(np.float32),
    )


def _prediction(encoding: SkyEncoding) -> SkyPrediction:
    """Prediction of the first sample of an encoding."""
    assert encoding.log_concentration is not None
    assert encoding.log_peak_scale is not None
    assert encoding.sunny_logit is not None
    return SkyPrediction(
        sun_direction=encoding.direction[0].numpy().astype(np.float32),
        concentration=float(encoding.log_concentration[0].exp()),
        log_peak=float(encoding.log_peak[0]),
        # The standard deviation of a Laplace density is sqrt(2) times its scale.
        log_peak_std=math.sqrt(2) * float(encoding.log_peak_scale[0].exp()),
        sunny_probability=float(torch.sigmoid(encoding.sunny_logit[0])),
        latent=encoding.latent[0].numpy().astype(np.float32),
    )


def _published(encoding: SkyEncoding) -> SkyPrediction:
    """Prediction of the published form: one pass, with assumed uncertainties."""
    direction = encoding.direction[0].numpy().astype(np.float32)
    lowest = math.sin(math.radians(_LOWEST_SUN_DEG))
    if direction[2] < lowest:
        level = max(float(np.hypot(direction[0], direction[1])), 1e-6)
        direction[:2] *= math.sqrt(1 - lowest**2) / level
        direction[2] = lowest
    return SkyPrediction(
        sun_direction=direction,
        concentration=1 / math.radians(_PUBLISHED_STD_DEG) ** 2,
        log_peak=float(encoding.log_peak[0]),
        log_peak_std=_PUBLISHED_LOG_PEAK_STD,
        sunny_probability=_PUBLISHED_SUNNY,
        latent=encoding.latent[0].numpy().astype(np.float32),
    )


def _encoding(prediction: SkyPrediction) -> SkyEncoding:
    return SkyEncoding(
        _row(prediction.sun_direction),
        None,
        torch.tensor([prediction.log_peak]),
        None,
        None,
        _row(prediction.latent),
    )


def _row(vector: Float[np.ndarray, " v"]) -> Float[Tensor, "1 v"]:
    return torch.from_numpy(np.asarray(vector, np.float32).copy())[None]


def _at_height(
    upper: Float32[np.ndarray, "r w 3"], direction: Float[np.ndarray, "3"], height_px: int
) -> Float32[np.ndarray, "r2 w2 3"]:
    """Resize an upper half for a panorama of another height; a sun keeps its irradiance and
    direction."""
    if 2 * len(upper) == height_px:
        return upper
    # The lower half repeats the horizon, so that no black ground bleeds into the last rows.
    whole = np.concatenate([upper, np.broadcast_to(upper[-1:], upper.shape)]).astype(np.float32)
    sun = Sun(direction, np.zeros(3, np.float32)) if find_sun(whole) else None
    return resized(SkyDome(whole, sun), height_px).radiance[: height_px // 2]
