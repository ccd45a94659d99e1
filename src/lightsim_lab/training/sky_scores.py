"""Scores of sky networks and of two baselines without a network, on one set of panoramas.

The table is that of the paper's appendix (comparisons of sky dome estimation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from lightsim.core.colour import luminance
from lightsim.core.equirect import pixel_directions, solid_angles_sr, uv_from_directions
from lightsim.lighting.sample import LightingBatch
from lightsim.lighting.sky.sky_terms import SkyEncoding, SkyTensors
from lightsim.networks.devices import device_of
from lightsim_lab.training.sky import Completion, sky_tensors

# Probability of the credible regions in the table.
_CREDIBLE = 0.9


@runtime_checkable
class SkyModel(Protocol):
    """Interface of the scored networks: `SkyNetwork` and those of baselines/."""

    @property
    def composes_sun(self) -> bool:
        """True if the sun is composed into the dome: no decoding error beyond the pixel grid."""
        ...

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Estimate the sun, and the latent code, of each panorama of a batch."""
        ...

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Tensor:
        """Return the linear radiance of the upper half [n, 3, h / 2, w], with the given sun."""
        ...


@dataclass(frozen=True)
class SkyScore:
    """One row of the table; NaN if the method has no such estimate, or no sample counts.

    Args:
        name: name of the method.
        count: number of panoramas; `sunny_count` of them have a clear sun.
        angle_mean_deg: mean error of the sun's direction, clear suns.
        angle_median_deg: median error of the sun's direction, clear suns.
        angle_seen_deg: mean error where a camera observed the clear sun.
        angle_hidden_deg: mean error where no camera observed the clear sun.
        angle_hidden_median_deg: median error where no camera observed the clear sun.
        log_peak_error: mean absolute error of the log peak, all skies.
        sunny_accuracy: fraction of correct classifications of suns as clear or not.
        decoding_log_peak: mean absolute difference of the dome's log peak and the decoder's input.
        decoding_angle_deg: mean angle of the dome's brightest spot and the decoder's input.
        inside_90: fraction of clear suns within the 90 % cone of the predicted density.
        peak_inside_90: fraction of peaks within the predicted 90 % interval.
        log_sky_rmse: RMS error of the dome's natural log radiance, weighted by solid angle.
        composes_sun: True if the decoding errors are those of the pixel grid.
    """

    name: str
    count: int
    sunny_count: int
    angle_mean_deg: float
    angle_median_deg: float
    angle_seen_deg: float
    angle_hidden_deg: float
    angle_hidden_median_deg: float
    log_peak_error: float
    sunny_accuracy: float
    decoding_log_peak: float
    decoding_angle_deg: float
    inside_90: float
    peak_inside_90: float
    log_sky_rmse: float
    composes_sun: bool


def evaluate_sky_networks(
    batches: Sequence[LightingBatch],
    models: Mapping[str, SkyModel],
    known: Sequence[LightingBatch],
    complete: Completion | None = None,
) -> list[SkyScore]:
    """Return the rows of the two baselines and of the networks, on the same panoramas.

    Args:
        batches: panoramas to score; the unobserved parts are hidden, then completed.
        models: networks by the names of their rows.
        known: training data; their mean sun and median peak are the baseline `constant`.
        complete: inpainting, as in training.
    """
    rows = [
        score_predictions(
            "constant", batches, [_constant(known, len(b.log_peak)) for b in batches]
        ),
        score_predictions("brightest pixel", batches, [brightest_pixel(b) for b in batches]),
    ]
    for name, model in models.items():
        predictions = [prediction_of(model, batch, complete) for batch in batches]
        rows.append(score_predictions(name, batches, predictions))
    return rows


def parts_of(batch: LightingBatch, size: int) -> list[LightingBatch]:
    """Split a batch into parts of at most `size` panoramas."""
    count = len(batch.log_peak)
    return [
        LightingBatch(**{f.name: getattr(batch, f.name)[k : k + size] for f in fields(batch)})
        for k in range(0, count, size)
    ]


@dataclass(frozen=True, eq=False)
class Predictions:
    """Estimates of a method for a batch; NaN for quantities that it does not estimate.

    Args:
        direction: unit vectors towards the sun.
        cone_deg: half angle of the 90 % cone of the direction.
        log_peak: natural log of the dome's largest luminance.
        peak_margin: half width of the 90 % interval of the log peak.
        sunny: probability of a clear sun.
        dome: radiance of the upper halves, or None.
        composes_sun: see `SkyModel`.
    """

    direction: Float32[np.ndarray, "n 3"]
    cone_deg: Float[np.ndarray, " n"]
    log_peak: Float[np.ndarray, " n"]
    peak_margin: Float[np.ndarray, " n"]
    sunny: Float[np.ndarray, " n"]
    dome: Float32[np.ndarray, "n r w 3"] | None
    composes_sun: bool = False


