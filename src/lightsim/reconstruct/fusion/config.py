"""Settings of the LiDAR fusion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class _GridConfig:
    """Sizes of signed-distance grids."""

    voxel_m: tuple[float, ...] = (0.1, 0.2, 0.4)
    """Sample distance of each background level, finest first."""
    radius_m: tuple[float, ...] = (18.0, 50.0, 100.0)
    """Horizontal distance from the path up to which each level extends."""
    actor_voxel_m: float = 0.06
    """Sample distance of the actors' grids."""


@dataclass(frozen=True)
class FuseConfig(_GridConfig):
    """Settings of the fusion of LiDAR sweeps into signed-distance grids."""

    azimuth_step_deg: float = 0.15
    """Column width of the interpolated range images."""
    elevation_step_deg: float = 0.1
    """Row height of the interpolated range images."""
    every_nth_sweep: int = 1
    """Fuse only every n-th sweep."""


def draft() -> FuseConfig:
    """Preview settings: coarser samples, every second sweep."""
    return FuseConfig(voxel_m=(0.15, 0.3, 0.6), actor_voxel_m=0.08, every_nth_sweep=2)


def standard() -> FuseConfig:
    """Default settings: 10 cm samples near the path, from every sweep."""
    return FuseConfig()


@dataclass(frozen=True)
class OccupiedConfig(_GridConfig):
    """Grids at whose samples a neural field without LiDAR fusion is evaluated."""


def paper() -> OccupiedConfig:
    """Settings of the paper, which does not fuse LiDAR."""
    return OccupiedConfig()
