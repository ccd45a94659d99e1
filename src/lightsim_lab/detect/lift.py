"""From picture features to the bird's-eye view (BEV).

`BilinearLift` samples the pictures where the cells project to (Harley et al. 2023, Simple-BEV,
arXiv:2206.07959). `AttentionLift` is the encoder of BEVFormer (Li et al. 2022, arXiv:2203.17270)
without its history of frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim_lab.detect.config import DetectorConfig
from lightsim_lab.detect.trunk import offset_px

# Smallest depth of a point in front of the camera, in metres.
_NEAREST_M = 0.1


class Pillars(nn.Module):
    """Points at several heights above the cells, and their projections into the pictures."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self._size_px = config.picture_px
        axis = (torch.arange(config.cells) + 0.5) * config.cell_m
        x, y = torch.meshgrid(axis, axis - config.reach_m / 2, indexing="ij")
        points = [torch.stack([x, y, x.new_full(x.shape, z), x * 0 + 1], -1).reshape(-1, 4)
                  for z in config.heights_m]  # fmt: skip
        # [cells, heights, 4], homogeneous, in the level frame of the camera.
        self.register_buffer("_points", torch.stack(points, 1), persistent=False)

    @torch.no_grad()
    def forward(
        self, projections: Float[Tensor, "n 3 4"]
    ) -> tuple[Float[Tensor, "n q z 2"], Bool[Tensor, "n q z"]]:
        """Return (u, v) in pixels of every point, and whether it projects into the picture.

        Args:
            projections: pixels of the network's input from the level frame, homogeneous.
        """
        points = self.get_buffer("_points")
        # In bfloat16, as in mixed-precision training, projections would be wrong by pixels.
        with torch.autocast(points.device.type, enabled=False):
            uvw = (points.flatten(0, 1) @ projections.mT).unflatten(1, points.shape[:2])
        depth = uvw[..., 2]
        uv = uvw[..., :2] / depth.clamp(min=_NEAREST_M)[..., None]
        size = uv.new_tensor(self._size_px)
        return uv, (depth > _NEAREST_M) & ((uv >= 0) & (uv < size)).all(-1)


def normalised(
    uv: Float[Tensor, "*n 2"], stride: int, size_px: tuple[int, int]
) -> Float[Tensor, "*n 2"]:
    """Return coordinates for `grid_sample` in a feature map of a stride, from pixel coordinates: -1
    and 1 are the outer edges of the map."""
    return (uv - offset_px(stride)) * 2 / uv.new_tensor(size_px) - 1