def prediction_of(
    model: SkyModel, batch: LightingBatch, complete: Completion | None
) -> Predictions:
    """Return the estimates of a network, with the dome decoded from its own sun."""
    count = len(batch.log_peak)
    device = device_of(model) if isinstance(model, torch.nn.Module) else "cpu"
    tensors = sky_tensors(batch, np.zeros(count, bool), complete, torch.device(device))
    with torch.no_grad():
        predicted = model.encode(tensors)
        dome = model.dome(tensors, predicted, predicted.direction, predicted.log_peak)
    # NaN marks the quantities that a network does not estimate.
    silent = np.full(count, np.nan)
    kappa, scale, sunny = (
        predicted.log_concentration,
        predicted.log_peak_scale,
        predicted.sunny_logit,
    )
    return Predictions(
        predicted.direction.cpu().numpy().astype(np.float32),
        silent if kappa is None else credible_cone_deg(kappa.exp().cpu().numpy(), _CREDIBLE),
        predicted.log_peak.cpu().numpy(),
        # The 90 % interval of a Laplace density.
        silent if scale is None else scale.exp().cpu().numpy() * -math.log(1 - _CREDIBLE),
        silent if sunny is None else torch.sigmoid(sunny).cpu().numpy(),
        np.moveaxis(dome.cpu().numpy(), 1, -1).astype(np.float32),
        model.composes_sun,
    )


def score_predictions(
    name: str, batches: Sequence[LightingBatch], predictions: Sequence[Predictions]
) -> SkyScore:
    """Return the row of a method from its estimates for all batches."""
    pairs = list(zip(batches, predictions, strict=True))
    angle = np.concatenate([angles_deg(a.direction, b.sun_direction) for b, a in pairs])
    sunny = np.concatenate([b.is_sunny for b in batches])
    seen = np.concatenate([_sun_is_seen(b) for b in batches])
    peak = np.concatenate([np.abs(a.log_peak - b.log_peak) for b, a in pairs])
    margin = np.concatenate([a.peak_margin for a in predictions])
    cone = np.concatenate([a.cone_deg for a in predictions])
    predicted = np.concatenate([a.sunny for a in predictions])
    decoded = np.array([d for a in predictions for d in decoding_errors(a)]).reshape(-1, 2)
    return SkyScore(
        name=name,
        count=len(angle),
        sunny_count=int(sunny.sum()),
        angle_mean_deg=_mean(angle, sunny),
        angle_median_deg=_median(angle, sunny),
        angle_seen_deg=_mean(angle, sunny & seen),
        angle_hidden_deg=_mean(angle, sunny & ~seen),
        angle_hidden_median_deg=_median(angle, sunny & ~seen),
        log_peak_error=float(peak.mean()),
        sunny_accuracy=_mean((predicted > 0.5) == sunny, ~np.isnan(predicted)),
        decoding_log_peak=_mean(decoded[:, 0], np.ones(len(decoded), bool)),
        decoding_angle_deg=_mean(decoded[:, 1], np.ones(len(decoded), bool)),
        inside_90=_mean(angle <= cone, sunny & ~np.isnan(cone)),
        peak_inside_90=_mean(peak <= margin, ~np.isnan(margin)),
        log_sky_rmse=_log_sky_rmse(pairs),
        composes_sun=any(a.composes_sun for a in predictions),
    )


def angles_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the angle between the directions of each row, also accurate for small angles."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))


