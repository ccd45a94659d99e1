"""Comparison of sky networks on built logs with the sun by GPS and time (table A4 of the paper)."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from lightsim.build.workspace import Workspace
from lightsim.core.colour import linear_from_srgb8, srgb_from_linear
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.solar import angle_between_deg, direction_world
from lightsim.errors import InputError
from lightsim.lighting.panorama.complete import exposed_ldr
from lightsim.lighting.panorama.inpaint import downsample_observed
from lightsim.lighting.sample import LightingBatch
from lightsim.lighting.sky.sky_terms import SkyEncoding, SkyTensors
from lightsim.lighting.weights import INPAINT_WEIGHTS, SKY_WEIGHTS
from lightsim.networks.stored import is_stored
from lightsim.store.weights import load_weights, read_record, read_weights
from lightsim_lab.training.run import completion_of
from lightsim_lab.training.sky import Completion
from lightsim_lab.training.sky_models import network_of
from lightsim_lab.training.sky_scores import (
    Predictions,
    SkyModel,
    angles_deg,
    brightest_pixel,
    decoding_errors,
    prediction_of,
)

_LOGGER = logging.getLogger(__name__)
# Rows of the input panoramas, as in the training data; networks of other sizes resize them.
_ROWS = 64
# Rows and columns of the input front picture, as in the training data.
_FRONT_PX = (40, 64)


@dataclass(frozen=True)
class NetworkRow:
    """Errors of one method over the logs; None where the method has no such output.

    Args:
        name: name of the method.
        angle_mean_deg, angle_median_deg: angle between its sun and the sun by GPS and time.
        decoding_log_peak: mean |log peak of the dome - log peak at the decoder's input|.
        decoding_angle_deg: mean angle between the dome's brightest spot and the input direction.
        composes_sun: the sun is composed into the dome, so decoding errors are those of the pixel
            grid.
    """

    name: str
    angle_mean_deg: float | None
    angle_median_deg: float | None
    decoding_log_peak: float | None
    decoding_angle_deg: float | None
    composes_sun: bool


@dataclass(frozen=True)
class NetworksReport:
    """Rows of table A4.

    Args:
        logs: compared logs.
        left_out: omitted logs with the reason.
        rows: one row per method.
    """

    logs: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[NetworkRow, ...]

    def to_table(self) -> str:
        """Return the report as Markdown."""
        lines = [
            "| method | sun angle, mean / median deg | decoding log peak | decoding deg |",
            "|---|---:|---:|---:|",
        ]
        for row in self.rows:
            decoding = [_cell(row.decoding_log_peak), _cell(row.decoding_angle_deg)]
            if row.composes_sun:
                decoding = [f"composed, {cell}" for cell in decoding]
            angle = f"{_cell(row.angle_mean_deg)} / {_cell(row.angle_median_deg)}"
            lines.append(f"| {row.name} | {angle} | {' | '.join(decoding)} |")
        lines += ["", f"{len(self.logs)} logs: {', '.join(self.logs)}"]
        return "\n".join(lines + [f"left out: {reason}" for reason in self.left_out])

    def to_json(self) -> str:
        """Return the report as JSON."""
        return json.dumps(asdict(self), indent=2)


def compare_sky_networks(logs: Sequence[Workspace], runs: Path | None) -> NetworksReport:
    """Compare the shipped estimator, the networks of runs, and the built skies.

    Logs without GPS or with the sun below the horizon are omitted.

    Args:
        runs: folder of runs of `lightsim train`, each with weights.safetensors.

    Raises:
        InputError: no log has a sun by GPS, or the weights of a run are of no sky network.
    """
    batches: dict[str, LightingBatch] = {}
    built, left_out, origins = [], [], set[str]()
    for work in logs:
        try:
            towards = gps_sun(work.log)
        except InputError as error:
            left_out.append(f"{work.root}: {error}")
            continue
        batches[str(work.root)] = _batch(work, towards)
        sun = work.sky.dome.sun
        origins.add(work.sky.origin)
        built.append(np.nan if sun is None else angle_between_deg(sun.direction_world, towards))
    if not batches:
        raise InputError(
            "no log has a sun by GPS",
            got="; ".join(left_out),
            expected="a log with place, time and heading, by day",
        )
    rows = [_row("brightest pixel", batches, [brightest_pixel(b) for b in batches.values()])]
    for name, (model, complete) in named_networks(runs).items():
        predictions = [prediction_of(model, batch, complete) for batch in batches.values()]
        rows.append(_row(name, batches, predictions))
        known = [
            prediction_of(_KnownSun(model, batch.sun_direction), batch, complete)
            for batch in batches.values()
        ]
        rows.append(_row(f"{name}, with GPS", batches, known))
    built_name = f"built sky ({', '.join(sorted(origins))})"
    rows.append(NetworkRow(built_name, *_mean_median(np.array(built)), None, None, False))
    return NetworksReport(tuple(batches), tuple(left_out), tuple(rows))


def gps_sun(log: DrivingLog) -> Float[np.ndarray, "3"]:
    """Return the direction towards the sun in the middle of the log, by place and time, frame
    `world`.

    Raises:
        InputError: the log has no place or no heading, or the sun is below the horizon.
    """
    geo = log.geo
    at = None if geo is None else geo.sun_at(_middle_ns(log))
    if geo is None or geo.enu_from_world is None or at is None:
        raise InputError("the log has no sun by GPS", expected="place, time and heading")
    if at.elevation_deg <= 0:
        raise InputError(
            "the log was recorded at night",
            got=f"sun at {at.elevation_deg:.1f} degrees",
            expected="a sun above the horizon",
        )
    return direction_world(at.azimuth_deg, at.elevation_deg, geo.enu_from_world)


@dataclass(frozen=True, eq=False)
class _KnownSun:
    """Sky network whose estimated sun is replaced by a known one, as in the paper with GPS."""

    model: SkyModel
    direction: Float32[np.ndarray, "n 3"]

    @property
    def composes_sun(self) -> bool:
        """True if the sun is composed into the dome."""
        return self.model.composes_sun

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Return the network's encoding with the known sun."""
        return replace(self.model.encode(batch), direction=torch.from_numpy(self.direction))

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Tensor:
        """Decode the dome by the network."""
        return self.model.dome(batch, encoding, direction, log_peak)


