"""Settings of the step from meshes to coloured meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = Literal["texture", "vertex", "field"]

HIDDEN_REACH_M = 14.0
"""As far beside the path, ground and fronts that nobody saw have texels, and are completed along
it."""
LEVEL_NORMAL = 0.8
"""Ground faces up at least this much."""
FRONT_FACING = 0.7
"""Fronts face the path at least this much (cosine)."""


@dataclass(frozen=True)
class AssetConfig:
    """How meshes get their colour."""

    colour: Colour = "texture"
    """"texture": baked from the images. "vertex": its mean around each vertex. "field": the
    neural field's k_d at each vertex, as the paper does."""
    max_texels: int = 12_000_000
    """Of all meshes together; where more are wanted, all texels grow."""
    samples_per_texel: int = 8
    """The best views kept for each texel."""
    every_nth_frame: int = 1
    """Use only every n-th image of each camera for colours."""
    occlusion_tolerance_m: float = 0.12
    """A surface this far in front of a texel does not hide it (plus 1 % of the depth)."""
    shade_margin_m: float = 2.0
    """The static scene this near a moving actor may lie in its shade: what was never seen without
    it takes the colour of what lies around."""
    contact_margin_m: float = 0.25
    """This near an actor at rest hardly any light arrives, and its reconstruction ends too soon:
    the base colour of what lies there is that of what lies around."""
    outlier_ratio: float = 1.4
    """Views that differ from a texel's median brightness by more than this are ignored."""
    has_camera_gains: bool = True
    """Find the exposure and white balance of each camera."""
    gain_strength: float = 200.0
    """Shared places at which a camera pair weighs as much as the prior of equal gains."""


def draft() -> AssetConfig:
    """A quick look: every fourth image, 6 views a texel, half of the texels."""
    return AssetConfig(every_nth_frame=4, samples_per_texel=6, max_texels=6_000_000)


def standard() -> AssetConfig:
    """Textures of up to 12 million texels from all images."""
    return AssetConfig()


def paper() -> AssetConfig:
    """The paper's vertex colours (its appendix: "querying the appearance head")."""
    return AssetConfig(colour="field")