def credible_cone_deg(
    concentration: Float[np.ndarray, " n"], fraction: float
) -> Float[np.ndarray, " n"]:
    """Return the half angle of the cone with a given fraction of a von Mises-Fisher density.

    The fraction within cos >= c is (1 - exp(-kappa (1 - c))) / (1 - exp(-2 kappa)), solved for c.
    """
    # expm1 remains accurate for small concentrations.
    kappa = concentration.astype(np.float64)
    cosine = 1.0 + np.log(1 - fraction * -np.expm1(-2 * kappa)) / kappa
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def brightest_spot(upper: Float32[np.ndarray, "r w 3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return the log luminance of the brightest pixel, and the centroid of the spot around it."""
    rows = len(upper)
    value = luminance(upper).astype(np.float64)
    directions = pixel_directions(2 * rows)[:rows]
    row, column = np.unravel_index(int(value.argmax()), value.shape)
    # Pixels within 1.6 rows; their median is the background, without which the centroid is biased.
    near = directions @ directions[row, column] >= math.cos(math.radians(1.6 * 90.0 / rows))
    ring = float(np.median(value[near]))
    weight = np.where(near, np.maximum(value - ring, 0.0), 0.0) * solid_angles_sr(2 * rows)[:rows]
    if weight.sum() <= 0:
        return math.log(max(float(value[row, column]), 1e-6)), directions[row, column]
    centre = np.einsum("rw,rwc->c", weight, directions)
    return math.log(max(float(value[row, column]), 1e-6)), centre / np.linalg.norm(centre)


def decoding_errors(predictions: Predictions) -> list[tuple[float, float]]:
    """Return the differences in log peak and angle between the decoder's input and its dome."""
    if predictions.dome is None:
        return []
    errors = []
    for upper, peak, fed in zip(
        predictions.dome, predictions.log_peak, predictions.direction, strict=True
    ):
        found, spot = brightest_spot(upper)
        angle = angles_deg(spot[None], fed[None].astype(np.float64))[0]
        errors.append((abs(found - float(peak)), float(angle)))
    return errors


def _log_sky_rmse(pairs: Sequence[tuple[LightingBatch, Predictions]]) -> float:
    squares = []
    for batch, predictions in pairs:
        if predictions.dome is None:
            return math.nan
        rows = batch.sky.shape[1]
        weight = solid_angles_sr(2 * rows)[:rows, :, None]
        # The offset limits the influence of dark pixels; the median luminance of a sky is near 1.
        error = (np.log(predictions.dome + 0.02) - np.log(batch.sky + 0.02)) ** 2
        # Weights of mean 1 are proportional to the solid angle.
        squares.append((error * weight / weight.mean()).mean(axis=(1, 2, 3)))
    return float(np.sqrt(np.concatenate(squares).mean()))


def _sun_is_seen(batch: LightingBatch) -> Bool[np.ndarray, " n"]:
    """Return True where the pixel at the sun shows sky and was observed by a camera."""
    height, width = batch.visibility.shape[1:]
    uv = uv_from_directions(batch.sun_direction)
    # The sun is above the horizon, hence the limit of half the rows.
    row = np.minimum((uv[:, 1] * height).astype(np.int64), height // 2 - 1)
    column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
    index = np.arange(len(row))
    return batch.visibility[index, row, column] & batch.sky_seen[index, row, column]


def _constant(known: Sequence[LightingBatch], count: int) -> Predictions:
    """Return the mean sun and the median peak of the training data, for every panorama."""
    direction = np.concatenate([b.sun_direction[b.is_sunny] for b in known]).mean(axis=0)
    direction = (direction / np.linalg.norm(direction)).astype(np.float32)
    peak = float(np.median(np.concatenate([b.log_peak for b in known])))
    silent = np.full(count, np.nan)
    prediction = np.tile(direction, (count, 1))
    return Predictions(prediction, silent, np.full(count, peak), silent, silent, None)


def brightest_pixel(batch: LightingBatch) -> Predictions:
    """Return the centroid of the brightest observed pixels of the upper half, as the sun.

    The log peak is 0, the clipping value of the camera.
    """
    rows = batch.panorama.shape[1] // 2
    directions = pixel_directions(2 * rows)[:rows]
    value = luminance(batch.panorama[:, :rows]) * batch.visibility[:, :rows]
    # Pixels within 1e-4 of the maximum: all clipped ones, in practice.
    brightest = value >= value.max(axis=(1, 2), keepdims=True) - 1e-4
    centre = np.einsum("nrw,rwc,rk->nc", brightest, directions, solid_angles_sr(2 * rows)[:rows])
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    silent = np.full(len(centre), np.nan)
    return Predictions(
        centre.astype(np.float32), silent, np.zeros(len(centre)), silent, silent, None
    )


def _median(values: np.ndarray, counts: Bool[np.ndarray, " n"]) -> float:
    return float(np.median(values[counts])) if counts.any() else math.nan


def _mean(values: np.ndarray, counts: Bool[np.ndarray, " n"]) -> float:
    return float(values[counts].mean()) if counts.any() else math.nan
