"""Network of `--method self-osr`: intrinsic decomposition and relighting without a 3D model.

Re-implementation of Yu et al. 2020, Self-supervised Outdoor Scene Relighting
(doi:10.1007/978-3-030-58542-6_6). A first network estimates albedo, normals and shadow; order-2
lighting follows by least squares. A second network predicts shadows under another lighting from
normals and lighting. A third renders the picture from albedo, normals, new shading, new shadows,
the residual of the decomposition, and the sky mask. Differences from the original:
docs/models/baselines.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.relighting.network.features import Batch, linear_of, srgb_of
from lightsim_lab.baselines.spherical_harmonics import (
    COUNT,
    fitted_light,
    project,
    shading,
    turned_to_right,
)
from lightsim_lab.baselines.unet import UNet

# Bias of the albedo logit: initial albedo is 0.2, the mean of street surfaces.
_ALBEDO_BIAS = -1.4
# Bias of the shadow logit: initially pixels are lit.
_SHADOW_BIAS = 2.0


@dataclass(frozen=True)
class SelfOsrConfig:
    """Size of the networks."""

    widths: tuple[int, ...] = (24, 32, 48, 64)
    """Channels of decomposition and rendering at 1/2, 1/4, ... of the picture's size."""
    shadow_widths: tuple[int, ...] = (16, 24, 32, 48)
    """Channels of the network of target shadows."""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Intrinsic decomposition of a picture.

    Args:
        albedo: linear, in [0, 1].
        normal: unit vectors (right, forward, up) in the levelled camera frame.
        shadow: 1 is lit, 0 dark.
        light: least-squares lighting of the picture.
    """

    albedo: Float[Tensor, "n 3 h w"]
    normal: Float[Tensor, "n 3 h w"]
    shadow: Float[Tensor, "n 1 h w"]
    light: Float[Tensor, "n 9 3"]

    def under(
        self, light: Float[Tensor, "n 9 3"], shadow: Float[Tensor, "n 1 h w"]
    ) -> Float[Tensor, "n 3 h w"]:
        """Return the linear picture under a lighting, by the image formation of the paper."""
        return self.albedo * shading(self.normal, light) * shadow

    def part(self, samples: slice, step_px: int = 1) -> Decomposition:
        """Select samples of the batch, and every `step_px`-th row and column."""
        few = (samples, slice(None), slice(None, None, step_px), slice(None, None, step_px))
        maps = (self.albedo[few], self.normal[few], self.shadow[few])
        return Decomposition(*maps, self.light[samples])


@dataclass(frozen=True, eq=False)
class Relit:
    """A picture under another lighting.

    Args:
        picture: sRGB values, not clipped, composited over the target sky.
        lambert: linear product of albedo, shading and shadow.
        shadow: predicted under the target lighting.
    """

    picture: Float[Tensor, "n 3 h w"]
    lambert: Float[Tensor, "n 3 h w"]
    shadow: Float[Tensor, "n 1 h w"]


class SelfOsrNet(nn.Module):
    """Networks that relight a picture, given its sky matte and the target lighting."""

    def __init__(self, config: SelfOsrConfig) -> None:
        super().__init__()
        self.config = config
        self.inverse = UNet(4, 7, config.widths)
        self.caster = UNet(3 + 3 * COUNT, 1, config.shadow_widths)
        self.renderer = UNet(14, 3, config.widths)

    def forward(self, batch: Batch) -> Float[Tensor, "n 3 h w"]:
        """Return sRGB values, not clipped."""
        return self.relit(batch, self.decompose(batch["source"], batch["matte"])).picture

    def decompose(
        self, picture: Float[Tensor, "n 3 h w"], matte: Float[Tensor, "n 1 h w"]
    ) -> Decomposition:
        """Decompose an sRGB picture, in which the sky is masked."""
        surface = 1 - matte
        found = self.inverse(torch.cat([picture * surface, matte], dim=1)).float()
        # Sky pixels also get values here; the mask removes them from fit and picture.
        albedo = torch.sigmoid(found[:, :3] + _ALBEDO_BIAS)
        # Initial normals point to the camera and up, the mean of street surfaces.
        bias = torch.tensor([0.0, -0.5, 0.5], device=found.device)[:, None, None]
        normal = functional.normalize(found[:, 3:6] + bias, dim=1)
        shadow = torch.sigmoid(found[:, 6:] + _SHADOW_BIAS)
        light = fitted_light(linear_of(picture), albedo * shadow * surface, normal)
        return Decomposition(albedo, normal, shadow, light)

    def relit(self, batch: Batch, seen: Decomposition) -> Relit:
        """Relight the decomposed source under the target dome."""
        matte = batch["matte"]
        light = lighting_of(batch, "target")
        fresh = shading(seen.normal, light)
        flat = _coded(light).flatten(1)[..., None, None].expand(-1, -1, *matte.shape[-2:])
        shadow = self.caster(torch.cat([seen.normal, flat], dim=1)).float()
        shadow = torch.sigmoid(shadow + _SHADOW_BIAS)
        # The residual contains what albedo, normals and shadow do not explain, e.g. reflections.
        own = srgb_of(seen.under(seen.light, seen.shadow)).clamp_max(1.0)
        residual = (1 - matte) * (batch["source"] - own)
        lambert = seen.albedo * fresh * shadow
        # Square root and sRGB curve encode all inputs on a perceptual scale.
        inputs = [seen.albedo.sqrt(), seen.normal, srgb_of(fresh), residual, shadow, matte]
        surface = srgb_of(lambert) + self.renderer(torch.cat(inputs, dim=1)).float()
        behind = srgb_of(batch["target_sky"])
        return Relit((1 - matte) * surface + matte * behind, lambert, shadow)


def lighting_of(batch: Batch, which: str) -> Float[Tensor, "n 9 3"]:
    """Return the lighting of the "source" or "target" dome in units of the camera's white."""
    return project(turned_to_right(batch[f"{which}_dome"]))


def _coded(light: Float[Tensor, "n 9 3"]) -> Float[Tensor, "n 9 3"]:
    """Compress coefficients to a few units around 0: direct sun exceeds the sky about tenfold."""
    return torch.asinh(light)
