"""Settings of the step from fields to meshes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshConfig:
    """How fields become meshes, before they are coloured."""

    min_weight: float = 0.03
    """Grid samples with less evidence than this count as unknown."""
    min_piece_m2: float = 0.25
    """Connected pieces of the background smaller than this are dropped."""
    normal_rounds: int = 4
    """Rounds of normal filtering; 0 leaves the surface as extracted."""
    max_move_voxels: float = 0.2
    """Filtering moves no vertex further than this many samples of its level."""
    error_voxels: float = 0.1
    """Simplification may deviate by this many samples of a level (RMS); 0 keeps every face."""
    edge_voxels: float = 6.0
    """Simplification makes no edge longer than this many samples of a level."""
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
    ground_reach_m: float = 40.0
    """Holes are closed up to this far from observed ground."""
    ground_trim_rounds: int = 2
    """Rounds of taking the ground's open edges away before its holes are closed."""


def draft() -> MeshConfig:
    return MeshConfig()


def standard() -> MeshConfig:
    return MeshConfig()


def paper() -> MeshConfig:
    return MeshConfig()
