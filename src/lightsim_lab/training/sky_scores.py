"""Scores of sky networks on one set of panoramas, beside what needs no network (paper, appendix,
table of comparisons of sky dome estimation)."""

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

_CREDIBLE = 0.9


@runtime_checkable
class SkyModel(Protocol):
    """A network that is scored: `SkyNetwork` and those of baselines/."""

    @property
    def composes_sun(self) -> bool:
        """The sun is put into the dome, so that only the pixel grid makes decoding errors."""
        ...

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """What the network says of each panorama of a batch."""
        ...

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Tensor:
        """Linear radiance of the upper half [n, 3, h / 2, w], with this sun in it."""
        ...


@dataclass(frozen=True)
class SkyScore:
    """One row of the table; NaN where a method does not say it or no sample counts.

    Args:
        name: of the method.
        count: panoramas; those under a clear sun are `sunny_count`.
        angle_mean_deg: error of the sun's direction, clear suns.
        angle_median_deg: the same.
        angle_seen_deg: mean where a camera saw the clear sun.
        angle_hidden_deg: mean where none did.
        angle_hidden_median_deg: median where none did.
        log_peak_error: mean of the absolute error, all skies.
        sunny_accuracy: fraction of right answers to whether the sun is clear.
        decoding_log_peak: mean |log peak of the dome - the one fed|, all skies.
        decoding_angle_deg: mean angle between the dome's brightest spot and the direction fed.
        inside_90: fraction of clear suns within the 90 % cone of the predicted density.
        peak_inside_90: fraction of peaks within the 90 % interval.
        log_sky_rmse: of the dome against the truth in natural log radiance, by solid angle.
        composes_sun: the decoding errors are those of the pixel grid.
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
    """Rows of the networks and of two baselines, all on the same panoramas.

    Args:
        batches: what is scored; panoramas are shown as the cameras saw them, then completed.
        models: by the names of their rows.
        known: training data, whose mean sun and median peak make the constant answer.
        complete: as in training.
    """
    rows = [
        score_answers("constant", batches, [_constant(known, len(b.log_peak)) for b in batches]),
        score_answers("brightest pixel", batches, [brightest_pixel(b) for b in batches]),
    ]
    for name, model in models.items():
        answers = [answer_of(model, batch, complete) for batch in batches]
        rows.append(score_answers(name, batches, answers))
    return rows


def parts_of(batch: LightingBatch, size: int) -> list[LightingBatch]:
    """A large batch in parts of at most `size` panoramas."""
    count = len(batch.log_peak)
    return [
        LightingBatch(**{f.name: getattr(batch, f.name)[k : k + size] for f in fields(batch)})
        for k in range(0, count, size)
    ]


@dataclass(frozen=True, eq=False)
class Answers:
    """What a method says of a batch; NaN where it does not say it.

    Args:
        direction: unit vectors.
        cone_deg: half angle of the 90 % cone.
        log_peak: of the dome.
        peak_margin: half width of its 90 % interval.
        sunny: probability.
        dome: upper halves, None for methods without one.
        composes_sun: see `SkyModel`.
    """

    direction: Float32[np.ndarray, "n 3"]
    cone_deg: Float[np.ndarray, " n"]
    log_peak: Float[np.ndarray, " n"]
    peak_margin: Float[np.ndarray, " n"]
    sunny: Float[np.ndarray, " n"]
    dome: Float32[np.ndarray, "n r w 3"] | None
    composes_sun: bool = False


def answer_of(model: SkyModel, batch: LightingBatch, complete: Completion | None) -> Answers:
    """A network's answers, its dome decoded from its own sun."""
    count = len(batch.log_peak)
    device = device_of(model) if isinstance(model, torch.nn.Module) else "cpu"
    tensors = sky_tensors(batch, np.zeros(count, bool), complete, torch.device(device))
    with torch.no_grad():
        predicted = model.encode(tensors)
        dome = model.dome(tensors, predicted, predicted.direction, predicted.log_peak)
    silent = np.full(count, np.nan)
    kappa, scale, sunny = (
        predicted.log_concentration,
        predicted.log_peak_scale,
        predicted.sunny_logit,
    )
    return Answers(
        predicted.direction.cpu().numpy().astype(np.float32),
        silent if kappa is None else credible_cone_deg(kappa.exp().cpu().numpy(), _CREDIBLE),
        predicted.log_peak.cpu().numpy(),
        # The 90 % interval of a Laplace density.
        silent if scale is None else scale.exp().cpu().numpy() * -math.log(1 - _CREDIBLE),
        silent if sunny is None else torch.sigmoid(sunny).cpu().numpy(),
        np.moveaxis(dome.cpu().numpy(), 1, -1).astype(np.float32),
        model.composes_sun,
    )


