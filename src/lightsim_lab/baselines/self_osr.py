"""The network of `--method self-osr`: a picture decomposed and relit, without any 3D model.

Re-implementation of Yu et al. 2020, Self-supervised Outdoor Scene Relighting
(doi:10.1007/978-3-030-58542-6_6): a network finds albedo, normals and shadow in the picture, least
squares the order-2 lighting; a second network the shadows under another lighting from normals and
lighting; a third the picture from albedo, normals, new shading, new shadows, what the decomposition
leaves of the picture, and the sky's mask. What is different here: docs/models/baselines.md.
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

_LIGHTS = 3 * COUNT
_FIRST_ALBEDO, _FIRST_SHADOW = -1.4, 2.0
"""Before the sigmoid: a fifth is reflected, and all lies in the light."""


@dataclass(frozen=True)
class SelfOsrConfig:
    """Size of the networks."""

    widths: tuple[int, ...] = (24, 32, 48, 64)
    """Of decomposition and rendering: channels at a half, a quarter, ... of the size."""
    shadow_widths: tuple[int, ...] = (16, 24, 32, 48)
    """Of the shadows under another light."""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """What a picture shows.

    Args:
        albedo: linear, in [0, 1].
        normal: unit; right, forward, up of the level camera.
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
        """Linear picture of the surfaces under a lighting (their image formation model)."""
        return self.albedo * shading(self.normal, light) * shadow

    def part(self, samples: slice, step_px: int = 1) -> Decomposition:
        """Some samples of the batch, at every so many rows and columns."""
        few = (samples, slice(None), slice(None, None, step_px), slice(None, None, step_px))
        maps = (self.albedo[few], self.normal[few], self.shadow[few])
        return Decomposition(*maps, self.light[samples])


@dataclass(frozen=True, eq=False)
class Relit:
    """A picture under another lighting.

    Args:
        picture: sRGB code, not clipped; the target sky stands behind the matte.
        lambert: linear, of decomposition, lighting and shadow alone.
        shadow: predicted under the target.
    """

    picture: Float[Tensor, "n 3 h w"]
    lambert: Float[Tensor, "n 3 h w"]
    shadow: Float[Tensor, "n 1 h w"]


class SelfOsrNet(nn.Module):
    """Source picture, sky matte and target lighting -> the picture under it."""

    def __init__(self, config: SelfOsrConfig) -> None:
        super().__init__()
        self.config = config
        self.inverse = UNet(4, 7, config.widths)
        self.caster = UNet(3 + _LIGHTS, 1, config.shadow_widths)
        self.renderer = UNet(14, 3, config.widths)

    def forward(self, batch: Batch) -> Float[Tensor, "n 3 h w"]:
        """sRGB code, not clipped."""
        return self.relit(batch, self.decompose(batch["source"], batch["matte"])).picture

    def decompose(
        self, picture: Float[Tensor, "n 3 h w"], matte: Float[Tensor, "n 1 h w"]
    ) -> Decomposition:
        """Of an sRGB picture; the sky is masked."""
        surface = 1 - matte
        found = self.inverse(torch.cat([picture * surface, matte], dim=1)).float()
        albedo = torch.sigmoid(found[:, :3] + _FIRST_ALBEDO)
        # At first all face the camera and up, as street surfaces do in the mean.
        bias = torch.tensor([0.0, -0.5, 0.5], device=found.device)[:, None, None]
        normal = functional.normalize(found[:, 3:6] + bias, dim=1)
        shadow = torch.sigmoid(found[:, 6:] + _FIRST_SHADOW)
        light = fitted_light(linear_of(picture), albedo * shadow * surface, normal)
        return Decomposition(albedo, normal, shadow, light)

    def relit(self, batch: Batch, seen: Decomposition) -> Relit:
        """The decomposed source under the target dome."""
        matte = batch["matte"]
        light = lighting_of(batch, "target")
        fresh = shading(seen.normal, light)
        flat = _coded(light).flatten(1)[..., None, None].expand(-1, -1, *matte.shape[-2:])
        shadow = self.caster(torch.cat([seen.normal, flat], dim=1)).float()
        shadow = torch.sigmoid(shadow + _FIRST_SHADOW)
        own = srgb_of(seen.under(seen.light, seen.shadow)).clamp_max(1.0)
        residual = (1 - matte) * (batch["source"] - own)
        lambert = seen.albedo * fresh * shadow
        inputs = [seen.albedo.sqrt(), seen.normal, srgb_of(fresh), residual, shadow, matte]
        surface = srgb_of(lambert) + self.renderer(torch.cat(inputs, dim=1)).float()
        behind = srgb_of(batch["target_sky"])
        return Relit((1 - matte) * surface + matte * behind, lambert, shadow)


def lighting_of(batch: Batch, which: str) -> Float[Tensor, "n 9 3"]:
    """Lighting of the source's or the target's dome in units of the camera's white."""
    return project(turned_to_right(batch[f"{which}_dome"]))


def _coded(light: Float[Tensor, "n 9 3"]) -> Float[Tensor, "n 9 3"]:
    """Within a few units of 0: a direct sun is some ten times the sky."""
    return torch.asinh(light)
