"""Tables of one scene, extracted once from the tables of the data set and cached.

The tables of nuScenes v1.0-trainval have 2.6 million rows of pictures and sweeps, in 2.4 GB of
JSON; those of one scene have some 4 MB.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from lightsim.core.reading import LogReading
from lightsim.datasets.cache import cache_folder
from lightsim.datasets.layout import visible_entries
from lightsim.datasets.nuscenes.table_rows import Row, kept_rows
from lightsim.datasets.scenes import chosen_scene
from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.reading import is_file, is_folder, read_bytes

# Version of the format of cached tables: a change makes all of them anew.
_VERSION = 1
# Names of table folders in SOURCE: of nuScenes, TIER IV's T4 format, and Lyft Level 5.
_PATTERNS = ("v1.*", "annotation", "*/annotation", "data", "train_data", "test_data")
# A folder with all of these files is a table folder; each of the others may be missing.
_MARKS = ("scene.json", "sample.json", "sample_data.json", "calibrated_sensor.json")
# Tables in the order of reading, with the column that decides which rows are kept, and table and
# column of the wanted values; without these, the token of the scene is wanted.
_KEYS = {
    "scene": ("token", "", ""),
    "log": ("token", "scene", "log_token"),
    "sample": ("scene_token", "scene", "token"),
    "sample_data": ("sample_token", "sample", "token"),
    "ego_pose": ("token", "sample_data", "ego_pose_token"),
    "calibrated_sensor": ("token", "sample_data", "calibrated_sensor_token"),
    "sensor": ("token", "calibrated_sensor", "sensor_token"),
    "sample_annotation": ("sample_token", "sample", "token"),
    "instance": ("token", "sample_annotation", "instance_token"),
    "category": ("token", "instance", "category_token"),
    "attribute": ("token", "sample_annotation", "attribute_tokens"),
}
# Tables without which a log can be read: of labels (not in v1.0-test), and of the place.
_OPTIONAL = ("log", "sample_annotation", "instance", "category", "attribute")
# Largest size of cached tables of one scene, in bytes; those of nuScenes have some 6 MB.
_MAX_CACHED_BYTES = 256 << 20
# Largest number of folders to look at.
_MOST = 1000

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class SceneTables:
    """Rows of one scene.

    Args:
        folder: of the tables.
        root: folder to which the names of files are relative.
        rows_by_table: rows by the name of their table.
    """

    folder: Path
    root: Path
    rows_by_table: dict[str, Rows]

    def table(self, name: str) -> Path:
        """Return the file of a table."""
        return self.folder / f"{name}.json"

    def rows(self, name: str) -> list[Row]:
        """Return the rows of a table."""
        return [Row(self.table(name), values) for values in self.rows_by_table[name]]

    @property
    def scene(self) -> Row:
        """The row of the scene."""
        return self.rows("scene")[0]

    def find(self, name: str, token: str, where: str) -> Row:
        """Return the row with a token.

        Args:
            where: row that refers to it, for messages.

        Raises:
            InputError: there is no such row.
        """
        row = self._row_by_token[name].get(token)
        if row is None:
            raise InputError(
                f"there is no row with this token in {self.table(name).name}",
                where=where,
                got=repr(token)[:60],
                remedy="Copy the tables again from the original data set, all of one version.",
            )
        return row

    @cached_property
    def _row_by_token(self) -> dict[str, dict[Any, Row]]:
        return {
            name: {row.text("token"): row for row in self.rows(name)}
            for name in self.rows_by_table
        }  # fmt: skip


def table_folders(source: Path) -> list[Path]:
    """Return the folders with tables: SOURCE itself, or those in it."""
    if _has_tables(source):
        return [source]
    try:
        found = [path for pattern in _PATTERNS for path in islice(source.glob(pattern), _MOST)]
    except (OSError, ValueError):
        return []
    return sorted(path for path in found if _has_tables(path))


def other_place(source: Path) -> tuple[str, Path] | None:
    """Return a description and the folder of a data set above or below a wrong SOURCE, or None."""
    for parent in islice(source.absolute().parents, 3):
        if table_folders(parent):
            return f"a part of the data set {parent}", parent
    try:
        inner = [path for path in islice(visible_entries(source), _MOST) if is_folder(path)]
    except InputError:
        return None
    found = next((path for path in inner if table_folders(path)), None)
    return None if found is None else (f"a folder with the data set {found.name}", found)


def cut_out(reading: LogReading) -> tuple[Path, SceneTables]:
    """Return the cached file and the tables of the scene that the options select by name or token.
    The file is written if it does not exist.

    Raises:
        InputError: there is no such scene, or a table is missing or broken.
    """
    folder, token = _chosen(reading)
    key = hashlib.sha256(repr((_VERSION, token, *_states(folder))).encode()).hexdigest()[:32]
    path = cache_folder("nuscenes") / f"{key}.json"
    rows = _cached(path)
    if rows is None:
        rows = _scene_rows(folder, token)
        with whole_file(path) as temporary:
            # Sorted, and without the place of SOURCE: equal tables give equal files.
            temporary.write_text(json.dumps(rows, sort_keys=True), encoding="ascii")
    return path, SceneTables(folder, folder.absolute().parent, rows)


def _has_tables(folder: Path) -> bool:
    """Return whether a folder has most of the tables: of a broken copy, some may be missing."""
    return sum(is_file(folder / mark) for mark in _MARKS) > len(_MARKS) // 2


def _chosen(reading: LogReading) -> tuple[Path, str]:
    """Return the table folder and the token of the chosen scene."""
    found: dict[str, tuple[Path, str]] = {}
    # v1.0-mini is a part of v1.0-trainval and read much faster: smaller tables come first.
    folders = table_folders(Path(reading.source))
    for path in sorted((folder / "scene.json" for folder in folders), key=_size):
        for values in kept_rows(path, "token"):
            row = Row(path, values)
            name, token = row.text("name"), row.text("token")
            found.setdefault(token if token == reading.scene else name, (path.parent, token))
    return found[chosen_scene(found, reading)]


def _size(path: Path) -> int:
    return path.stat().st_size if is_file(path) else 0


def _states(folder: Path) -> Iterator[tuple[str, int, int]]:
    """Yield path, size and time of change of all tables."""
    for path in (folder.absolute() / f"{name}.json" for name in _KEYS):
        if is_file(path):
            state = path.stat()
            yield str(path), state.st_size, state.st_mtime_ns


def _cached(path: Path) -> dict[str, Rows] | None:
    """Return cached tables; None if they are not there or damaged."""
    if not is_file(path):
        return None
    try:
        value = json.loads(read_bytes(path, "cached file", _MAX_CACHED_BYTES))
    except (InputError, ValueError, RecursionError):
        return None
    is_whole = isinstance(value, dict) and list(value) == sorted(_KEYS)
    return value if is_whole else None


def _scene_rows(folder: Path, scene_token: str) -> dict[str, Rows]:
    """Read all tables, and return the rows that belong to a scene."""
    rows: dict[str, Rows] = {}

    def tokens(name: str, key: str) -> set[str]:
        table = folder / f"{name}.json"
        return {token for values in rows[name] for token in Row(table, values).tokens(key)}

    for name, (key, source, source_key) in _KEYS.items():
        path = folder / f"{name}.json"
        wanted = tokens(source, source_key) if source else {scene_token}
        is_absent = name in _OPTIONAL and not is_file(path)
        rows[name] = [] if is_absent else kept_rows(path, key, wanted)
    return rows