class BilinearLift(nn.Module):
    """Sum over the heights of a cell of one linear layer's bilinear samples for each height.

    The layers precede the sampling, which gives the same sums in less time: pictures have fewer
    pixels of stride 8 than the region has cells.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self._config = config
        self._pillars = Pillars(config)
        self._layers = nn.Conv2d(
            config.channels, config.channels * len(config.heights_m), 1, bias=False
        )

    def sampled(
        self, features: Float[Tensor, "n z c h w"], projections: Float[Tensor, "n 3 4"]
    ) -> Float[Tensor, "n z c x y"]:
        """Return the features of stride 8 of every height at its points of all cells, 0 outside
        the picture."""
        uv, is_shown = self._pillars(projections)
        grid = normalised(uv, 8, self._config.picture_px)
        # Samples outside [-1, 1] by more than a pixel are 0.
        grid = grid.masked_fill(~is_shown[..., None], -2.0).transpose(1, 2).flatten(0, 1)
        grid = grid.unflatten(1, (self._config.cells, self._config.cells))
        found = functional.grid_sample(
            features.flatten(0, 1).to(grid.dtype), grid, align_corners=False
        )
        return found.unflatten(0, features.shape[:2])

    def forward(
        self, levels: Sequence[Float[Tensor, "n c _ _"]], projections: Float[Tensor, "n 3 4"]
    ) -> Float[Tensor, "n c x y"]:
        """Return the features of all cells, from the level of stride 8."""
        features = self._layers(levels[0]).unflatten(1, (len(self._config.heights_m), -1))
        return self.sampled(features, projections).sum(1)


class DeformableAttention(nn.Module):
    """Multi-scale deformable attention (Zhu et al. 2021, arXiv:2010.04159).

    Args:
        levels: number of feature levels.
        points: sampling points per head and level; they are assigned in turn to the references
            of a query.
    """

    def __init__(self, channels: int, levels: int, heads: int, points: int) -> None:
        super().__init__()
        self._shape = (heads, levels, points)
        self._value = nn.Linear(channels, channels)
        self._offset = nn.Linear(channels, heads * levels * points * 2)
        self._weight = nn.Linear(channels, heads * levels * points)
        self._out = nn.Linear(channels, channels)
        nn.init.zeros_(self._offset.weight)
        nn.init.zeros_(self._weight.weight)
        # Each head starts in a direction of its own, and its points at growing distances.
        angle = torch.arange(heads) * (2 * math.pi / heads)
        ring = torch.stack([angle.cos(), angle.sin()], -1)[:, None, None]
        steps = torch.arange(1, points + 1)[:, None]
        with torch.no_grad():
            self._offset.bias.copy_((ring * steps).expand(*self._shape, 2).reshape(-1))

    def forward(
        self,
        queries: Float[Tensor, "n q c"],
        references: Sequence[Float[Tensor, "n q z 2"]],
        is_valid: Bool[Tensor, "n q z"],
        levels: Sequence[Float[Tensor, "n c _ _"]],
    ) -> Float[Tensor, "n q c"]:
        """Return the attended values of every query.

        Args:
            references: centres of the samples in each level, in [-1, 1].
            is_valid: references that may be sampled.
        """
        heads, count, points = self._shape
        n, q, c = queries.shape
        anchor = torch.arange(points, device=queries.device) % is_valid.shape[-1]
        offsets = self._offset(queries).reshape(n, q, heads, count, points, 2)
        weights = self._weight(queries).reshape(n, q, heads, -1).softmax(-1)
        weights = weights.reshape(n, q, heads, count, points) * is_valid[:, :, None, None, anchor]
        total = queries.new_zeros(n * heads, c // heads, q)
        for k, level in enumerate(levels):
            h, w = level.shape[-2:]
            values = self._value(level.flatten(2).transpose(1, 2)).transpose(1, 2)
            values = values.reshape(n * heads, c // heads, h, w)
            places = references[k][:, :, None, anchor] + offsets[
                :, :, :, k
            ] * 2 / offsets.new_tensor([w, h])
            grid = places.permute(0, 2, 1, 3, 4).reshape(n * heads, q, points, 2)
            found = functional.grid_sample(values.to(grid.dtype), grid, align_corners=False)
            own = weights[:, :, :, k].permute(0, 2, 1, 3).reshape(n * heads, 1, q, points)
            total = total + (found * own).sum(-1)
        return self._out(total.reshape(n, c, q).transpose(1, 2))


class _Layer(nn.Module):
    """Self-attention of the cells, cross-attention to the picture, and a feed-forward network."""

    def __init__(self, config: DetectorConfig, levels: int) -> None:
        super().__init__()
        c = config.channels
        self.own = DeformableAttention(c, 1, config.heads, config.points)
        self.cross = DeformableAttention(c, levels, config.heads, config.points)
        self.feed = nn.Sequential(nn.Linear(c, 2 * c), nn.ReLU(), nn.Linear(2 * c, c))
        self.norms = nn.ModuleList(nn.LayerNorm(c) for _ in range(3))


class AttentionLift(nn.Module):
    """Encoder of BEVFormer for one picture: learned queries of all cells sample the picture around
    the projections of their pillars."""

    def __init__(self, config: DetectorConfig, strides: Sequence[int]) -> None:
        super().__init__()
        self._config, self._strides = config, tuple(strides)
        self._pillars = Pillars(config)
        self._queries = nn.Parameter(0.1 * torch.randn(config.cells**2, config.channels))
        self._layers = nn.ModuleList(
            _Layer(config, len(self._strides)) for _ in range(config.attention_layers)
        )
        axis = (torch.arange(config.cells) + 0.5) * 2 / config.cells - 1
        x, y = torch.meshgrid(axis, axis, indexing="ij")
        # `grid_sample` takes the column first.
        self.register_buffer("_places", torch.stack([y, x], -1).reshape(-1, 1, 2), persistent=False)

    def forward(
        self, levels: Sequence[Float[Tensor, "n c _ _"]], projections: Float[Tensor, "n 3 4"]
    ) -> Float[Tensor, "n c x y"]:
        """Return the features of all cells."""
        cells, size = self._config.cells, self._config.picture_px
        uv, is_shown = self._pillars(projections)
        places = [normalised(uv, stride, size) for stride in self._strides]
        x = self._queries.expand(len(uv), -1, -1)
        own_places = self.get_buffer("_places").expand(len(uv), -1, -1, -1)
        always = torch.ones_like(own_places[..., 0], dtype=torch.bool)
        for layer in self._layers:
            assert isinstance(layer, _Layer)
            grid = x.transpose(1, 2).reshape(len(uv), -1, cells, cells)
            x = layer.norms[0](x + layer.own(x, [own_places], always, [grid]))
            x = layer.norms[1](x + layer.cross(x, places, is_shown, levels))
            x = layer.norms[2](x + layer.feed(x))
        return x.transpose(1, 2).reshape(len(uv), -1, cells, cells)
