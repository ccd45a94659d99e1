"""What is aligned, and how far it may move."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lightsim.errors import InputError

PARTS = (
    "rolling_shutter",
    "point_times",
    "ego_vehicle_masks",
    "lidar_poses",
    "actor_tracks",
    "camera_poses",
)
OTHER_PARTS = ("camera_gains",)
"""Physics of the log that other stages take care of and the same option switches."""


# Each part as a whole is measured (docs/decisions/0004-alignment-stage.md), none of these alone.

# Every n-th sweep or frame judges a correction instead of shaping it.
HELD_BACK = 4


@dataclass(frozen=True)
class AlignConfig:
    """Which parts of a log are refined. A correction is kept only where returns or pictures that
    it was not fitted to agree better with it."""

    rolling_shutter: bool = True
    """Keep the shutters that the log's reader gave the frames."""
    point_times: bool = True
    """Each return has its own time and origin; else those of its sweep's middle."""
    ego_vehicle_masks: bool = True
    """Leave the ego vehicle out of its pictures."""
    lidar_poses: bool = True
    """Refine the ego's path by the agreement of the sweeps."""
    actor_tracks: bool = True
    """Give parked vehicles one constant box, and place moving ones by their returns."""
    camera_poses: bool = True
    """Refine the mounting and the time offset of each camera by depth edges."""
    least_gain: float = 0.005
    """By which fraction the held-back score must improve for a correction to be kept."""
    plane_voxel_m: float = 0.2
    """Edge of the voxels to which all sweeps together are thinned for the map."""
    points_per_sweep: int = 4000
    """Returns of each sweep that are compared with the map."""

    def without(self, parts: tuple[str, ...]) -> AlignConfig:
        """The same with some parts switched off.

        Raises:
            InputError: a name is not one of PARTS or OTHER_PARTS.
        """
        for part in parts:
            if part not in (*PARTS, *OTHER_PARTS):
                raise InputError(
                    f"'{part}' is not a part of the alignment",
                    where="--no-refine",
                    expected=f"one or more of {', '.join((*PARTS, *OTHER_PARTS))}",
                )
        return replace(self, **{part: False for part in parts if part in PARTS})
