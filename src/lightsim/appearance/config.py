"""Settings of the step from meshes to coloured meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = Literal["texture", "vertex", "field"]


@dataclass(frozen=True)
class AssetConfig:
    """How meshes get their colour."""

    colour: Colour = "texture"
    """"texture": baked from the images. "vertex": its mean around each vertex. "field": the
    neural field's k_d at each vertex, as the paper does."""
    texel_m: float = 0.01
    """No texel is smaller than this; it is as large as the finest pixel that saw it."""
    max_resolution: int = 32
    """Most texels along the edge of a face."""
    max_texels: int = 12_000_000
    """Of all meshes together; where more are wanted, all texels grow."""
    samples_per_texel: int = 8
    """The best views kept for each texel."""
    every_nth_frame: int = 1
    """Use only every n-th image of each camera for colours."""
    depth_step_px: int = 2
    """Visibility is tested against a depth image with one ray for this many pixels."""
    max_view_m: float = 400.0
    """Surfaces further from a camera take no colour from it; the backdrop is nearer."""
    sharpness_power: float = 1.0
    """A view counts by the pixels it has on a unit of surface, to this power."""
    occlusion_tolerance_m: float = 0.12
    """A surface this far in front of a texel does not hide it (plus 1 % of the depth)."""
    edge_step: float = 0.05
    """Inverse depth that bends by more than this share from pixel to pixel is an outline."""
    edge_radius_px: int = 4
    """Pixels this near an outline may show another surface."""
    edge_weight: float = 0.1
    """They count this much."""
    shade_margin_m: float = 1.0
    """The static scene this near a moving actor may lie in its shade and counts little."""
    clipped_code: int = 250
    """Pixels with a channel at or above this 8-bit code count little."""
    outlier_ratio: float = 1.4
    """Views that differ from a texel's median brightness by more than this are ignored."""
    has_camera_gains: bool = True
    """Find the exposure and white balance of each camera."""
    gain_strength: float = 200.0
    """Shared places at which a camera pair weighs as much as the prior of equal gains."""
    gain_samples: int = 200_000
    """Texels from which the gains are found."""


def draft() -> AssetConfig:
    return AssetConfig(every_nth_frame=4, samples_per_texel=6, max_texels=6_000_000)


def standard() -> AssetConfig:
    return AssetConfig()


def paper() -> AssetConfig:
    """The paper's vertex colours (its appendix: "querying the appearance head")."""
    return AssetConfig(colour="field")
