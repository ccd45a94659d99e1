"""Where the parts of a PandaSet sequence stand, and where people have them instead."""

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
_WORDS = {
    SWEEPS: ("lidar", "sweep", "velodyne", "pandar", "point"),
    BOXES: ("cuboid", "box", "label", "object"),
    CLASSES: ("semseg", "segment", "semantic", "class"),
}
"""Parts of the names of folders that may hold them."""
_MOST = 1000
"""Folders that are looked into before SOURCE is called unknown: PandaSet has 103 sequences."""


def is_sequence(folder: Path) -> bool:
    """Return whether a folder has the layout of a PandaSet sequence."""
    camera = folder / "camera"
    return is_folder(camera) and any(camera.glob("*/intrinsics.json"))


def other_place(source: Path) -> tuple[str, Path] | None:
    """Return where the sequence is that a wrong SOURCE may mean, in words and as a folder."""
    for parent in islice(source.absolute().parents, 3):
        if is_sequence(parent):
            return f"a part of the sequence {parent}", parent
    below = list(islice(_folders(source), _MOST))
    # Archives of a whole data set often hold one more folder around all sequences.
    for folders in (below, islice((inner for f in below for inner in _folders(f)), _MOST)):
        found = [folder for folder in folders if is_sequence(folder)]
        if found:
            return f"a folder of {len(found)} sequences: {named(found)}", found[0]
    return None


def check_not_elsewhere(source: Path, part: str) -> None:
    """Refuse a sequence without a part whose files stand in another folder.

    Args:
        part: SWEEPS, BOXES or CLASSES.

    Raises:
        InputError: a folder with another name holds what looks like them.
    """
    for folder in filter(is_folder, _candidates(source, part)):
        files = [p for p in visible_entries(folder) if TABLES.split(p.name) is not None]
        if files:
            raise InputError(
                f"files that look like {part} stand in another folder",
                where=folder,
                got=named(files),
                expected=f"{source / part}/00.pkl.gz or 00.pkl",
                remedy="Move or rename the folder, or remove it.",
            )


def _candidates(source: Path, part: str) -> Iterable[Path]:
    """Folders of the sequence, one and two levels down, whose names may mean the part."""
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
