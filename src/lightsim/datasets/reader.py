"""The one way in for recordings: `read_log`, over the one table of data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.core.log import DrivingLog, FindEgoVehicle, without_ego_vehicle
from lightsim.datasets.layout import has_folder
from lightsim.datasets.pandaset.log import is_pandaset, read_pandaset
from lightsim.errors import InputError
from lightsim.store.names import is_harmless

Dataset = Literal["pandaset"]


ReadDataset = Callable[[Path, tuple[str, ...], str, float | None, FindEgoVehicle], DrivingLog]
"""(source, cameras, frames as "START:STOP[:STEP]", heading_deg, find_ego_vehicle) -> recording."""


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
    find_ego_vehicle: FindEgoVehicle = without_ego_vehicle,
) -> DrivingLog:
    """The recording in a folder.

    Args:
        source: the folder of one recording.
        dataset: a name of `Dataset`, or "auto" to recognise it by its layout.
        cameras: names of the cameras wanted; () for all.
        frames: "START:STOP[:STEP]" over frame numbers, STOP not included, for pictures and sweeps
            alike; "" for all.
        heading_deg: azimuth (clockwise from true north) of world +x; replaces the GPS fit.
        find_ego_vehicle: finds the recording car in the pictures; by default nobody looks.

    Raises:
        InputError: the folder is of no known data set, or a file in it is missing or broken.
    """
    log = READERS[check_layout(source, dataset)].read(
        source, cameras, frames, heading_deg, find_ego_vehicle
    )
    _check_camera_names(log, source)
    return log


def check_layout(source: Path, dataset: str = "auto") -> Dataset:
    """The data set whose layout a folder has. Only a few names are looked up, so this may be asked
    of any folder, before it is walked or hashed.

    Raises:
        InputError: no such folder, or not of this data set, or of none.
    """
    if not has_folder(source):
        raise InputError(
            "no such folder", where=source, remedy="SOURCE is the folder of one recording."
        )
    names: tuple[Dataset, ...] = get_args(Dataset)
    if dataset not in ("auto", *names):
        raise InputError(
            f"unknown data set '{dataset}'",
            where="--dataset",
            expected=f"auto or one of {', '.join(names)}",
        )
    for name in names:
        if dataset in ("auto", name) and READERS[name].detect(source):
            return name
    raise InputError(
        "the folder has the layout of no known data set",
        where=source,
        expected=dataset if dataset != "auto" else f"one of {', '.join(names)}",
        remedy="PandaSet: give the folder of one sequence, such as pandaset/002.",
    )


def _check_camera_names(log: DrivingLog, source: Path) -> None:
    """Every stage writes files under the cameras' names, of whatever data set."""
    names: dict[str, str] = {}
    for name in log.cameras:
        other = names.setdefault(name.casefold(), name)
        if not is_harmless(name) or other != name:
            raise InputError(
                "a camera's name must be fit to name files, without regard to case",
                where=source,
                got=repr(name)[:90] if other == name else f"'{other}' and '{name}'",
                expected="letters, digits, '_', '-' and '.', a letter or digit first",
                remedy="Rename the camera.",
            )
