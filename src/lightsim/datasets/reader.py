"""Entry point for recordings: `read_log`, with the table of data sets."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from lightsim.core.extensions import READERS, load_extension
from lightsim.core.log import DrivingLog, FindEgoVehicle, without_ego_vehicle
from lightsim.core.reading import OWN_DATASETS, LogReading, dataset_names
from lightsim.datasets.layout import has_folder, visible_entries
from lightsim.errors import InputError
from lightsim.store.names import is_harmless
from lightsim.store.reading import is_file

# Number of entries of a folder that a message lists.
_SHOWN = 6
ReadDataset = Callable[[LogReading, FindEgoVehicle], DrivingLog]
"""(options, find_ego_vehicle) -> recording."""


@dataclass(frozen=True)
class LogReader:
    """Functions that recognise and read a data set.

    Args:
        detect: returns whether a folder, or a file, has the layout of the data set; it looks up a
            few names, and raises no error for other folders.
        other_place: for a wrong SOURCE, returns the place of the recording nearby, in words and as
            a folder.
        files: returns the files that determine the recording, whose hashes reveal a change after
            the build; for SOURCE with many scenes, those of the chosen scene. By default all
            files in the folder.
        derived: returns files outside of SOURCE that are made from it, and hashed instead of it,
            by name.
    """

    detect: Callable[[Path], bool]
    read: ReadDataset
    other_place: Callable[[Path], tuple[str, Path] | None] = lambda folder: None
    files: Callable[[LogReading], Iterable[Path]] | None = None
    derived: Callable[[LogReading], Mapping[str, Path]] = lambda reading: {}


def reader_of(name: str) -> LogReader:
    """Return the reader of a data set, which is imported when it is first used.

    Raises:
        InputError: the package that registers it is broken.
    """
    if name not in OWN_DATASETS:
        return load_extension(READERS, name)
    return import_module(f"lightsim.datasets.{name}.log").READER


def read_log(
    reading: LogReading, find_ego_vehicle: FindEgoVehicle = without_ego_vehicle
) -> DrivingLog:
    """Read the recording in a folder, at full image size and with all frames.

    Args:
        reading: options; image scale and held-out frames are applied by the caller.
        find_ego_vehicle: finds the ego vehicle in the pictures; by default it is not searched for.

    Raises:
        InputError: the folder belongs to no known data set, or a file is missing or broken.
    """
    log = reader_of(check_layout(reading)).read(reading, find_ego_vehicle)
    _check_camera_names(log, reading.source)
    return log


def check_layout(reading: LogReading) -> str:
    """Return the data set of a folder's layout.

    Only a few names are looked up, so that any folder can be checked before it is walked or hashed.

    Raises:
        InputError: the folder does not exist, is of another data set, or of none.
    """
    source, dataset = Path(reading.source), reading.dataset
    is_a_file = is_file(source)
    if not is_a_file and not has_folder(source):
        raise InputError(
            "no such folder", where=source, remedy="SOURCE is the folder of one recording."
        )
    readers = {name: reader_of(name) for name in dataset_names() if dataset in ("auto", name)}
    for name, reader in readers.items():
        if reader.detect(source):
            return name
    if is_a_file:
        raise InputError(
            "SOURCE is a file",
            where=source,
            expected="the folder of one recording, or a .tfrecord file of Waymo",
            remedy="Unpack the archive, and give the folder of one recording in it.",
        )
    # No reader recognises the folder: the error names a recording nearby, if there is one.
    places = filter(None, (reader.other_place(source) for reader in readers.values()))
    found, folder = next(places, (None, None))
    raise InputError(
        "the folder does not have the layout of a supported data set",
        where=source,
        got=found or _content(source),
        expected=dataset if dataset != "auto" else f"one of {', '.join(dataset_names())}",
        remedy="PandaSet: give the folder of one sequence, such as pandaset/002. Other data sets:"
        " docs/reference/datasets.md names the folder to give."
        if folder is None
        else f"Run: lightsim build {shlex.quote(str(folder))} --work WORK",
    )


def _content(folder: Path) -> str:
    names = [path.name for path in visible_entries(folder)]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"a folder with {', '.join(names[:_SHOWN])}{more}" if names else "an empty folder"


def _check_camera_names(log: DrivingLog, source: str) -> None:
    """Reject camera names that are no valid file names: stages write files under these names."""
    names: dict[str, str] = {}
    for name in log.cameras:
        # Without regard to case: some file systems do not distinguish it.
        other = names.setdefault(name.casefold(), name)
        if not is_harmless(name) or other != name:
            raise InputError(
                "a camera's name must be a valid file name, unique without regard to case",
                where=source,
                got=repr(name)[:90] if other == name else f"'{other}' and '{name}'",
                expected="letters, digits, '_', '-' and '.', a letter or digit first",
                remedy="Rename the camera.",
            )
