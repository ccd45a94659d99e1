"""Options of reading a log, used by readers, builds and the log artefact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from lightsim.core.checks import check_choice, check_image_scale, check_number
from lightsim.core.extensions import READERS, registered
from lightsim.core.option_types import Names
from lightsim.core.solar import parse_utc
from lightsim.errors import InputError

OWN_DATASETS = (
    "pandaset",
    "lightsim",
    "nuscenes",
    "argoverse2",
    "waymo",
    "kitti",
    "kitti360",
    "dgp",
)
"""Formats with a reader in datasets/; other packages register more."""


def dataset_names() -> tuple[str, ...]:
    """Return the names that --dataset accepts besides auto; extensions are not imported."""
    return (*OWN_DATASETS, *(name for name in registered(READERS) if name not in OWN_DATASETS))


@dataclass(frozen=True, kw_only=True)
class LogReading:
    """Options of reading a recording; the same options give the same log."""

    source: Positional[Annotated[str, arg(metavar="SOURCE")]]
    """Folder or file of the recording, or a data set of many with --scene."""
    dataset: str = "auto"
    """Format of the recording: auto (by its layout), pandaset, lightsim, nuscenes, argoverse2,
    waymo, kitti, kitti360 or dgp; other packages add formats."""
    scene: str = ""
    """Name of one recording in a SOURCE that has many, such as scene-0061 in nuScenes."""
    frames: str = ""
    """START:STOP[:STEP] over the log's frame numbers; empty for all."""
    cameras: Names = ()
    """Comma-separated camera names; empty for all."""
    hold_out: int = 0
    """Keep every n-th frame and sweep from the build, for evaluation; 0 keeps none."""
    image_scale: float = 0.5
    """Factor on the image size."""
    heading_deg: float | None = None
    """Azimuth of the world x axis, clockwise from true north, for logs that do not contain it."""
    place: str = ""
    """LATITUDE,LONGITUDE of the drive, degrees, for logs that do not contain it."""
    utc: str = ""
    """UTC time of the log's first picture, such as 2019-04-27T18:17:00, for logs without one."""
    sun: str = ""
    """AZIMUTH,ELEVATION of the recorded sun, degrees, instead of that of place and time."""

    def __post_init__(self) -> None:
        check_choice("--dataset", self.dataset, ("auto", *dataset_names()))
        check_image_scale(self.image_scale)
        if self.heading_deg is not None:
            check_number("--heading-deg", self.heading_deg, -360.0, 360.0)
        # Parsed for their errors; readers call them again.
        _ = self.place_deg, self.sun_deg, self.utc and self.utc_ns
        if self.hold_out < 0 or self.hold_out == 1:
            raise InputError(
                "no frame would remain for the build" if self.hold_out == 1 else "out of range",
                where="--hold-out",
                got=self.hold_out,
                expected="0 for none, or 2 and more: every n-th frame",
            )

    @property
    def place_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of --place; None without the option."""
        return _pair("--place", self.place, "LATITUDE,LONGITUDE", (-90.0, 90.0), (-180.0, 180.0))

    @property
    def sun_deg(self) -> tuple[float, float] | None:
        """Azimuth and elevation of --sun; None without the option."""
        return _pair("--sun", self.sun, "AZIMUTH,ELEVATION", (-360.0, 360.0), (0.0, 90.0))

    @property
    def utc_ns(self) -> int:
        """UTC time of --utc, in nanoseconds since 1970.

        Raises:
            InputError: not an ISO 8601 time.
        """
        form = "ISO 8601, such as 2019-04-27T18:17:00 (UTC without an offset)"
        return parse_utc(self.utc, "--utc", form)


def _pair(
    option: str,
    text: str,
    form: str,
    first: tuple[float, float],
    second: tuple[float, float],
) -> tuple[float, float] | None:
    """Return the two numbers of an option within their limits; None for an empty text."""
    if not text:
        return None
    words = text.split(",")
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 2:
        raise InputError(
            "not two numbers", where=option, got=repr(text)[:60], expected=f"{form}, degrees"
        )
    check_number(option, values[0], *first)
    check_number(option, values[1], *second)
    return values[0], values[1]
