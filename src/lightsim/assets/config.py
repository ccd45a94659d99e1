"""Settings of the step from meshes to coloured meshes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AssetConfig:
    """How meshes get their colour."""

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
