"""Batches of the relighting networks: augmented crops of frames under source and target sky."""

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
    brightened,
    exposed,
    identity_pair,
    joined,
    mirrored,
    recorded_light,
    rendered_pair,
    true_pair,
    with_exact_estimate,
    with_light_error,
)

# Number of memory-mapped sample files; each stays open, and many systems allow 1024 per process.
_OPEN_FILES = 512
# Largest fraction of the free CUDA memory for the frames; the rest is for the training. Not
# measured.
_MAX_DEVICE_FRACTION = 0.6
_FIRST, _SECOND = "first", "second"
_CPU = torch.device("cpu")
_Kind = Literal["sim-real", "sim-sim", "true-twin", "identity", "true"]


@dataclass(frozen=True)
class RelightDataConfig:
    """Cropping and augmentation of the frames, and the mixture of the kinds of pairs."""

    batch: int = 8
    """Crops per step: many small crops of many frames train faster than a few large ones."""
    crop_px: tuple[int, int] = (96, 96)
    """Largest rows and columns of a crop; a smaller picture is used whole."""
    identity_fraction: float = 0.05
    """Fraction of the samples whose target is their source."""
    sim_sim_fraction: float = 0.0
    """Fraction of the samples whose source and target are renderings of the twin (paper, Sec.
    4)."""
    sim_real_fraction: float = 0.0
    """Fraction of the samples whose source is a rendering of the twin, and target the recording."""
    true_twin_fraction: float = 0.1
    """Fraction of samples that are pairs of renderings with an error-free physical estimate. A
    network that is trained only on twins with errors also changes correct estimates."""
    intensity_ev: tuple[float, float] = (0.0, 0.0)
    """Range of a random factor on the light of a target sky, in stops, for pairs of renderings."""
    exposure_ev: tuple[float, float] = (-3.0, 0.5)
    """Range of the change of exposure, in stops; mostly negative, because evening logs and shaded
    streets are darker than most generated streets."""
    light_error_ev: float = 0.2
    """Standard deviation of a random error of the target light and estimate, in stops. The errors
    of twins differ by street; a network would memorise those of the few training streets."""
    paint_ev: tuple[float, float] = (0.25, 0.1)
    """Standard deviations of a random factor on the base colour, in stops: common to the channels,
    and by channel. Without it a network memorises the mean base colour of generated streets, and
    attributes any other mean to an error of the light."""

    @property
    def true_fraction(self) -> float:
        """Fraction of the samples whose source and target are pictures with a known truth."""
        others = self.identity_fraction + self.sim_sim_fraction + self.sim_real_fraction
        # Rounded, so that the remainder is exactly 0 if the other fractions sum to 1.
        return max(0.0, round(1.0 - others - self.true_twin_fraction, 9))


@dataclass(frozen=True, eq=False)
class _Draw:
    """Crop of a frame, and the pair to make of it.

    Args:
        skies: names of the pair's skies; None is the recorded one.
        intensities: factors on the light of both skies; the recorded one is unchanged.
    """

    kind: _Kind
    frame: Views
    window: tuple[slice, slice]
    skies: tuple[str | None, str | None]
    intensities: tuple[float, float] = (1.0, 1.0)


