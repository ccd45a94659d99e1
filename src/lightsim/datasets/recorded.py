"""Contents of a recording, as readers supply them; assemble.py makes a `DrivingLog` of them.

A reader translates names, units and time stamps of its data set, and nothing else: what all data
sets need (pinhole views, frames of unsynchronised cameras, motion of sensors, place and north,
checks) is in assemble.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.geo import Located
from lightsim.datasets.lenses import Lens


class ReadoutDirection(StrEnum):
    """Order in which a rolling shutter reads the rows or columns of a picture."""

    TOP_TO_BOTTOM = "top_to_bottom"
    BOTTOM_TO_TOP = "bottom_to_top"
    LEFT_TO_RIGHT = "left_to_right"
    RIGHT_TO_LEFT = "right_to_left"


class StampedMoment(StrEnum):
    """Moment of the readout of a picture to which its time stamp refers."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


@dataclass(frozen=True)
class Readout:
    """Rolling shutter of a camera; 0 s is a global shutter.

    Args:
        other_axis_s: seconds to the right (of a readout by rows) or down (of one by columns), in
            pictures that were resampled from a lens, whose rows are not those of the sensor.
    """

    seconds: float = 0.0
    direction: ReadoutDirection = ReadoutDirection.TOP_TO_BOTTOM
    stamp: StampedMoment = StampedMoment.MIDDLE
    other_axis_s: float = 0.0

    @property
    def down_s(self) -> float:
        """Seconds from the top to the bottom of the picture."""
        signs = {ReadoutDirection.TOP_TO_BOTTOM: 1.0, ReadoutDirection.BOTTOM_TO_TOP: -1.0}
        sign = signs.get(self.direction)
        return self.other_axis_s if sign is None else sign * self.seconds

    @property
    def across_s(self) -> float:
        """Seconds from the left to the right of the picture."""
        signs = {ReadoutDirection.LEFT_TO_RIGHT: 1.0, ReadoutDirection.RIGHT_TO_LEFT: -1.0}
        sign = signs.get(self.direction)
        return self.other_axis_s if sign is None else sign * self.seconds

    @property
    def middle_s(self) -> float:
        """Seconds from the stamped moment to the middle of the readout."""
        moments = {StampedMoment.START: 0.5, StampedMoment.MIDDLE: 0.0, StampedMoment.END: -0.5}
        return moments[self.stamp] * self.seconds


@dataclass(frozen=True, eq=False)
class RecordedPicture:
    """One picture.

    Args:
        time_ns: time stamp, of the moment that the camera's `Readout.stamp` names.
        path: file, for messages.
        load: returns the pixels as stored, sRGB of 8 bits.
        world_from_camera: pose at `time_ns` if the data set has one for each picture; otherwise
            it follows from the ego path.
        motion_world: linear and angular velocity of the camera, m/s and rad/s, if the data set
            has them; otherwise they follow from the ego path.
    """

    time_ns: int
    path: Path
    load: Callable[[], UInt8[np.ndarray, "h w 3"]]
    world_from_camera: RigidTransform | None = None
    motion_world: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None


@dataclass(frozen=True, eq=False)
class RecordedCamera:
    """One camera.

    Args:
        mask: True where it shows the ego vehicle itself, at the size of the pictures; None if the
            data set has no such mask.
    """

    name: str
    lens: Lens
    ego_from_camera: RigidTransform
    pictures: tuple[RecordedPicture, ...]
    readout: Readout = Readout()
    mask: Bool[np.ndarray, "h w"] | None = None


class PointFrame(StrEnum):
    """Frame of the points of a sweep."""

    OWN_TIME = "ego at each point's own time"
    SWEEP_TIME = "ego at the sweep's time: motion compensated"
    WORLD = "world"


@dataclass(frozen=True, eq=False)
class RawSweep:
    """Returns of one sweep, as stored.

    Args:
        points: metres, in the frame that `frame` names; WORLD is the recording's own world frame.
        origins_ego: position of the sensor in frame `ego`, one for all or one for each point.
        intensity: reflectance, scaled to [0, 1].
        time_offset_s: seconds from the sweep's `time_ns`; None if the data set has no times.
        ring: laser index; None if unknown.
        semantic_class: class ids of the data set; None if unlabelled.
        origins_world: position of the sensor at the time of each point, in the recording's own
            world frame; replaces `origins_ego`.
        full_scale: stored intensity that became 1.
    """

    points: Float[np.ndarray, "n 3"]
    frame: PointFrame
    origins_ego: Float[np.ndarray, "3"] | Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    time_offset_s: Float[np.ndarray, " n"] | None = None
    ring: Int[np.ndarray, " n"] | None = None
    semantic_class: Int[np.ndarray, " n"] | None = None
    origins_world: Float[np.ndarray, "n 3"] | None = None
    full_scale: float = 1.0


class PointsProvenance(StrEnum):
    """Source of the points of a sweep."""

    LIDAR = "LiDAR"
    GIVEN = "given points"


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """A sweep that is read when `load` is called.

    Args:
        time_ns: reference of the points' time offsets; motion-compensated points are in the ego
            frame of this time.
        path: file, for messages.
        provenance: points that are GIVEN are of the whole log, not of one time: they belong to its
            first selected frame, whichever that is.
    """

    time_ns: int
    path: Path
    load: Callable[[], RawSweep]
    provenance: PointsProvenance = PointsProvenance.LIDAR


@dataclass(frozen=True, eq=False)
class RecordedLog:
    """A recording in its own world frame (metres, z up), with all of its frames and cameras.

    Args:
        ego: `world_from_ego`. Frame `ego`: x forward, y left, z up, its origin on the road.
        sweeps: sweeps of each LiDAR, in time order.
        actors: tracks in the recording's world frame.
        licence: name of the recording's licence, which exports repeat.
        has_heights: whether the ego path contains heights (`DrivingLog.has_heights`).
    """

    name: str
    cameras: tuple[RecordedCamera, ...]
    ego: Trajectory
    sweeps: Mapping[str, tuple[RecordedSweep, ...]] = field(default_factory=dict)
    actors: tuple[ActorTrack, ...] = ()
    located: Located = field(default_factory=Located)
    semantic_names: Mapping[int, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    licence: str = ""
    has_heights: bool = True
