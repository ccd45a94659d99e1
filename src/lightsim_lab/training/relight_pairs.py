"""Training pairs of the relighting networks: a frame under a source sky and under a target sky."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import linear_of, rendered, srgb_of

# Suffix of the planes with the brightness of the whole frame that a crop is from
# (`features.level`).
LEVEL = "_level"
TRUTH = "truth"
_VECTORS = ("normal", "position")
_RADIANT = ("shaded", "reflected", "physical", "sky", OF_SKIES, LEVEL)
# Planes proportional to the base colour. Mirror reflections are scaled too, so that the picture
# remains the sum of its planes.
_BASE_COLOUR_PLANES = ("reflected", "physical")
# sRGB value in [0, 1] from which a channel counts as clipped: one 8-bit code below white, as a
# tolerance for compression. Sensitivity not measured.
CLIPPED = 254 / 255


@dataclass(frozen=True, eq=False)
class RelightBatch:
    """Input, target and pixel weights of one training step.

    Args:
        planes: planes of scene, source and target, each with a leading axis of samples.
        truth: picture under the target sky, sRGB in [0, 1].
        weight: 1 where a pixel counts in the loss, else 0.
    """

    planes: dict[str, Tensor]
    truth: Float[Tensor, "n 3 h w"]
    weight: Float[Tensor, "n 1 h w"]

    def on(self, device: torch.device) -> RelightBatch:
        """Return the batch on a device."""
        planes = {name: value.to(device) for name, value in self.planes.items()}
        return RelightBatch(planes, self.truth.to(device), self.weight.to(device))

    def taken(self, order: Tensor) -> RelightBatch:
        """Return the samples in the given order."""
        planes = {name: value[order] for name, value in self.planes.items()}
        return RelightBatch(planes, self.truth[order], self.weight[order])


@dataclass(frozen=True, eq=False)
class Views:
    """Frames under several skies, as planes with a leading axis of frames.

    Args:
        scene: planes of the frames (`channels.scene_planes`), `valid`, and `source_level`.
        targets: by name of the sky, `channels.target_planes`, `target_level` and, where known,
            TRUTH.
    """

    scene: dict[str, Tensor]
    targets: Mapping[str, dict[str, Tensor]]


def joined(parts: list[RelightBatch]) -> RelightBatch:
    """Concatenate batches; only the planes that all of them have remain."""
    # Pairs of renderings have no physical estimate: the paper's network trains without one.
    names = [name for name in parts[0].planes if all(name in one.planes for one in parts)]
    return RelightBatch(
        {name: torch.cat([one.planes[name] for one in parts]) for name in names},
        torch.cat([one.truth for one in parts]),
        torch.cat([one.weight for one in parts]),
    )


def true_pair(views: Views, sky: str) -> RelightBatch:
    """Return the recorded picture as source and the true picture under another sky as target."""
    scene, target = dict(views.scene), dict(views.targets[sky])
    truth = target.pop(TRUTH)
    weight = scene.pop("valid")
    return RelightBatch(scene | target, truth, weight)


def rendered_pair(
    views: Views, source: str | None, target: str | None, *, is_real: bool = True
) -> RelightBatch:
    """Return a pair whose source is the twin rendered under one sky, and its target under another.

    Args:
        source, target: names of the skies; None is the recorded sky.
        is_real: use the recorded picture as the target if `target` is the recorded sky.
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
    planes["clipped"] = (pictures[0].amax(1, keepdim=True) >= CLIPPED).float()
    truth = recorded if is_real and target is None else pictures[1]
    return RelightBatch(planes, truth, weight)


def brightened(light: Mapping[str, Tensor], factor: Float[Tensor, "n 1 1 1"]) -> dict[str, Tensor]:
    """Multiply the radiance of a sky, and all light from it, by a factor."""
    return {
        name: value * factor if name.endswith(_RADIANT) else value for name, value in light.items()
    }