def score_answers(
    name: str, batches: Sequence[LightingBatch], answers: Sequence[Answers]
) -> SkyScore:
    """One row from all batches."""
    pairs = list(zip(batches, answers, strict=True))
    angle = np.concatenate([angles_deg(a.direction, b.sun_direction) for b, a in pairs])
    sunny = np.concatenate([b.is_sunny for b in batches])
    seen = np.concatenate([_sun_is_seen(b) for b in batches])
    peak = np.concatenate([np.abs(a.log_peak - b.log_peak) for b, a in pairs])
    margin = np.concatenate([a.peak_margin for a in answers])
    cone = np.concatenate([a.cone_deg for a in answers])
    predicted = np.concatenate([a.sunny for a in answers])
    decoded = np.array([d for a in answers for d in decoding_errors(a)]).reshape(-1, 2)
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
        composes_sun=any(a.composes_sun for a in answers),
    )


def angles_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Angle between the directions of each row, accurate for small angles too."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))


def credible_cone_deg(
    concentration: Float[np.ndarray, " n"], fraction: float
) -> Float[np.ndarray, " n"]:
    """Half angle of the cone that holds a fraction of a von Mises-Fisher density.

    The fraction within cos >= c is (1 - exp(-kappa (1 - c))) / (1 - exp(-2 kappa)), solved for c.
    """
    kappa = concentration.astype(np.float64)
    cosine = 1.0 + np.log(1 - fraction * -np.expm1(-2 * kappa)) / kappa
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def brightest_spot(upper: Float32[np.ndarray, "r w 3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """Log luminance of the brightest pixel, and the centroid of the spot around it."""
    rows = len(upper)
    value = luminance(upper).astype(np.float64)
    directions = pixel_directions(2 * rows)[:rows]
    row, column = np.unravel_index(int(value.argmax()), value.shape)
    near = directions @ directions[row, column] >= math.cos(math.radians(1.6 * 90.0 / rows))
    ring = float(np.median(value[near]))
    weight = np.where(near, np.maximum(value - ring, 0.0), 0.0) * solid_angles_sr(2 * rows)[:rows]
    if weight.sum() <= 0:
        return math.log(max(float(value[row, column]), 1e-6)), directions[row, column]
    centre = np.einsum("rw,rwc->c", weight, directions)
    return math.log(max(float(value[row, column]), 1e-6)), centre / np.linalg.norm(centre)


def decoding_errors(answers: Answers) -> list[tuple[float, float]]:
    """(log peak, angle) between what was fed to the decoder and what its dome shows."""
    if answers.dome is None:
        return []
    errors = []
    for upper, peak, fed in zip(answers.dome, answers.log_peak, answers.direction, strict=True):
        found, spot = brightest_spot(upper)
        angle = angles_deg(spot[None], fed[None].astype(np.float64))[0]
        errors.append((abs(found - float(peak)), float(angle)))
    return errors


def _log_sky_rmse(pairs: Sequence[tuple[LightingBatch, Answers]]) -> float:
    squares = []
    for batch, answers in pairs:
        if answers.dome is None:
            return math.nan
        rows = batch.sky.shape[1]
        weight = solid_angles_sr(2 * rows)[:rows, :, None]
        error = (np.log(answers.dome + 0.02) - np.log(batch.sky + 0.02)) ** 2
        squares.append((error * weight / weight.mean()).mean(axis=(1, 2, 3)))
    return float(np.sqrt(np.concatenate(squares).mean()))


def _sun_is_seen(batch: LightingBatch) -> Bool[np.ndarray, " n"]:
    """Where a camera saw the sky at the sun."""
    height, width = batch.visibility.shape[1:]
    uv = uv_from_directions(batch.sun_direction)
    row = np.minimum((uv[:, 1] * height).astype(np.int64), height // 2 - 1)
    column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
    index = np.arange(len(row))
    return batch.visibility[index, row, column] & batch.sky_seen[index, row, column]


def _constant(known: Sequence[LightingBatch], count: int) -> Answers:
    """The mean sun and the median peak of the training data."""
    direction = np.concatenate([b.sun_direction[b.is_sunny] for b in known]).mean(axis=0)
    direction = (direction / np.linalg.norm(direction)).astype(np.float32)
    peak = float(np.median(np.concatenate([b.log_peak for b in known])))
    silent = np.full(count, np.nan)
    answer = np.tile(direction, (count, 1))
    return Answers(answer, silent, np.full(count, peak), silent, silent, None)


def brightest_pixel(batch: LightingBatch) -> Answers:
    """The centroid of the brightest pixels of what was seen of the upper half; peak: clipping."""
    rows = batch.panorama.shape[1] // 2
    directions = pixel_directions(2 * rows)[:rows]
    value = luminance(batch.panorama[:, :rows]) * batch.visibility[:, :rows]
    brightest = value >= value.max(axis=(1, 2), keepdims=True) - 1e-4
    centre = np.einsum("nrw,rwc,rk->nc", brightest, directions, solid_angles_sr(2 * rows)[:rows])
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    silent = np.full(len(centre), np.nan)
    return Answers(centre.astype(np.float32), silent, np.zeros(len(centre)), silent, silent, None)


def _median(values: np.ndarray, counts: Bool[np.ndarray, " n"]) -> float:
    return float(np.median(values[counts])) if counts.any() else math.nan


def _mean(values: np.ndarray, counts: Bool[np.ndarray, " n"]) -> float:
    return float(values[counts].mean()) if counts.any() else math.nan
