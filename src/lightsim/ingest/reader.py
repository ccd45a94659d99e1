"""The one way in for recordings: `read_log`, over the one table of data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.core.log import DrivingLog
from lightsim.errors import InputError
from lightsim.ingest.pandaset import is_pandaset, read_pandaset

Dataset = Literal["pandaset"]


ReadDataset = Callable[[Path, tuple[str, ...], str, float | None], DrivingLog]
"""(source, cameras, frames as "START:STOP[:STEP]", heading_deg) -> the recording."""


@dataclass(frozen=True)
class LogReader:
    """How a data set is recognised and read."""

    detect: Callable[[Path], bool]
    read: ReadDataset


READERS: dict[Dataset, LogReader] = {
    "pandaset": LogReader(is_pandaset, read_pandaset),
}


def read_log(
    source: Path,
    *,
    dataset: str = "auto",
    cameras: tuple[str, ...] = (),
    frames: str = "",
    heading_deg: float | None = None,
) -> DrivingLog:
    """The recording in a folder.

    Args:
        source: the folder of one recording.
        dataset: a name of `Dataset`, or "auto" to recognise it by its layout.
        cameras: names of the cameras wanted; () for all.
        frames: "START:STOP[:STEP]" over frame numbers, STOP not included, for pictures and sweeps
            alike; "" for all.
        heading_deg: azimuth (clockwise from true north) of world +x; replaces the GPS fit.

    Raises:
        InputError: the folder is of no known data set, or a file in it is missing or broken.
    """
    if not source.is_dir():
        raise InputError(
            "no such folder", where=source, remedy="SOURCE is the folder of one recording."
        )
    return READERS[_dataset_of(source, dataset)].read(source, cameras, frames, heading_deg)


def _dataset_of(source: Path, dataset: str) -> Dataset:
    names: tuple[Dataset, ...] = get_args(Dataset)
    for name in names:
        if dataset == name or (dataset == "auto" and READERS[name].detect(source)):
            return name
    if dataset != "auto":
        raise InputError(
            f"unknown data set '{dataset}'",
            where="--dataset",
            expected=f"auto or one of {', '.join(names)}",
        )
    raise InputError(
        "the folder has the layout of no known data set",
        where=source,
        expected=f"one of {', '.join(names)}",
        remedy="PandaSet: give the folder of one sequence, such as pandaset/002.",
    )
