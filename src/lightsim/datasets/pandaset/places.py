"""Folders of a PandaSet sequence, and other places where users store them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

from lightsim.datasets.layout import visible_entries
from lightsim.datasets.pandaset.numbered import TABLES, named
from lightsim.errors import InputError
from lightsim.store.reading import is_folder

SWEEPS, BOXES, CLASSES = "lidar", "annotations/cuboids", "annotations/semseg"
_KNOWN = ("camera", "lidar", "annotations", "meta", "cuboids", "semseg")
# Substrings of folder names that may contain each part.
_WORDS = {
    SWEEPS: ("lidar", "sweep", "velodyne", "pandar", "point"),
    BOXES: ("cuboid", "box", "label", "object"),
    CLASSES: ("semseg", "segment", "semantic", "class"),
}
# Largest number of folders to search: PandaSet has 103 sequences.
_MOST = 1000


def is_sequence(folder: Path) -> bool:
    """Return whether a folder has the layout of a PandaSet sequence."""
    camera = folder / "camera"
    return is_folder(camera) and any(camera.glob("*/intrinsics.json"))


def other_place(source: Path) -> tuple[str, Path] | None:
    """Return the place of a sequence near a wrong SOURCE, in words and as a folder; else None."""
    for parent in islice(source.absolute().parents, 3):
        if is_sequence(parent):
            return f"a part of the sequence {parent}", parent
    below = list(islice(_folders(source), _MOST))
    # Archives of the whole data set often have one more folder around all sequences.
    for folders in (below, islice((inner for f in below for inner in _folders(f)), _MOST)):
        found = [folder for folder in folders if is_sequence(folder)]
        if found:
            return f"a folder of {len(found)} sequences: {named(found)}", found[0]
    return None


def check_not_elsewhere(source: Path, part: str) -> None:
    """Reject a sequence that has one of its parts in a wrong folder.

    Args:
        part: SWEEPS, BOXES or CLASSES.

    Raises:
        InputError: a folder with another name contains files that look like this part.
    """
    for folder in filter(is_folder, _candidates(source, part)):
        files = [p for p in visible_entries(folder) if TABLES.split(p.name) is not None]
        if files:
            raise InputError(
                f"files that look like {part} are in another folder",
                where=folder,
                got=named(files),
                expected=f"{source / part}/00.pkl.gz or 00.pkl",
                remedy="Move or rename the folder, or remove it.",
            )


def _candidates(source: Path, part: str) -> Iterable[Path]:
    """Yield folders of the sequence, up to two levels down, whose names match the part."""
    # annotations/ itself, in which users put files without the folder cuboids or semseg.
    own = source / part
    if own.parent != source:
        yield own.parent
    for folder in _folders(source):
        around = [folder] if folder.name == "camera" else [folder, *_folders(folder)]
        for path in around:
            is_other = path == own or (path.name in _KNOWN and path.name != own.name)
            if not is_other and any(word in path.name.lower() for word in _WORDS[part]):
                yield path


def _folders(folder: Path) -> Iterable[Path]:
    try:
        return [path for path in visible_entries(folder) if is_folder(path)]
    except InputError:
        return ()
