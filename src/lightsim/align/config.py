"""Settings of the alignment: the parts of a log to refine and the acceptance of corrections."""

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
"""Parts that `--no-refine` also switches off but that another stage estimates."""

# Every n-th sweep or frame is held back from the fit; a correction is accepted if it improves
# them. A quarter leaves most data for the fit; other values are not measured.
HELD_BACK = 4


@dataclass(frozen=True)
class AlignConfig:
    """Parts of a log that are refined, and the settings of the fit.

    A correction is accepted only if held-back returns or images agree better with it.
    """

    rolling_shutter: bool = True
    """Retain the rolling shutter that the log's reader assigned to the frames."""
    point_times: bool = True
    """Use the time and origin of each return; otherwise those of the middle of its sweep."""
    ego_vehicle_masks: bool = True
    """Exclude pixels of the ego vehicle."""
    lidar_poses: bool = True
    """Refine the ego path by point-to-plane distances between sweeps."""
    actor_tracks: bool = True
    """Assign parked vehicles one constant box, and move boxes of moving vehicles by returns."""
    camera_poses: bool = True
    """Refine the mounting and the time offset of each camera by depth edges."""
    least_gain: float = 0.005
    """Least relative improvement of the held-back score for a correction to be accepted."""
    plane_voxel_m: float = 0.2
    """Edge of the voxels to which all sweeps together are thinned for the map."""
    points_per_sweep: int = 4000
    """Returns of each sweep that are compared with the map."""

    def without(self, parts: tuple[str, ...]) -> AlignConfig:
        """Return a copy with some parts switched off.

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
