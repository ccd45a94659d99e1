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
    truncation_voxels: float = 3.0
    """Distances are clipped to this many samples on either side of a surface."""
    actor_voxel_m: float = 0.06
    """Sample distance of the actors' own grids."""
    actor_min_points: int = 60
    """Actors with fewer returns over the whole log get no grid."""
    actor_fine_points: int = 4000
    """Actors with fewer returns than this get samples of twice the distance."""
    azimuth_step_deg: float = 0.15
    """Column width of the interpolated range images."""
    elevation_step_deg: float = 0.1
    """Row height of the interpolated range images."""
    max_incidence_deg: float = 82.0
    """Steeper triangles between neighbouring beams are taken for depth jumps."""
    max_gap_deg: float = 2.5
    """Beams further apart than this are not joined, except on the ground."""
    max_edge_m: float = 2.5
    """Returns further apart than this are not joined, except on the ground."""
    max_ground_edge_m: float = 8.0
    """The same limit between returns of the ground."""
    ground_band_m: float = 0.3
    """Returns within this height of the ground map count as ground."""
    ground_cell_m: float = 0.5
    """Cell of the ground map."""
    slice_motion_m: float = 0.3
    """A sweep is cut in time where the sensor moved further than this."""
    every_nth_sweep: int = 1
    """Fuse only every n-th sweep."""
    max_height_m: float = 40.0
    """Nothing higher than this above the path is fused."""


def draft() -> FuseConfig:
    """A quick look: coarser samples, every second sweep."""
    return FuseConfig(voxel_m=(0.15, 0.3, 0.6), actor_voxel_m=0.08, every_nth_sweep=2)


def standard() -> FuseConfig:
    return FuseConfig()


def paper() -> FuseConfig:
    """The paper fuses nothing; its field is read out on the samples of `standard`."""
    return FuseConfig()
