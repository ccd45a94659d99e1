"""Batches of the relighting networks: crops of frames under source and target sky, varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lightsim.errors import InputError
from lightsim.relighting.network.channels import OF_SKIES, Planes
from lightsim.relighting.network.features import linear_of, rendered, srgb_of, tensors_of
from lightsim.training.relight_cache import RelightSample, RelightTargetSample, read_sample

_OPEN_FILES = 512
"""Each file that is mapped stays open; systems often allow 1024."""
_VECTORS = ("normal", "position")
_LEVEL = "_level"
"""End of the name of what a crop tells of its whole frame (`features.level`)."""
_RADIANT = ("shaded", "reflected", "physical", "sky", OF_SKIES, _LEVEL)
_PAINTED = ("reflected", "physical")
"""What grows with the colour of surfaces; mirrors do, so that the picture stays their sum."""
_CLIPPED = 254 / 255


@dataclass(frozen=True, eq=False)
class RelightBatch:
    """What a step learns from.

    Args:
        planes: of scene, source and target, each with a leading axis of samples.
        truth: sRGB in [0, 1].
        weight: 1 where a pixel counts.
    """

    planes: dict[str, Tensor]
    truth: Float[Tensor, "n 3 h w"]
    weight: Float[Tensor, "n 1 h w"]

    def on(self, device: torch.device) -> RelightBatch:
        """The same on a device."""
        planes = {name: value.to(device) for name, value in self.planes.items()}
        return RelightBatch(planes, self.truth.to(device), self.weight.to(device))


@dataclass(frozen=True)
class RelightDataConfig:
    """How frames are shown."""

    batch: int = 8
    """Crops a step: many small ones of many frames learn faster than a large one."""
    crop_px: tuple[int, int] = (96, 96)
    """Rows and columns of a crop, at most; a smaller picture is shown whole."""
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


class RelightData:
    """Frames of some folders of samples, each under all its target skies.

    Args:
        folders: of streets, as `lightsim train prepare relight` wrote them.
    """

    def __init__(self, folders: Sequence[Path], config: RelightDataConfig) -> None:
        self.files = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
        self._config = config
        if not self.files:
            raise InputError(
                "there are no samples of relighting",
                where=", ".join(str(folder) for folder in folders),
                remedy="Make them with lightsim train prepare relight.",
            )
        self._read = lru_cache(_OPEN_FILES)(read_sample)

    def __len__(self) -> int:
        return len(self.files)

    @property
    def sky_names(self) -> list[str]:
        """All target skies of all frames."""
        return sorted({name for file in self.files for name in self._read(file).targets})

    def whole(self, index: int, sky: str | None) -> RelightBatch:
        """One frame as it is, under one of its skies; None: as it was recorded."""
        sample = self._read(self.files[index])
        return identity_pair(sample) if sky is None else true_pair(sample, sky)

    def skies(self, index: int) -> list[str]:
        """Target skies of a frame whose truth is known."""
        return _with_truth(self._read(self.files[index]))

    def batch(self, draw: int, seed: int) -> RelightBatch:
        """The crops of a draw; they depend on nothing else."""
        rng = np.random.default_rng([seed, draw])
        made = [self._one(rng) for _ in range(self._config.batch)]
        # Pairs of other kinds than the true ones know no physical estimate.
        names = [name for name in made[0].planes if all(name in one.planes for one in made)]
        return RelightBatch(
            {name: torch.cat([one.planes[name] for one in made]) for name in names},
            torch.cat([one.truth for one in made]),
            torch.cat([one.weight for one in made]),
        )

    def _one(self, rng: np.random.Generator) -> RelightBatch:
        sample = self._read(self.files[int(rng.integers(len(self.files)))])
        one = self._pair(_cut(sample, self._config.crop_px, rng), rng)
        if rng.random() < 0.5:
            one = _mirrored(one)
        if "target_physical" in one.planes:
            one = _misjudged(one, 2.0 ** float(rng.normal() * self._config.light_error_ev))
        lighter, tint = self._config.paint_ev
        paint = 2.0 ** (lighter * rng.normal() + tint * rng.normal(size=3))
        return exposed(one, 2.0 ** float(rng.uniform(*self._config.exposure_ev)), paint)

    def _pair(self, sample: RelightSample, rng: np.random.Generator) -> RelightBatch:
        """A frame with a source and a target, of one of the kinds."""
        config, skies = self._config, list(sample.targets)
        kinds = [
            config.sim_real_fraction,
            config.sim_sim_fraction,
            config.true_twin_fraction,
            config.identity_fraction,
        ]
        kind = int(np.searchsorted(np.cumsum(kinds), rng.random(), side="right"))
        first, second = (skies[int(rng.integers(len(skies)))] for _ in range(2))
        if kind == 0:
            return rendered_pair(sample, first, None)
        if kind in (1, 2):
            # Any of all skies, the recorded one among them, may be either.
            ends = [None if rng.random() < 1 / (len(skies) + 1) else s for s in (first, second)]
            one = rendered_pair(sample, *ends, is_real=False)
            return with_exact_estimate(one) if kind == 2 else one
        known = _with_truth(sample)
        if kind == 3 or not known:
            return identity_pair(sample)
        return true_pair(sample, known[int(rng.integers(len(known)))])


def _with_truth(sample: RelightSample) -> list[str]:
    return [name for name, target in sample.targets.items() if target.truth is not None]


def true_pair(sample: RelightSample, sky: str) -> RelightBatch:
    """The recorded picture, and the true one under another sky."""
    target = sample.targets[sky]
    assert target.truth is not None
    scene = tensors_of(sample.scene)
    weight = scene.pop("valid")
    return RelightBatch(
        scene | tensors_of(target.planes), torch.from_numpy(target.truth)[None] / 255.0, weight
    )


def rendered_pair(
    sample: RelightSample, source: str | None, target: str | None, *, is_real: bool = True
) -> RelightBatch:
    """The twin's own picture under one sky as the source of what is wanted under another.

    Args:
        source, target: names of skies; None is the recorded one.
        is_real: the recorded picture is wanted where the target is the recorded sky.
    """
    scene = tensors_of(sample.scene)
    weight, recorded = scene.pop("valid"), scene["source"]
    lights = [_light_of(sample, scene, sky) for sky in (source, target)]
    planes = {k: v for k, v in scene.items() if not k.startswith("source_")}
    for which, light in zip(("source", "target"), lights, strict=True):
        planes |= {f"{which}_{name}": value for name, value in light.items()}
    pictures = [srgb_of(rendered(planes, which)).clamp(0, 1) for which in ("source", "target")]
    planes["source"] = pictures[0]
    planes["clipped"] = (pictures[0].amax(1, keepdim=True) >= _CLIPPED).float()
    wanted = recorded if is_real and target is None else pictures[1]
    return RelightBatch(planes, wanted, weight)


def with_exact_estimate(one: RelightBatch) -> RelightBatch:
    """A pair of the twin's own pictures, as if the twin were the truth: the physical estimate is
    what is wanted, and the recorded sun is seen where the twin has it."""
    seen = torch.where(one.planes["found"] < 0, one.planes["found"], one.planes["source_sun"])
    estimate = rendered(one.planes, "target")
    return replace(one, planes=one.planes | {"found": seen, "target_physical": estimate})


def _light_of(
    sample: RelightSample, scene: dict[str, Tensor], sky: str | None
) -> dict[str, Tensor]:
    """Planes of the light of a sky, and what is seen of it."""
    if sky is None:
        own = {k.removeprefix("source_"): v for k, v in scene.items() if k.startswith("source_")}
        return {**own, "sky": linear_of(scene["source"])}
    planes = tensors_of(sample.targets[sky].planes)
    del planes["target_physical"]
    return {name.removeprefix("target_"): value for name, value in planes.items()}


def identity_pair(sample: RelightSample) -> RelightBatch:
    """The source as its own target; physical relighting gives it back."""
    scene = tensors_of(sample.scene)
    weight = scene.pop("valid") * (1 - scene["clipped"])
    own = {f"target_{name}": value for name, value in _light_of(sample, scene, None).items()}
    own["target_physical"] = own["target_sky"]
    return RelightBatch(scene | own, scene["source"], weight)


def _cut(sample: RelightSample, most: tuple[int, int], rng: np.random.Generator) -> RelightSample:
    """A part of the picture, domes whole, which knows how bright the whole is."""
    slices = []
    for length, part in zip(sample.scene["source"].shape[1:], most, strict=True):
        at = int(rng.integers(max(length - part, 0) + 1))
        slices.append(slice(at, at + part))
    rows, columns = slices

    def part_of(planes: Planes, which: str, level: float) -> Planes:
        part = {
            name: value if name.endswith(OF_SKIES) else value[:, rows, columns]
            for name, value in planes.items()
        }
        return part | {f"{which}{_LEVEL}": np.full((1, 1, 1), level, np.float32)}

    targets = {
        sky: RelightTargetSample(
            part_of(target.planes, "target", sample.levels[sky]),
            None if target.truth is None else target.truth[:, rows, columns],
        )
        for sky, target in sample.targets.items()
    }
    return RelightSample(part_of(sample.scene, "source", sample.levels[None]), targets)


def _mirrored(one: RelightBatch) -> RelightBatch:
    """Left and right exchanged, of skies too."""
    planes = {name: value.flip(-1) for name, value in one.planes.items()}
    for name in _VECTORS:
        planes[name] = torch.cat([-planes[name][:, :1], planes[name][:, 1:]], dim=1)
    return RelightBatch(planes, one.truth.flip(-1), one.weight.flip(-1))


def _misjudged(one: RelightBatch, factor: float) -> RelightBatch:
    """As if the target light were so much stronger than it is; the sky is known."""
    planes = dict(one.planes)
    for name in ("target_shaded", "target_reflected", f"target{_LEVEL}"):
        planes[name] = planes[name] * factor
    surface = 1 - planes["matte"]
    planes["target_physical"] = planes["target_physical"] * (1 + surface * (factor - 1))
    return RelightBatch(planes, one.truth, one.weight)


def exposed(
    one: RelightBatch, factor: float, paint: Float[np.ndarray, "3"] | None = None
) -> RelightBatch:
    """As a camera of another exposure would have shown it; what was clipped and would not be does
    not count.

    Args:
        paint: what surfaces reflect is so many times as much, by channel; the sky stays.
    """
    planes, matte = dict(one.planes), one.planes["matte"]
    coat = torch.ones(3) if paint is None else torch.from_numpy(paint)
    coat = coat.to(matte)[:, None, None]
    of_pixel = factor * (matte + (1 - matte) * coat)
    for name in planes:
        if name.endswith(_RADIANT):
            planes[name] = planes[name] * (of_pixel if name.endswith(_PAINTED) else factor)
    planes["base_colour"] = planes["base_colour"] * coat
    source = linear_of(planes["source"]) * of_pixel
    planes["clipped"] = torch.maximum(
        planes["clipped"], (source.amax(1, keepdim=True) >= 1).to(source)
    )
    planes["source"] = srgb_of(source).clamp(0, 1)
    truth = srgb_of(linear_of(one.truth) * of_pixel).clamp(0, 1)
    was_clipped = one.truth.amax(1, keepdim=True) >= _CLIPPED
    is_known = ~was_clipped | (truth.amin(1, keepdim=True) >= _CLIPPED)
    return RelightBatch(planes, truth, one.weight * is_known)
