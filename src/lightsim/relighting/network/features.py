"""The planes of a frame as tensors, and what the network makes of them before its first layer."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.resample import area_weights
from lightsim.relighting.network.channels import BUFFERS, OF_SKIES, Planes

Batch = Mapping[str, Tensor]
"""Planes with a leading axis of samples, by name (`channels`)."""
Unseen = Literal["buffers", "shadow-maps", "physical", "confidence"]
"""What ablations leave out: I_buffer, visibilities and shadow ratios, the physical estimate (the
twin's own picture stands for it), or the gain on the network's confidence."""
_DARK = 0.02
"""Of white: the code of radiance is logarithmic above it and linear below."""
_FAR_M = 200.0


def tensors_of(planes: Planes, device: torch.device | str = "cpu") -> dict[str, Tensor]:
    """One sample as a batch."""
    return {k: torch.from_numpy(v).to(device, torch.float32)[None] for k, v in planes.items()}


def shrunk(batch: Batch, columns: int) -> Batch:
    """The planes at most so many columns wide, by areas; domes stay."""
    height, width = batch["source"].shape[-2:]
    if width <= columns:
        return batch
    source = batch["source"]
    down, across = (
        source.new_tensor(area_weights(old, new))
        for old, new in ((height, round(height * columns / width)), (width, columns))
    )
    return {
        name: plane if name.endswith(OF_SKIES) else down @ plane @ across.T
        for name, plane in batch.items()
    }


def coded(radiance: Tensor) -> Tensor:
    """Log of radiance, 0 in the dark and 1 at white; brighter is larger than 1."""
    return torch.log1p(radiance.clamp_min(0.0) / _DARK) / math.log1p(1 / _DARK)


def srgb_of(linear: Tensor) -> Tensor:
    """sRGB code (IEC 61966-2-1) of linear values, not clipped above 1; with a gradient at 0."""
    linear = linear.clamp_min(0.0)
    curve = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def linear_of(srgb: Tensor) -> Tensor:
    """Inverse of `srgb_of` within [0, 1]."""
    curve = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, curve)


def without(batch: Batch, unseen: Collection[Unseen]) -> Batch:
    """The batch without what a network is not to see, for ablations."""
    hidden: set[str] = set(BUFFERS) if "buffers" in unseen else set()
    if "shadow-maps" in unseen:
        hidden |= {f"{which}_{name}" for which in ("source", "target") for name in ("ratio", "sun")}
        hidden.add("found")
    seen = {k: torch.zeros_like(v) if k in hidden else v for k, v in batch.items()}
    if "physical" in unseen:
        seen["target_physical"] = rendered(batch, "target")
    return seen


def rendered(batch: Batch, which: str) -> Float[Tensor, "n 3 h w"]:
    """Linear picture of the twin under one of the skies, `source_sky` or `target_sky` behind."""
    surface = batch["surface"]
    return surface * modelled(batch, which) + (1 - surface) * batch[f"{which}_sky"]


def grey(radiance: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Luminance."""
    weights = torch.tensor(LUMINANCE_WEIGHTS, dtype=radiance.dtype, device=radiance.device)
    return (radiance * weights[:, None, None]).sum(1, keepdim=True)


def modelled(batch: Batch, which: str) -> Float[Tensor, "n 3 h w"]:
    """Linear picture of the twin under one of the skies, without sky."""
    return batch["base_colour"] * batch[f"{which}_shaded"] + batch[f"{which}_reflected"]


def level(batch: Batch) -> Float[Tensor, "n 1 1 1"]:
    """How bright the physical estimate of a frame is: its mean over surfaces, 1 is white."""
    surface, axes = batch["surface"], (1, 2, 3)
    total = (surface * grey(batch["target_physical"])).sum(axes, keepdim=True)
    return total / surface.sum(axes, keepdim=True).clamp_min(1.0)


def features(batch: Batch, exposure: Float[Tensor, "n 1 1 1"]) -> Float[Tensor, "n 39 h w"]:
    """All that the network sees pixel by pixel, each within a few units of 0.

    Args:
        exposure: the frame is shown as a camera with so many times its gain would show it.
    """
    found = batch["found"]

    def light(name: str) -> Tensor:
        return batch[name] * exposure

    lights = [
        plane
        for which in ("source", "target")
        for plane in (
            coded(light(f"{which}_shaded")),
            batch[f"{which}_sun"],
            grey(batch[f"{which}_ratio"]),
            coded(grey(light(f"{which}_reflected"))),
            coded(modelled(batch, which) * exposure),
        )
    ]
    return torch.cat(
        [
            coded(light("target_physical")),
            coded(grey(light("target_sky"))),
            srgb_of(linear_of(batch["source"]) * exposure),
            batch["clipped"],
            batch["matte"],
            batch["surface"],
            torch.log1p(batch["depth"]) / math.log1p(_FAR_M),
            batch["normal"],
            batch["base_colour"].clamp_min(0.0).sqrt(),
            batch["openness"],
            batch["actor"],
            found.clamp_min(0.0),
            (found < 0).to(found),
            *lights,
        ],
        dim=1,
    )