class RelightData:
    """Frames of folders of samples, each under all its target skies.

    Args:
        folders: folders of streets, written by `lightsim train prepare relight`.
        device: device of the batches. On the CPU, crops are read from memory-mapped files; CUDA
            memory holds all frames in half precision (50 MB each under ten skies).

    Raises:
        InputError: the folders contain no samples.
    """

    def __init__(
        self, folders: Sequence[Path], config: RelightDataConfig, device: torch.device = _CPU
    ) -> None:
        self.files = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
        self.device = device
        """Device of the batches."""
        self._config, self._folders = config, tuple(folders)
        if not self.files:
            raise InputError(
                "the folders contain no relighting samples",
                where=", ".join(str(folder) for folder in folders),
                remedy="Make them with lightsim train prepare relight.",
            )
        self._read = lru_cache(_OPEN_FILES if device == _CPU else None)(self._loaded)

    def __len__(self) -> int:
        return len(self.files)

    def on(self, device: torch.device) -> RelightData:
        """Return the frames on a device, or unchanged where they would fill most of its memory."""
        if device.type != "cuda":
            return self
        size = sum(file.stat().st_size for file in self.files)
        # File size is a close estimate, as the samples are not compressed.
        is_small = size < _MAX_DEVICE_FRACTION * torch.cuda.mem_get_info(device)[0]
        return RelightData(self._folders, self._config, device) if is_small else self

    @property
    def has_truth(self) -> bool:
        """True if some frame has a true picture under a target sky."""
        return any(_with_truth(self._read(file)) for file in self.files)

    @property
    def sky_names(self) -> list[str]:
        """Names of the target skies of all frames, sorted."""
        return sorted({name for file in self.files for name in self._read(file).targets})

    def whole(self, index: int, sky: str | None) -> RelightBatch:
        """Return one whole frame without augmentation, under a sky; None: the recorded sky."""
        frame = self._read(self.files[index])
        scene = _stacked([frame.scene])
        if sky is None:
            return identity_pair(Views(scene, {}))
        return true_pair(Views(scene, {sky: _stacked([frame.targets[sky]])}), sky)

    def skies(self, index: int) -> list[str]:
        """Return the target skies of a frame for which the true picture is known."""
        return _with_truth(self._read(self.files[index]))

    def batch(self, draw: int, seed: int) -> RelightBatch:
        """Return the batch of a draw number; it depends on the seed and this number alone."""
        rng = np.random.default_rng([seed, draw])
        # The training loop may have enabled mixed precision; the augmentation needs full precision.
        with torch.no_grad(), torch.autocast(self.device.type, enabled=False):
            return self._batch(rng)

    def _batch(self, rng: np.random.Generator) -> RelightBatch:
        draws = [self._draw(rng) for _ in range(self._config.batch)]
        # Samples of one kind are built together, then put back into the order of the draws.
        order, parts = [], []
        for kind in get_args(_Kind):
            own = [k for k, one in enumerate(draws) if one.kind == kind]
            if own:
                order += own
                parts.append(_pair(kind, [draws[k] for k in own]))
        back = torch.from_numpy(np.argsort(order)).to(self.device)
        return self._varied(joined(parts).taken(back), rng)

    def _loaded(self, path: Path) -> Views:
        """Load a frame in half precision, with a leading axis of length one."""
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

    def _draw(self, rng: np.random.Generator) -> _Draw:
        frame = self._read(self.files[int(rng.integers(len(self.files)))])
        window = []
        size = frame.scene["source"].shape[-2:]
        for length, crop in zip(size, self._config.crop_px, strict=True):
            at = int(rng.integers(max(length - crop, 0) + 1))
            window.append(slice(at, at + crop))
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
            # The recorded sky is as likely as each target sky, at either end of the pair.
            is_recorded = rng.random(2) < 1 / (len(skies) + 1)
            ends = (None if is_recorded[0] else first, None if is_recorded[1] else second)
        if kind == "true":
            # A frame without any true picture becomes an identity pair.
            known = _with_truth(frame)
            kind = "true" if known else "identity"
            ends = (known[int(rng.integers(len(known)))] if known else None, None)
        least, most = config.intensity_ev
        intensities = (1.0, 1.0)
        if kind in ("sim-real", "sim-sim") and most > least:
            drawn = 2.0 ** rng.uniform(least, most, 2)
            intensities = (float(drawn[0]), float(drawn[1]))
        rows, columns = window
        return _Draw(kind, frame, (rows, columns), ends, intensities)

    def _varied(self, batch: RelightBatch, rng: np.random.Generator) -> RelightBatch:
        config, count = self._config, len(batch.truth)

        def of_each(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values.reshape(-1, 1, 1, 1)).to(batch.truth)

        is_mirrored = of_each(rng.random(count)) < 0.5
        # All random numbers are drawn in a fixed order, whether or not a plane uses them.
        error_ev = rng.normal(size=count) * config.light_error_ev
        lighter, tint = config.paint_ev
        paint_ev = lighter * rng.normal(size=(count, 1)) + tint * rng.normal(size=(count, 3))
        exposure_ev = rng.uniform(*config.exposure_ev, count)
        batch = mirrored(batch, is_mirrored)
        if "target_physical" in batch.planes:
            batch = with_light_error(batch, of_each(2.0**error_ev))
        return exposed(batch, of_each(2.0**exposure_ev), 2.0**paint_ev)


def _with_truth(frame: Views) -> list[str]:
    return [name for name, planes in frame.targets.items() if TRUTH in planes]


def _pair(kind: _Kind, draws: Sequence[_Draw]) -> RelightBatch:
    """Build the batch of crops of one kind of pair."""
    cut = [_cut(one.frame.scene, one.window) for one in draws]
    scene = _stacked(cut)
    if kind == "identity":
        return identity_pair(Views(scene, {}))

    def light(which: int) -> dict[str, Tensor]:
        """Return the light planes of the pairs' first (0) or second (1) sky."""
        own = []
        for part, one in zip(cut, draws, strict=True):
            sky = one.skies[which]
            own.append(
                recorded_light(part) if sky is None else _cut(one.frame.targets[sky], one.window)
            )
        names = [name for name in own[0] if all(name in planes for planes in own)]
        stacked = _stacked([{name: planes[name] for name in names} for planes in own])
        factors = [1.0 if one.skies[which] is None else one.intensities[which] for one in draws]
        return brightened(stacked, torch.tensor(factors).reshape(-1, 1, 1, 1).to(scene["source"]))

    if kind == "true":
        return true_pair(Views(scene, {_FIRST: light(0)}), _FIRST)
    if kind == "sim-real":
        return rendered_pair(Views(scene, {_FIRST: light(0)}), _FIRST, None)
    views = Views(scene, {_FIRST: light(0), _SECOND: light(1)})
    one = rendered_pair(views, _FIRST, _SECOND, is_real=False)
    return with_exact_estimate(one) if kind == "true-twin" else one


def _cut(planes: dict[str, Tensor], window: tuple[slice, slice]) -> dict[str, Tensor]:
    """Crop the planes; sky domes and the brightness of the whole frame are unchanged."""
    whole = (OF_SKIES, LEVEL)
    return {
        name: value if name.endswith(whole) else value[..., window[0], window[1]]
        for name, value in planes.items()
    }


def _stacked(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Concatenate planes in single precision; 8-bit codes become values in [0, 1]."""
    stacked = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return {
        name: value / 255.0 if value.dtype == torch.uint8 else value.float()
        for name, value in stacked.items()
    }
