"""Settings of the step from meshes to coloured meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = Literal["texture", "vertex", "field"]

# The next three values were chosen on synthetic streets; their sensitivity was not measured.

# Horizontal distance from the driven path up to which unobserved ground and house fronts have
# texels and are completed along the street, in metres.
HIDDEN_REACH_M = 14.0
# Least z component of the unit normal of ground.
MIN_GROUND_NORMAL_Z = 0.8
# Least cosine between the horizontal normal of a house front and the direction to the path.
MIN_FRONT_COSINE = 0.7


@dataclass(frozen=True)
class AssetConfig:
    """Settings of the texture bake."""

    colour: Colour = "texture"
    """"texture": baked from the images. "vertex": mean of the texels around each vertex.
    "field": colour of the neural field at each vertex, as in the paper."""
    max_texels: int = 12_000_000
    """Most texels of all meshes together; if more are required, all texels grow by one factor."""
    samples_per_texel: int = 8
    """Number of samples with the largest weights that each texel stores."""
    every_nth_frame: int = 1
    """Sample only every n-th image of each camera."""
    occlusion_tolerance_m: float = 0.12
    """A surface closer than this in front of a texel does not occlude it (plus 1 % of the
    depth)."""
    shade_margin_m: float = 2.0
    """Background within this distance of a moving actor may lie in its shadow and is not sampled in
    that frame; without any other frame its colour is interpolated."""
    contact_margin_m: float = 0.25
    """Background within this distance of a resting actor receives little light, and the actor's
    mesh is incomplete there: its confidence is 0, and its base colour is interpolated."""
    outlier_ratio: float = 1.4
    """Samples that differ from a texel's median brightness by more than this factor are ignored."""
    has_camera_gains: bool = True
    """Estimate the exposure and white balance of each camera."""


def draft() -> AssetConfig:
    """Preview settings: every fourth image, 6 samples a texel, half of the texels."""
    return AssetConfig(every_nth_frame=4, samples_per_texel=6, max_texels=6_000_000)


def standard() -> AssetConfig:
    """Default settings: textures of up to 12 million texels from all images."""
    return AssetConfig()


def paper() -> AssetConfig:
    """Vertex colours of the paper (its appendix: "querying the appearance head")."""
    return AssetConfig(colour="field")
