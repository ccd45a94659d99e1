"""Options of reading a log, used by readers, builds and the log artefact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from lightsim.core.checks import check_choice, check_image_scale, check_number
from lightsim.core.extensions import READERS, registered
from lightsim.core.option_types import Names
from lightsim.errors import InputError

OWN_DATASETS = ("pandaset",)
"""Formats with a reader in datasets/; other packages register more."""


def dataset_names() -> tuple[str, ...]:
    """Return the names that --dataset accepts besides auto; extensions are not imported."""
    return (*OWN_DATASETS, *(name for name in registered(READERS) if name not in OWN_DATASETS))


@dataclass(frozen=True, kw_only=True)
class LogReading:
    """Options of reading a recording; the same options give the same log."""

    source: Positional[Annotated[str, arg(metavar="SOURCE")]]
    """Folder of the recording."""
    dataset: str = "auto"
    """Format of the recording: auto (by the layout of the folder) or pandaset; other packages add
    formats."""
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

    def __post_init__(self) -> None:
        check_choice("--dataset", self.dataset, ("auto", *dataset_names()))
        check_image_scale(self.image_scale)
        if self.heading_deg is not None:
            check_number("--heading-deg", self.heading_deg, -360.0, 360.0)
        if self.hold_out < 0 or self.hold_out == 1:
            raise InputError(
                "no frame would remain for the build" if self.hold_out == 1 else "out of range",
                where="--hold-out",
                got=self.hold_out,
                expected="0 for none, or 2 and more: every n-th frame",
            )
