"""Sizes of the detector, and settings of its training."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from lightsim.networks.loop import LoopConfig

Lift = Literal["bilinear", "attention"]
DetectorPreset = Literal["test", "small", "paper"]


@dataclass(frozen=True, kw_only=True)
class DetectorConfig:
    """Settings of the detector; the defaults are those of the preset `small`, for a CPU.

    The region of interest is that of the paper: 0 to `reach_m` ahead of the camera, and half of it
    to either side.
    """

    picture_px: tuple[int, int] = (480, 272)
    """Width and height of the network's input, multiples of 16; pictures are scaled to the width
    and padded or cropped at the bottom."""
    reach_m: float = 80.0
    """Length and width of the region of interest, as in the paper."""
    cells: int = 80
    """Cells of the bird's-eye view along each axis."""
    heights_m: tuple[float, ...] = (-1.6, -0.9, -0.2, 0.5)
    """Heights above the camera at which the pictures are sampled: from the road to the roofs of
    cars for cameras 1.6 m above the road. Sensitivity not measured."""
    channels: int = 48
    """Channels of all features after the trunk."""
    bev_layers: int = 4
    """Residual convolutions on the bird's-eye view."""
    lift: Lift = "bilinear"
    """Step from pictures to bird's-eye view: bilinear samples of the finest level, or BEVFormer's
    encoder (`lift.AttentionLift`)."""
    attention_layers: int = 3
    """Layers of the encoder; BEVFormer-small has 3."""
    heads: int = 8
    """Attention heads; BEVFormer-small has 8."""
    points: int = 8
    """Sampling points per head and level; BEVFormer-small has 8."""
    is_trunk_frozen: bool = True
    """The trunk is not trained, so that its features are computed once."""
    rate: float = 1e-3
    """Highest learning rate of AdamW. Not tuned."""
    trunk_rate: float = 2e-4
    """Highest learning rate of a trunk that is not frozen. Not tuned."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW, as in BEVFormer."""
    batch: int = 4
    """Pictures per step, half of them recorded and half from the row's second source."""
    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            1000, warm_up_steps=50, largest_gradient=35.0, is_mixed_on_cpu=True
        )
    )
    """Optimiser steps; gradients are clipped at BEVFormer's norm."""

    @property
    def cell_m(self) -> float:
        """Side of a cell, in metres."""
        return self.reach_m / self.cells


def config_of(preset: DetectorPreset) -> DetectorConfig:
    """Return the settings of a preset.

    `paper` has the numbers of BEVFormer-small (bevformer_small.py): 150 x 150 cells, 4 heights,
    256 channels, 3 encoder layers, 8 heads and points, AdamW with 2e-4, trunk at a tenth of it,
    weight decay .01. It differs in its trunk (EfficientNet-Lite0 instead of R101-DCN), in its head
    (centre head instead of 6 decoder layers with 900 queries), and has no history of frames.
    """
    if preset == "small":
        return DetectorConfig()
    if preset == "test":
        loop = LoopConfig(60, warm_up_steps=10, largest_gradient=35.0)
        return DetectorConfig(picture_px=(240, 144), cells=40, channels=24, bev_layers=2, loop=loop)
    return DetectorConfig(
        picture_px=(704, 400),
        cells=150,
        channels=256,
        lift="attention",
        is_trunk_frozen=False,
        rate=2e-4,
        trunk_rate=2e-5,
        # Steps and batch of the protocol, not of the paper (five epochs of 2 x 2 pictures).
        loop=LoopConfig(4000, warm_up_steps=500, largest_gradient=35.0, mixed_precision=True),
    )