def with_exact_estimate(one: RelightBatch) -> RelightBatch:
    """Add an error-free physical estimate to a pair of renderings, as if the twin were the truth.

    The sun visibility of the recording is replaced by that of the twin wherever it is known.
    """
    # Negative values of `found` mean that the visibility is unknown.
    found = torch.where(one.planes["found"] < 0, one.planes["found"], one.planes["source_sun"])
    estimate = rendered(one.planes, "target")
    return replace(one, planes=one.planes | {"found": found, "target_physical": estimate})


def identity_pair(views: Views) -> RelightBatch:
    """Return a pair whose target is its source; physical relighting reproduces it exactly."""
    scene = dict(views.scene)
    weight = scene.pop("valid") * (1 - scene["clipped"])
    own = recorded_light(scene)
    own["target_physical"] = own["target_sky"]
    return RelightBatch(scene | own, scene["source"], weight)


def recorded_light(scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the planes of the recorded sky under target names, without a physical estimate."""
    own = {
        name.replace("source", "target", 1): value
        for name, value in scene.items()
        if name.startswith("source_")
    }
    return {**own, "target_sky": linear_of(scene["source"].float()).to(scene["source"].dtype)}


def mirrored(one: RelightBatch, is_mirrored: Bool[Tensor, "n 1 1 1"]) -> RelightBatch:
    """Mirror some of the samples, with their sky domes, left to right."""

    def turned(name: str, value: Tensor) -> Tensor:
        flipped = value.flip(-1)
        if name in _VECTORS:
            # Vectors are in a camera frame whose first axis is horizontal.
            flipped = torch.cat([-flipped[:, :1], flipped[:, 1:]], dim=1)
        return torch.where(is_mirrored, flipped, value)

    return RelightBatch(
        {name: turned(name, value) for name, value in one.planes.items()},
        turned(TRUTH, one.truth),
        turned("weight", one.weight),
    )


def with_light_error(one: RelightBatch, factor: float | Float[Tensor, "n 1 1 1"]) -> RelightBatch:
    """Multiply the target light and the physical estimate by an error factor; the sky is exact."""
    planes = dict(one.planes)
    for name in ("target_shaded", "target_reflected", f"target{LEVEL}"):
        planes[name] = planes[name] * factor
    # Sky pixels are radiance of the known sky, without error.
    surface = 1 - planes["matte"]
    planes["target_physical"] = planes["target_physical"] * (1 + surface * (factor - 1))
    return RelightBatch(planes, one.truth, one.weight)


def exposed(
    one: RelightBatch,
    factor: float | Float[Tensor, "n 1 1 1"],
    base_colour_factor: Float[np.ndarray, "*n 3"] | None = None,
) -> RelightBatch:
    """Change the exposure of a batch, and the base colour of its surfaces.

    The value of a clipped pixel is unknown below white, so its weight becomes 0 if it is darkened.

    Args:
        factor: factor on the radiance of all pixels.
        base_colour_factor: factor by channel, one row or one per sample; the sky is unchanged.
    """
    planes, matte = dict(one.planes), one.planes["matte"]
    colour_factor = torch.from_numpy(
        np.ones(3) if base_colour_factor is None else base_colour_factor
    ).to(matte)
    colour_factor = colour_factor.reshape(-1, 3, 1, 1)
    of_pixel = factor * (matte + (1 - matte) * colour_factor)
    for name in planes:
        if name.endswith(_RADIANT):
            planes[name] = planes[name] * (
                of_pixel if name.endswith(_BASE_COLOUR_PLANES) else factor
            )
    planes["base_colour"] = planes["base_colour"] * colour_factor
    # The change of exposure may clip further pixels; clipped pixels remain clipped.
    source = linear_of(planes["source"]) * of_pixel
    planes["clipped"] = torch.maximum(
        planes["clipped"], (source.amax(1, keepdim=True) >= 1).to(source)
    )
    planes["source"] = srgb_of(source).clamp(0, 1)
    truth = srgb_of(linear_of(one.truth) * of_pixel).clamp(0, 1)
    was_clipped = one.truth.amax(1, keepdim=True) >= CLIPPED
    is_known = ~was_clipped | (truth.amin(1, keepdim=True) >= CLIPPED)
    return RelightBatch(planes, truth, one.weight * is_known)
