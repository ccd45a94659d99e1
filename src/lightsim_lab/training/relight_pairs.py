"""Pairs that relighting networks learn from: frames under a source sky, and under a target sky."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import linear_of, rendered, srgb_of

LEVEL = "_level"
"""End of the name of what a crop tells of its whole frame (`features.level`)."""
TRUTH = "truth"
_VECTORS = ("normal", "position")
_RADIANT = ("shaded", "reflected", "physical", "sky", OF_SKIES, LEVEL)
_PAINTED = ("reflected", "physical")
"""What grows with the colour of surfaces; mirrors do, so that the picture stays their sum."""
_STEPPED = ("found", "weight")
"""What has no means: -1 is unknown, and a pixel counts or does not."""
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

    def taken(self, order: Tensor) -> RelightBatch:
        """Its samples in another order."""
        planes = {name: value[order] for name, value in self.planes.items()}
        return RelightBatch(planes, self.truth[order], self.weight[order])


@dataclass(frozen=True, eq=False)
class Views:
    """Frames under several skies, as planes with a leading axis of frames.

    Args:
        scene: planes of the frames (`channels.scene_planes`), `valid`, and `source_level`.
        targets: of each sky, by its name, `channels.target_planes`, `target_level` and, where it is
            known, TRUTH.
    """

    scene: dict[str, Tensor]
    targets: Mapping[str, dict[str, Tensor]]


def joined(parts: list[RelightBatch]) -> RelightBatch:
    """One after the other. Pairs of other kinds than the true ones know no physical estimate."""
    names = [name for name in parts[0].planes if all(name in one.planes for one in parts)]
    return RelightBatch(
        {name: torch.cat([one.planes[name] for one in parts]) for name in names},
        torch.cat([one.truth for one in parts]),
        torch.cat([one.weight for one in parts]),
    )


def true_pair(views: Views, sky: str) -> RelightBatch:
    """The recorded picture, and the true one under another sky."""
    scene, target = dict(views.scene), dict(views.targets[sky])
    truth = target.pop(TRUTH)
    weight = scene.pop("valid")
    return RelightBatch(scene | target, truth, weight)


def rendered_pair(
    views: Views, source: str | None, target: str | None, *, is_real: bool = True
) -> RelightBatch:
    """The twin's own picture under one sky as the source of what is wanted under another.

    Args:
        source, target: names of skies; None is the recorded one.
        is_real: the recorded picture is wanted where the target is the recorded sky.
    """
    scene = dict(views.scene)
    weight, recorded = scene.pop("valid"), scene["source"]
    planes = {k: v for k, v in scene.items() if not k.startswith("source_")}
    for which, sky in (("source", source), ("target", target)):
        light = recorded_light(scene) if sky is None else views.targets[sky]
        planes |= {
            name.replace("target", which, 1): value
            for name, value in light.items()
            if name not in ("target_physical", TRUTH)
        }
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


def identity_pair(views: Views) -> RelightBatch:
    """The source as its own target; physical relighting gives it back."""
    scene = dict(views.scene)
    weight = scene.pop("valid") * (1 - scene["clipped"])
    own = recorded_light(scene)
    own["target_physical"] = own["target_sky"]
    return RelightBatch(scene | own, scene["source"], weight)


def recorded_light(scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The recorded sky as if it were a target, but for a physical estimate."""
    own = {
        name.replace("source", "target", 1): value
        for name, value in scene.items()
        if name.startswith("source_")
    }
    return {**own, "target_sky": linear_of(scene["source"].float()).to(scene["source"].dtype)}


def zoomed(one: RelightBatch, size: tuple[int, int]) -> RelightBatch:
    """As a camera of another focal length would have shown it, with so many rows and columns."""
    # Means over areas where pixels grow fewer, so that nothing is skipped.
    smooth = "bilinear" if size[0] > one.truth.shape[-2] else "area"

    def seen(name: str, value: Tensor) -> Tensor:
        if name.endswith((OF_SKIES, LEVEL)):
            return value
        if name in _STEPPED:
            return functional.interpolate(value, size, mode="nearest-exact")
        if name in ("source", TRUTH):
            return srgb_of(functional.interpolate(linear_of(value), size, mode=smooth))
        return functional.interpolate(value, size, mode=smooth)

    return RelightBatch(
        {name: seen(name, value) for name, value in one.planes.items()},
        seen(TRUTH, one.truth),
        seen("weight", one.weight),
    )


def mirrored(one: RelightBatch, is_mirrored: Bool[Tensor, "n 1 1 1"]) -> RelightBatch:
    """Left and right exchanged, of skies too, of some of the samples."""

    def turned(name: str, value: Tensor) -> Tensor:
        flipped = value.flip(-1)
        if name in _VECTORS:
            flipped = torch.cat([-flipped[:, :1], flipped[:, 1:]], dim=1)
        return torch.where(is_mirrored, flipped, value)

    return RelightBatch(
        {name: turned(name, value) for name, value in one.planes.items()},
        turned(TRUTH, one.truth),
        turned("weight", one.weight),
    )


def misjudged(one: RelightBatch, factor: float | Float[Tensor, "n 1 1 1"]) -> RelightBatch:
    """As if the target light were so much stronger than it is; the sky is known."""
    planes = dict(one.planes)
    for name in ("target_shaded", "target_reflected", f"target{LEVEL}"):
        planes[name] = planes[name] * factor
    surface = 1 - planes["matte"]
    planes["target_physical"] = planes["target_physical"] * (1 + surface * (factor - 1))
    return RelightBatch(planes, one.truth, one.weight)


def exposed(
    one: RelightBatch,
    factor: float | Float[Tensor, "n 1 1 1"],
    paint: Float[np.ndarray, "*n 3"] | None = None,
) -> RelightBatch:
    """As a camera of another exposure would have shown it; what was clipped and would not be does
    not count.

    Args:
        paint: what surfaces reflect is so many times as much, by channel; the sky stays.
    """
    planes, matte = dict(one.planes), one.planes["matte"]
    coat = torch.from_numpy(np.ones(3) if paint is None else paint).to(matte)
    coat = coat.reshape(-1, 3, 1, 1)
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
