"""Settings of the step from fields to coloured meshes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AssetConfig:
    """How fields become coloured meshes."""

    min_weight: float = 0.03
    """Grid samples with less evidence than this count as unknown."""
    min_piece_m2: float = 0.25
    """Connected pieces of the background smaller than this are dropped."""
    smoothing_rounds: int = 3
    """Rounds of fair smoothing of the background."""
    mirror_weight: float = 0.2
    """Evidence from a vehicle's mirrored half counts this much."""
    prior_weight: float = 0.03
    """Evidence of the box's default shape, decisive only where no ray has been."""
    ground_cell_m: float = 0.25
    """Grid on which holes in the ground are found and closed."""
    ground_radius_m: float = 40.0
    """Holes are closed up to this distance from the path."""
    ground_band_m: float = 0.35
    """A surface within this height of the ground map counts as ground."""
    ground_reach_m: float = 8.0
    """Holes are closed up to this far from observed ground."""
    samples_per_vertex: int = 10
    """The best views kept for each vertex."""
    every_nth_frame: int = 1
    """Use only every n-th image of each camera for colours."""
    max_view_m: float = 120.0
    """Vertices further from a camera take no colour from it."""
    occlusion_tolerance_m: float = 0.12
    """A surface this far in front of a vertex does not hide it (plus 1 % of the distance)."""
    clipped_code: int = 250
    """Pixels with a channel at or above this 8-bit code count little."""
    outlier_ratio: float = 1.4
    """Views that differ from a vertex's median brightness by more than this are ignored."""
    gain_strength: float = 200.0
    """Shared vertices at which a camera pair weighs as much as the prior of equal gains."""


def draft() -> AssetConfig:
    return AssetConfig(every_nth_frame=4, samples_per_vertex=6)


def standard() -> AssetConfig:
    return AssetConfig()


def paper() -> AssetConfig:
    return AssetConfig(samples_per_vertex=16)