def named_networks(runs: Path | None) -> dict[str, tuple[SkyModel, Completion | None]]:
    """Return the shipped network and those of runs by name, with their panorama completion.

    A network that was trained on completed panoramas uses the same completion, or the shipped one
    if that file no longer exists.

    Args:
        runs: folder of runs of `lightsim train`, each with weights.safetensors.

    Raises:
        InputError: the weights of a run are of no sky network.
    """
    found: dict[str, tuple[SkyModel, Completion | None]] = {
        "lightsim (shipped)": (network_of(load_weights(SKY_WEIGHTS)), None)  # type: ignore[dict-item]
    }
    for path in [] if runs is None else sorted(runs.glob("*/weights.safetensors")):
        tensors = read_weights(path)
        if is_stored(tensors):
            complete = _completion_behind(read_record(path).command)
            found[path.parent.name] = (network_of(tensors), complete)  # type: ignore[assignment]
    return found


def _completion_behind(command: str) -> Completion | None:
    """Return the panorama completion with which a command trained a network; None without one."""
    words = shlex.split(command)
    if "--inpaint" not in words:
        return None
    path = Path(words[words.index("--inpaint") + 1])
    if path.is_file():
        return completion_of(path)
    _LOGGER.warning("%s: no longer exists; the shipped completion replaces it", path)
    return completion_of(INPAINT_WEIGHTS)


def _batch(work: Workspace, sun_world: Float[np.ndarray, "3"]) -> LightingBatch:
    """Return the log's panorama and front picture as in the training data, with the ego vehicle's
    forward direction in the centre column."""
    log = work.log
    ldr, _ = exposed_ldr(work.panorama)
    small, seen = downsample_observed(ldr, work.panorama.is_seen, _ROWS)
    x, y, _ = log.ego.at(_middle_ns(log)).rotate(np.array([1.0, 0.0, 0.0]))
    # A panorama has 2 * _ROWS columns for 2 pi.
    columns = round(float(np.arctan2(y, x)) / np.pi * _ROWS)
    angle = -np.pi * columns / _ROWS
    # The sun direction turns with the columns.
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    nothing = np.zeros(1, np.float32)
    return LightingBatch(
        panorama=np.roll(small, columns, axis=1)[None],
        visibility=np.roll(seen, columns, axis=1)[None],
        front=_front(log, np.array([x, y, 0.0]))[None],
        sky=np.zeros((1, _ROWS // 2, 2 * _ROWS, 3), np.float32),
        sky_seen=np.ones((1, _ROWS // 2, 2 * _ROWS), bool),
        sun_direction=(turn @ sun_world).astype(np.float32)[None],
        log_peak=nothing,
        is_sunny=np.ones(1, bool),
    )


def _front(log: DrivingLog, forward_world: Float[np.ndarray, "3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return the middle frame of the forward camera, cropped at the centre and resized."""
    by_camera = {name: log.frames_of(name) for name in log.cameras}
    middles = [frames[len(frames) // 2] for frames in by_camera.values() if frames]
    axis = np.array([0.0, 0.0, 1.0])
    front = max(middles, key=lambda f: float(f.world_from_camera.rotate(axis) @ forward_world))
    picture = front.load_srgb8()
    rows, columns = _FRONT_PX
    width = min(picture.shape[1], picture.shape[0] * columns // rows)
    left = (picture.shape[1] - width) // 2
    linear = linear_from_srgb8(picture[:, left : left + width])
    return srgb_from_linear(resize_area(linear, rows, columns))


def _middle_ns(log: DrivingLog) -> int:
    return log.frames[len(log.frames) // 2].time_ns


def _row(
    name: str, batches: Mapping[str, LightingBatch], predictions: Sequence[Predictions]
) -> NetworkRow:
    angles = [
        angles_deg(prediction.direction, batch.sun_direction)
        for prediction, batch in zip(predictions, batches.values(), strict=True)
    ]
    decoded = np.array(
        [error for prediction in predictions for error in decoding_errors(prediction)]
    )
    peak, angle = decoded.mean(axis=0).tolist() if len(decoded) else (None, None)
    composes_sun = any(prediction.composes_sun for prediction in predictions)
    return NetworkRow(name, *_mean_median(np.concatenate(angles)), peak, angle, composes_sun)


def _mean_median(values: Float[np.ndarray, " n"]) -> tuple[float | None, float | None]:
    known = values[~np.isnan(values)]
    return (float(known.mean()), float(np.median(known))) if len(known) else (None, None)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
