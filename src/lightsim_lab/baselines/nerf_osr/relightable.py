"""Relightable neural field of a street: density, albedo, and shadow under order-2 lighting.

Re-implementation of Rudnev et al. 2022, NeRF for Outdoor Scene Relighting
(doi:10.1007/978-3-031-19787-1_35), on a hash grid, with the sampling that LightSim uses for
driving logs (appendix): eight samples within 50 cm of the LiDAR surface. Differences from both:
docs/models/baselines.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.reconstruct.field.hash_grid.grid import hash_encode, make_table
from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec
from lightsim.reconstruct.field.sdf_field import mlp
from lightsim.reconstruct.field.volume_rendering import composite
from lightsim_lab.baselines.relight import FieldSurface
from lightsim_lab.baselines.spherical_harmonics import COUNT, shading_basis

# Exponent from pixel values to linear radiance, as in the paper.
ENCODING_POWER = 2.2
# Scale of densities, per metre. Initial densities are near it: half of the light passes 7 cm.
_DENSITY_PER_M = 10.0
# Distance of the density samples for normals, in metres: twice the finest grid cell, because
# differences over one cell are dominated by the noise of hash collisions.
_NORMAL_STEP_M = 0.2
# Corners at which density is sampled: four samples give an unbiased gradient, one per axis and side
# would need six.
_TETRAHEDRON = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))
# Rays per call of `field_surface`, to limit memory.
_CHUNK = 16_384


@dataclass(frozen=True)
class NerfOsrConfig:
    """Size of the field and placement of its samples."""

    levels: int = 10
    """Levels of the hash grid."""
    log2_entries: int = 18
    """Binary logarithm of the entries of each level."""
    coarsest_m: float = 8.0
    finest_m: float = 0.1
    hidden: int = 64
    """Width of the hidden layer of the head."""
    latent: int = 15
    """Length of the feature vector from which, with the lighting, a point's shadow is predicted."""
    samples: int = 8
    """Samples per ray."""
    half_band_m: float = 0.5
    """Half length of the interval around the surface that contains the samples, in metres."""

    @property
    def grid(self) -> HashGridSpec:
        """Specification of the hash grid."""
        return HashGridSpec(self.levels, 2, self.log2_entries, self.coarsest_m, self.finest_m)


@dataclass(frozen=True, eq=False)
class FieldRays:
    """Rays with an approximate surface point.

    Args:
        point: on the LiDAR surface, metres, frame `world`.
        direction: unit vector.
    """

    point: Float[Tensor, "r 3"]
    direction: Float[Tensor, "r 3"]


@dataclass(frozen=True, eq=False)
class ShownRays:
    """Surface attributes rendered along rays.

    Args:
        albedo: factor on encoded pixel values, not on linear radiance.
        normal: unit vector.
        shadow: factor on encoded pixel values; 1 is lit.
        depth_m: along the ray, from the approximate surface point.
    """

    albedo: Float[Tensor, "r 3"]
    normal: Float[Tensor, "r 3"]
    shadow: Float[Tensor, " r"]
    depth_m: Float[Tensor, " r"]

    def pixels(self, light: Float[Tensor, "9 3"]) -> Float[Tensor, "r 3"]:
        """Return pixel values under a lighting whose unit is the picture's white."""
        # The guard limits the gradient of the root, which is infinite at 0.
        irradiance = (shading_basis(self.normal) @ light).clamp_min(1e-6)
        return self.albedo * irradiance ** (1 / ENCODING_POWER) * self.shadow[:, None]


