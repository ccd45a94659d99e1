"""Files that are named by their time in nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from lightsim.datasets.layout import has_file, has_folder, visible_entries

_TIME = re.compile(r"[0-9]{1,19}")
# Nanoseconds below 2^62 leave room for sums and differences in int64.
_MAX_NS = 2**62


def stamped_files(folder: Path, suffixes: Sequence[str]) -> tuple[dict[int, Path], tuple[str, ...]]:
    """Return the files `<time_ns><suffix>` of a folder by time, in time order, and notes on other
    files. Of two files of one time, the one with the earlier suffix is used. A missing folder has
    no files.

    Raises:
        InputError: the folder is not accessible, or an entry of this name is no file.
    """
    if not has_folder(folder):
        return {}, ()
    found: dict[int, list[Path]] = {}
    others: list[str] = []
    for path in visible_entries(folder):
        is_time = _TIME.fullmatch(path.stem) is not None and int(path.stem) < _MAX_NS
        if is_time and path.suffix.lower() in suffixes and has_file(path):
            found.setdefault(int(path.stem), []).append(path)
        else:
            others.append(path.name)
    order = {suffix: i for i, suffix in enumerate(suffixes)}
    chosen = {
        time_ns: min(found[time_ns], key=lambda path: (order[path.suffix.lower()], path.name))
        for time_ns in sorted(found)
    }
    notes: list[str] = []
    doubled = sum(len(paths) for paths in found.values()) - len(chosen)
    place = f"{folder.parent.name}/{folder.name}"
    if doubled:
        notes.append(f"{place}: {doubled} files repeat a time: one of each is used")
    if others:
        name = others[0] if others[0].isprintable() else "a file"
        notes.append(
            f"{place}: {len(others)} files are not named by time in nanoseconds with one of"
            f" {', '.join(suffixes)} and are not used, such as {name[:60]}"
        )
    return chosen, tuple(notes)
