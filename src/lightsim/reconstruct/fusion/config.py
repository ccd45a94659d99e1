"""Settings of the LiDAR fusion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FuseConfig:
    """How a log's LiDAR becomes signed-distance grids."""

    voxel_m: tuple[float, ...] = (0.1, 0.2, 0.4)
    """Sample distance of each background level, finest first."""
    radius_m: tuple[float, ...] = (18.0, 50.0, 100.0)
    """Each level reaches this far from the path, horizontally."""
    actor_voxel_m: float = 0.06
    """Sample distance of the actors' own grids."""
    azimuth_step_deg: float = 0.15
    """Column width of the interpolated range images."""
    elevation_step_deg: float = 0.1
    """Row height of the interpolated range images."""
    every_nth_sweep: int = 1
    """Fuse only every n-th sweep."""


def draft() -> FuseConfig:
    """A quick look: coarser samples, every second sweep."""
    return FuseConfig(voxel_m=(0.15, 0.3, 0.6), actor_voxel_m=0.08, every_nth_sweep=2)


def standard() -> FuseConfig:
    """10 cm samples near the path, from every sweep."""
    return FuseConfig()


@dataclass(frozen=True)
class OccupiedConfig:
    """Where a field that nothing is fused for is read out: the samples of `standard`."""

    voxel_m: tuple[float, ...] = (0.1, 0.2, 0.4)
    """Sample distance of each background level, finest first."""
    radius_m: tuple[float, ...] = (18.0, 50.0, 100.0)
    """Each level reaches this far from the path, horizontally."""
    actor_voxel_m: float = 0.06
    """Sample distance in the boxes of actors."""


def paper() -> OccupiedConfig:
    """The paper fuses nothing."""
    return OccupiedConfig()
