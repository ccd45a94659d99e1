"""Batches of the relighting networks: crops of frames under source and target sky, varied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from lightsim.errors import InputError
from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import level, linear_of
from lightsim_lab.training.relight_cache import read_sample
from lightsim_lab.training.relight_pairs import (
    LEVEL,
    TRUTH,
    RelightBatch,
    Views,
    exposed,
    identity_pair,
    joined,
    mirrored,
    misjudged,
    recorded_light,
    rendered_pair,
    true_pair,
    with_exact_estimate,
    zoomed,
)

_OPEN_FILES = 512
"""Each file that is mapped stays open; systems often allow 1024."""
_MOST_OF_DEVICE = 0.6
"""Of its free memory that frames may take: the rest is for what learns from them."""
_FIRST, _SECOND = "first", "second"
_CPU = torch.device("cpu")
_Kind = Literal["sim-real", "sim-sim", "true-twin", "identity", "true"]


@dataclass(frozen=True)
class RelightDataConfig:
    """How frames are shown."""

    batch: int = 8
    """Crops a step: many small ones of many frames learn faster than a large one."""
    crop_px: tuple[int, int] = (96, 96)
    """Rows and columns of a crop, at most; a smaller picture is shown whole."""
    zooms: tuple[float, ...] = (1.0,)
    """All crops of a step are magnified by one of these: cameras have other focal lengths, and
    streets are few."""
    identity_fraction: float = 0.05
    """Of the samples: their target is the source itself."""
    sim_sim_fraction: float = 0.0
    """Of the samples: the twin rendered under one sky, and under another (paper, Sec. 4)."""
    sim_real_fraction: float = 0.0
    """Of the samples: the twin rendered under another sky, and the recorded picture."""
    true_twin_fraction: float = 0.1
    """Of the samples: the same, beside a physical estimate without an error. All twins of streets
    have the errors of streets, and a network that meets no others mends what is right."""
    exposure_ev: tuple[float, float] = (-3.0, 0.5)
    """Samples are so many stops brighter: a log of the evening, or a street in the shade of a high
    sun, is darker than most that the generator makes."""
    light_error_ev: float = 0.2
    """Standard deviation by which target light and estimate are off: twins err by street, and a
    network that has seen few of them would learn their errors instead of doubting them."""
    paint_ev: tuple[float, float] = (0.25, 0.1)
    """Standard deviations by which all surfaces are lighter, and each channel of them: streets of
    one generator are as light as it makes them, and a network that knows how light that is takes
    any other street for one whose light was found wrong."""


@dataclass(frozen=True, eq=False)
class _Draw:
    """A crop of a frame, and what becomes of it.

    Args:
        skies: that it is a pair of; None is the recorded one.
    """

    kind: _Kind
    frame: Views
    window: tuple[slice, slice]
    skies: tuple[str | None, str | None]


class RelightData:
    """Frames of some folders of samples, each under all its target skies.

    Args:
        folders: of streets, as `lightsim train prepare relight` wrote them.
        device: where batches are made. A processor reads what crops need from files; CUDA keeps all
            frames in half precision (50 MB each under ten skies).
    """

    def __init__(
        self, folders: Sequence[Path], config: RelightDataConfig, device: torch.device = _CPU
    ) -> None:
        self.files = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
        self.device = device
        """Where batches are made."""
        self._config, self._folders = config, tuple(folders)
        if not self.files:
            raise InputError(
                "there are no samples of relighting",
                where=", ".join(str(folder) for folder in folders),
                remedy="Make them with lightsim train prepare relight.",
            )
        self._read = lru_cache(_OPEN_FILES if device == _CPU else None)(self._loaded)

    def __len__(self) -> int:
        return len(self.files)

    def on(self, device: torch.device) -> RelightData:
        """The same frames on a device; where they would fill most of its memory, as they are."""
        if device.type != "cuda":
            return self
        size = sum(file.stat().st_size for file in self.files)
        is_small = size < _MOST_OF_DEVICE * torch.cuda.mem_get_info(device)[0]
        return RelightData(self._folders, self._config, device) if is_small else self

    @property
    def sky_names(self) -> list[str]:
        """All target skies of all frames."""
        return sorted({name for file in self.files for name in self._read(file).targets})

    def whole(self, index: int, sky: str | None) -> RelightBatch:
        """One frame as it is, under one of its skies; None: as it was recorded."""
        frame = self._read(self.files[index])
        scene = _stacked([frame.scene])
        if sky is None:
            return identity_pair(Views(scene, {}))
        return true_pair(Views(scene, {sky: _stacked([frame.targets[sky]])}), sky)

    def skies(self, index: int) -> list[str]:
        """Target skies of a frame whose truth is known."""
        return _with_truth(self._read(self.files[index]))

    def batch(self, draw: int, seed: int) -> RelightBatch:
        """The crops of a draw; they depend on nothing else."""
        rng = np.random.default_rng([seed, draw])
        # Whatever learns from it computes in mixed precision, perhaps.
        with torch.no_grad(), torch.autocast(self.device.type, enabled=False):
            return self._batch(rng)

    def _batch(self, rng: np.random.Generator) -> RelightBatch:
        zooms = self._config.zooms
        zoom = zooms[int(rng.integers(len(zooms))) if len(zooms) > 1 else 0]
        draws = [self._draw(rng, zoom) for _ in range(self._config.batch)]
        order, parts = [], []
        for kind in get_args(_Kind):
            own = [k for k, one in enumerate(draws) if one.kind == kind]
            if own:
                order += own
                parts.append(_pair(kind, [draws[k] for k in own]))
        back = torch.from_numpy(np.argsort(order)).to(self.device)
        batch = joined(parts).taken(back)
        if zoom != 1:
            rows, columns = batch.truth.shape[-2:]
            batch = zoomed(batch, (round(rows * zoom), round(columns * zoom)))
        return self._varied(batch, rng)

    def _loaded(self, path: Path) -> Views:
        """A frame in half precision, with a leading axis of one."""
        sample = read_sample(path)
        scene = self._placed(sample.scene)
        surface = scene["surface"].float()

        def brightness(linear: Tensor) -> Tensor:
            return level({"surface": surface, "target_physical": linear})

        scene[f"source{LEVEL}"] = brightness(linear_of(scene["source"].float()))
        targets = {}
        for sky, target in sample.targets.items():
            targets[sky] = planes = self._placed(target.planes)
            planes[f"target{LEVEL}"] = brightness(planes["target_physical"].float())
            if target.truth is not None:
                planes |= self._placed({TRUTH: target.truth})
        return Views(scene, targets)

    def _placed(self, planes: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
        return {k: torch.from_numpy(v)[None].to(self.device) for k, v in planes.items()}

    def _draw(self, rng: np.random.Generator, zoom: float) -> _Draw:
        frame = self._read(self.files[int(rng.integers(len(self.files)))])
        window = []
        size = frame.scene["source"].shape[-2:]
        for length, crop in zip(size, self._config.crop_px, strict=True):
            part = round(crop / zoom)
            at = int(rng.integers(max(length - part, 0) + 1))
            window.append(slice(at, at + part))
        config, skies = self._config, list(frame.targets)
        fractions = (
            config.sim_real_fraction,
            config.sim_sim_fraction,
            config.true_twin_fraction,
            config.identity_fraction,
        )
        number = int(np.searchsorted(np.cumsum(fractions), rng.random(), side="right"))
        kind: _Kind = get_args(_Kind)[number]
        first, second = (skies[int(rng.integers(len(skies)))] for _ in range(2))
        ends: tuple[str | None, str | None] = (first, None)
        if kind in ("sim-sim", "true-twin"):
            # Any of all skies, the recorded one among them, may be either.
            is_recorded = rng.random(2) < 1 / (len(skies) + 1)
            ends = (None if is_recorded[0] else first, None if is_recorded[1] else second)
        if kind == "true":
            known = _with_truth(frame)
            kind = "true" if known else "identity"
            ends = (known[int(rng.integers(len(known)))] if known else None, None)
        rows, columns = window
        return _Draw(kind, frame, (rows, columns), ends)

    def _varied(self, batch: RelightBatch, rng: np.random.Generator) -> RelightBatch:
        config, count = self._config, len(batch.truth)

        def of_each(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values.reshape(-1, 1, 1, 1)).to(batch.truth)

        is_mirrored = of_each(rng.random(count)) < 0.5
        error_ev = rng.normal(size=count) * config.light_error_ev
        lighter, tint = config.paint_ev
        paint_ev = lighter * rng.normal(size=(count, 1)) + tint * rng.normal(size=(count, 3))
        exposure_ev = rng.uniform(*config.exposure_ev, count)
        batch = mirrored(batch, is_mirrored)
        if "target_physical" in batch.planes:
            batch = misjudged(batch, of_each(2.0**error_ev))
        return exposed(batch, of_each(2.0**exposure_ev), 2.0**paint_ev)


def _with_truth(frame: Views) -> list[str]:
    return [name for name, planes in frame.targets.items() if TRUTH in planes]


def _pair(kind: _Kind, draws: Sequence[_Draw]) -> RelightBatch:
    """Crops with a source and a target, all of one kind."""
    cut = [_cut(one.frame.scene, one.window) for one in draws]
    scene = _stacked(cut)
    if kind == "identity":
        return identity_pair(Views(scene, {}))

    def light(which: int) -> dict[str, Tensor]:
        """One end of the pairs, of the recorded sky where that is it."""
        own = []
        for part, one in zip(cut, draws, strict=True):
            sky = one.skies[which]
            own.append(
                recorded_light(part) if sky is None else _cut(one.frame.targets[sky], one.window)
            )
        names = [name for name in own[0] if all(name in planes for planes in own)]
        return _stacked([{name: planes[name] for name in names} for planes in own])

    if kind == "true":
        return true_pair(Views(scene, {_FIRST: light(0)}), _FIRST)
    if kind == "sim-real":
        return rendered_pair(Views(scene, {_FIRST: light(0)}), _FIRST, None)
    views = Views(scene, {_FIRST: light(0), _SECOND: light(1)})
    one = rendered_pair(views, _FIRST, _SECOND, is_real=False)
    return with_exact_estimate(one) if kind == "true-twin" else one


def _cut(planes: dict[str, Tensor], window: tuple[slice, slice]) -> dict[str, Tensor]:
    """A part of the picture, domes whole, which knows how bright the whole is."""
    whole = (OF_SKIES, LEVEL)
    return {
        name: value if name.endswith(whole) else value[..., window[0], window[1]]
        for name, value in planes.items()
    }


def _stacked(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """In single precision, codes of 8 bits from 0 to 1."""
    stacked = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return {
        name: value / 255.0 if value.dtype == torch.uint8 else value.float()
        for name, value in stacked.items()
    }