class RelightableField(nn.Module):
    """Density and albedo by position, shadow by position and lighting; lighting of the recording.

    Args:
        generator: source of the initial values.
        first_light: initial value of the recording's lighting; None: 0.
    """

    def __init__(
        self,
        config: NerfOsrConfig,
        generator: torch.Generator,
        first_light: Float[Tensor, "9 3"] | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.table = make_table(config.grid, generator)
        outputs = 1 + 3 + config.latent
        self.head = mlp(config.grid.output_dim, config.hidden, outputs, generator)
        # Shadows depend on the grey lighting only: its colour does not move them.
        self.caster = mlp(config.latent + COUNT, config.hidden // 2, 1, generator)
        first = torch.zeros(COUNT, 3) if first_light is None else first_light.clone()
        self.light = nn.Parameter(first)

    @property
    def dense_parameters(self) -> list[nn.Parameter]:
        """All parameters except the hash table, which has a sparse optimiser."""
        return [p for name, p in self.named_parameters() if name != "table"]

    def forward(
        self,
        rays: FieldRays,
        light: Float[Tensor, "9 3"],
        generator: torch.Generator | None = None,
    ) -> ShownRays:
        """Render rays under a lighting.

        Args:
            generator: draws each sample within its part of the interval; None: at its centre.
        """
        t = self._places(len(rays.point), generator).to(rays.point)
        points = rays.point[:, None] + t[..., None] * rays.direction[:, None]
        raw, albedo, latent = self._at(points.reshape(-1, 3)).split(
            [1, 3, self.config.latent], dim=1
        )
        shape = t.shape
        weights = self._weights(raw.reshape(shape), t)
        grey = light @ torch.tensor(LUMINANCE_WEIGHTS, device=light.device)
        seen = torch.cat([latent, grey.expand(len(latent), -1)], dim=1)
        # The bias makes points initially lit.
        shadow = torch.sigmoid(self.caster(seen) + 2.0).reshape(shape)
        depth = (weights * t).sum(1)
        # Normals must not move the surface: depth has its own loss.
        surface = rays.point + depth.detach()[:, None] * rays.direction
        return ShownRays(
            (weights[..., None] * torch.sigmoid(albedo).reshape(*shape, 3)).sum(1),
            self._normals(surface),
            (weights * shadow).sum(1),
            depth,
        )

    def _places(self, count: int, generator: torch.Generator | None) -> Float[Tensor, "r s"]:
        samples, half = self.config.samples, self.config.half_band_m
        inside = torch.full((count, samples), 0.5)
        if generator is not None:
            inside = torch.rand((count, samples), generator=generator)
        return half * (2 * (torch.arange(samples) + inside) / samples - 1)

    def _at(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n o"]:
        return self.head(hash_encode(points, self.table, self.config.grid))

    def _weights(self, raw: Float[Tensor, "r s"], t: Float[Tensor, "r s"]) -> Float[Tensor, "r s"]:
        """Return the weights of the samples; the last sample is opaque."""
        steps = torch.diff(t, dim=1)
        opacity = 1 - torch.exp(-_DENSITY_PER_M * functional.softplus(raw[:, :-1]) * steps)
        return composite(torch.cat([opacity, torch.ones_like(t[:, :1])], dim=1)).weights

    def _normals(self, points: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
        """Return the negative density gradient, normalised, from the corners of a tetrahedron."""
        corners = torch.tensor(_TETRAHEDRON, device=points.device)
        around = points[:, None] + _NORMAL_STEP_M * corners
        raw = self._at(around.reshape(-1, 3))[:, 0].reshape(-1, len(_TETRAHEDRON))
        return functional.normalize(-(raw[..., None] * corners).sum(1), dim=1, eps=1e-6)


def field_surface(
    relightable: RelightableField,
    points: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
    light: Float32[np.ndarray, "9 3"],
) -> FieldSurface:
    """Return the surface attributes along rays, frame `world`."""
    parts: list[ShownRays] = []
    with torch.no_grad():
        for start in range(0, len(points), _CHUNK):
            some = slice(start, start + _CHUNK)
            rays = FieldRays(*(torch.from_numpy(x[some]) for x in (points, directions)))
            parts.append(relightable(rays, torch.from_numpy(light)))
    albedo, normal, shadow = (
        np.concatenate([getattr(part, name).numpy() for part in parts])
        if parts
        else np.zeros((0, 3) if name != "shadow" else (0,), np.float32)
        for name in ("albedo", "normal", "shadow")
    )
    return FieldSurface(albedo**ENCODING_POWER, normal, shadow**ENCODING_POWER)
