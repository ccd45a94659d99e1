"""Planes of a frame as tensors, and the features that the network computes from them."""

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
RemovedInput = Literal["buffers", "shadow-maps", "physical", "confidence"]
"""Inputs that ablations remove: I_buffer, visibilities and shadow ratios, the physical estimate
(replaced by a rendering of the twin), or the factor of the network's confidence."""
# Radiance, as a fraction of white, above which `log_coded` is logarithmic; linear below.
_DARK = 0.02
# Distance that is coded as 1, in metres: beyond most surfaces of a street. Sensitivity not
# measured.
FAR_M = 200.0


def tensors_of(planes: Planes, device: torch.device | str = "cpu") -> dict[str, Tensor]:
    """Convert the planes of one sample to a batch."""
    return {k: torch.from_numpy(v).to(device, torch.float32)[None] for k, v in planes.items()}


def downsampled(batch: Batch, columns: int) -> Batch:
    """Reduce the planes to at most `columns` columns by area means; domes keep their size."""
    plane = next(plane for name, plane in batch.items() if not name.endswith(OF_SKIES))
    height, width = plane.shape[-2:]
    if width <= columns:
        return batch
    rows = round(height * columns / width)
    if height % rows == 0 and width % columns == 0:
        step = height // rows, width // columns
        return {n: p if n.endswith(OF_SKIES) else _block_means(p, step) for n, p in batch.items()}
    down, across = (
        plane.new_tensor(area_weights(old, new)) for old, new in ((height, rows), (width, columns))
    )
    return {
        name: plane if name.endswith(OF_SKIES) else down @ plane @ across.T
        for name, plane in batch.items()
    }


def _block_means(
    plane: Float[Tensor, "n c h w"], step: tuple[int, int]
) -> Float[Tensor, "n c p q"]:
    """Means of blocks of pixels, ten times as fast as products with matrices of weights."""
    lines = torch.stack([plane[..., k :: step[0], :] for k in range(step[0])]).mean(0)
    return torch.stack([lines[..., k :: step[1]] for k in range(step[1])]).mean(0)


def log_coded(radiance: Tensor) -> Tensor:
    """Log code of radiance: 0 for black and 1 for white; brighter radiance exceeds 1."""
    return torch.log1p(radiance.clamp_min(0.0) / _DARK) / math.log1p(1 / _DARK)


def srgb_of(linear: Tensor) -> Tensor:
    """sRGB code (IEC 61966-2-1) of linear values, not clipped above 1; with a finite gradient
    at 0."""
    linear = linear.clamp_min(0.0)
    curve = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def linear_of(srgb: Tensor) -> Tensor:
    """Return linear RGB of sRGB values in [0, 1], the inverse of `srgb_of`."""
    curve = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, curve)


def without(batch: Batch, unseen: Collection[RemovedInput]) -> Batch:
    """Return the batch without the inputs that an ablation removes."""
    hidden: set[str] = set(BUFFERS) if "buffers" in unseen else set()
    if "shadow-maps" in unseen:
        hidden |= {f"{which}_{name}" for which in ("source", "target") for name in ("ratio", "sun")}
        hidden.add("found")
    seen = {k: torch.zeros_like(v) if k in hidden else v for k, v in batch.items()}
    if "physical" in unseen:
        seen["target_physical"] = rendered(batch, "target")
    return seen


def rendered(batch: Batch, which: str) -> Float[Tensor, "n 3 h w"]:
    """Return the rendered twin over the source or target sky that lights it, as linear RGB."""
    surface = batch["surface"]
    return surface * modelled(batch, which) + (1 - surface) * batch[f"{which}_sky"]


def grey(radiance: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Luminance of linear RGB."""
    weights = torch.tensor(LUMINANCE_WEIGHTS, dtype=radiance.dtype, device=radiance.device)
    return (radiance * weights[:, None, None]).sum(1, keepdim=True)


def modelled(batch: Batch, which: str) -> Float[Tensor, "n 3 h w"]:
    """Return the rendered twin under the source or target sky as linear RGB, without the sky."""
    return batch["base_colour"] * batch[f"{which}_shaded"] + batch[f"{which}_reflected"]


def level(batch: Batch) -> Float[Tensor, "n 1 1 1"]:
    """Mean luminance of a frame's physical estimate over its surfaces; 1 is white."""
    surface, axes = batch["surface"], (1, 2, 3)
    total = (surface * grey(batch["target_physical"])).sum(axes, keepdim=True)
    return total / surface.sum(axes, keepdim=True).clamp_min(1.0)


def features(batch: Batch, exposure: Float[Tensor, "n 1 1 1"]) -> Float[Tensor, "n 39 h w"]:
    """Concatenate all features of the network per pixel, each within a few units of 0.

    Args:
        exposure: factor on the camera's gain in the network's input.
    """
    found = batch["found"]

    def light(name: str) -> Tensor:
        return batch[name] * exposure

    lights = [
        plane
        for which in ("source", "target")
        for plane in (
            log_coded(light(f"{which}_shaded")),
            batch[f"{which}_sun"],
            grey(batch[f"{which}_ratio"]),
            log_coded(grey(light(f"{which}_reflected"))),
            log_coded(modelled(batch, which) * exposure),
        )
    ]
    return torch.cat(
        [
            log_coded(light("target_physical")),
            log_coded(grey(light("target_sky"))),
            srgb_of(linear_of(batch["source"]) * exposure),
            batch["clipped"],
            batch["matte"],
            batch["surface"],
            torch.log1p(batch["depth"]) / math.log1p(FAR_M),
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
