"""Artefacts: output folders that appear whole or not at all, with a record of their inputs.

A folder is written under a hidden temporary name and renamed when complete. Its artefact.json
records stage, hashes of the source code, configuration, keys of the inputs, seed, package version,
seconds, and size and hash of every file. The artefact key is a hash of everything that decides the
content. An artefact is stale if its recorded key differs from the present one, and broken if a file
differs from what was written.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import resource
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lightsim.core.version import __version__
from lightsim.errors import ArtefactError, InputError
from lightsim.store.atomic import sweep_partials, whole_file
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

RECORD_NAME = "artefact.json"
# File of an unfinished attempt with the artefact key that the attempt is for.
_PLAN = ".plan"
# Version of the record's entries; version 3 added `sources`. A change makes all artefacts stale,
# since it enters the key.
_FORMAT = 3
_REMEDY = "Run the command that made it again: it renames this folder and makes a new one."
# Entries that every record has, with their types.
_ENTRIES: dict[str, type | tuple[type, ...]] = {
    "stage": str,
    "key": str,
    "config": dict,
    "inputs": dict,
    "seconds": (int, float),
    "peak_memory_mb": int,
    "notes": list,
}

State = Literal["made", "stale", "broken", "missing"]
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ArtefactKey:
    """Everything that decides the content of an artefact.

    Args:
        stage: name of the stage.
        sources: hashes of the source code and shipped data that decide the content, by path
            (store/source_hash.py).
        config: JSON-ready configuration.
        inputs: key of every input artefact or source, by name.
        seed: seed of the stage's random numbers.
    """

    stage: str
    sources: Mapping[str, str]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    seed: int

    @property
    def key(self) -> str:
        """Return the 128-bit BLAKE2b hash of all fields, as 32 hexadecimal digits."""
        value = {"format": _FORMAT, **json_ready(self)}
        text = json.dumps(value, sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def json_ready(value: Any) -> Any:
    """Convert dataclasses, tuples, paths, NumPy arrays and scalars to plain JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: json_ready(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): json_ready(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def read_record(folder: Path) -> dict[str, Any] | None:
    """Return artefact.json of a complete artefact; None if the folder has none.

    Raises:
        ArtefactError: the record exists but is damaged.
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        return None
    record = _parsed_json(path, _REMEDY)
    if not isinstance(record, dict):
        raise _broken_record(path, f"a {type(record).__name__}")
    wrong = [name for name, kind in _ENTRIES.items() if not isinstance(record.get(name), kind)]
    if wrong or not _is_text_by_name(record["inputs"]):
        raise _broken_record(path, f"wrong entries: {', '.join(wrong) or 'inputs'}")
    if not _is_text_by_name(record.get("sources", {})):
        raise _broken_record(path, "the list of sources is damaged")
    # Records of LightSim 0.2 have no format and no list of files; their key makes them stale.
    if "format" not in record:
        return {**record, "files": {}}
    if not _is_file_list(record.get("files")):
        raise _broken_record(path, "the list of files is damaged")
    return record


def _is_text_by_name(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


def _is_file_list(files: Any) -> bool:
    return isinstance(files, dict) and all(
        isinstance(entry, list) and [type(value) for value in entry] == [int, str]
        for entry in files.values()
    )


def _broken_record(path: Path, found: object) -> ArtefactError:
    return ArtefactError(
        "the record of the artefact is damaged",
        where=path,
        got=found,
        remedy=_REMEDY,
    )


def state_of(folder: Path, artefact_key: ArtefactKey, *, is_hashed: bool = False) -> State:
    """Return the state of an artefact: missing, broken, stale (of another artefact key) or made.

    Args:
        is_hashed: compare the hashes of all files, not only their sizes.
    """
    try:
        record = read_record(folder)
    except ArtefactError:
        return "broken"
    if record is None:
        return "missing"
    if record["key"] != artefact_key.key:
        return "stale"
    return "broken" if find_damage(folder, record, is_hashed=is_hashed) else "made"


def find_damage(
    folder: Path, record: Mapping[str, Any], *, is_hashed: bool = False
) -> tuple[str, ...]:
    """Return a description of each file of an artefact that differs from what was written."""
    # Hashing is optional, since it reads all bytes.
    found: list[str] = []
    for name, (size, digest) in record["files"].items():
        try:
            status = (folder / name).stat()
            if not stat.S_ISREG(status.st_mode):
                found.append(f"{name} is not a file")
            elif status.st_size != size:
                found.append(f"{name} has {status.st_size} bytes instead of {size}")
            elif is_hashed and hash_file(folder / name) != digest:
                found.append(f"{name} has other content")
        except (OSError, ValueError) as error:
            missing = isinstance(error, FileNotFoundError)
            found.append(f"{name[:80]} {'is missing' if missing else 'cannot be read'}")
    return tuple(found)


def require_whole(folder: Path, remedy: str) -> dict[str, Any] | None:
    """Check the hashes of an artefact's files and return its record; None if there is no artefact.

    Raises:
        ArtefactError: a file was changed, cut or removed.
    """
    record = read_record(folder)
    if record is None:
        return None
    damage = find_damage(folder, record, is_hashed=True)
    if damage:
        raise ArtefactError(
            "files of the artefact are damaged",
            where=folder,
            got=few(damage, "; "),
            remedy=remedy,
        )
    return record


def few(words: Sequence[str], separator: str = ", ") -> str:
    """Return the first three words of a message's list, and the number of the others."""
    more = len(words) - 3
    return separator.join(words[:3]) + (f" and {more} more" if more > 0 else "")


def make_artefact(
    folder: Path, artefact_key: ArtefactKey, build: Callable[[Path], Iterable[str]]
) -> dict[str, Any]:
    """Make the artefact unless it is up to date and undamaged; return its record.

    `build` fills the folder that it receives and returns notes. The folder contains the files of an
    interrupted attempt with the same artefact key, so that a stage which writes one file per frame
    can continue; files of another key are removed first. Only an artefact of the same stage is
    replaced.

    Raises:
        ArtefactError: the folder contains something else.
    """
    if state_of(folder, artefact_key, is_hashed=True) == "made":
        record = read_record(folder)
        assert record is not None
        return record
    _make_way(folder, artefact_key)
    partial = _partial_of(folder)
    # An earlier process may have completed the folder without renaming it.
    record = _finished(partial, artefact_key)
    if record is None:
        record = _make(partial, artefact_key, build)
    _replace(partial, folder)
    return record


def open_attempt(folder: Path, artefact_key: ArtefactKey) -> Path | None:
    """Return the folder that `make_artefact` will pass to its `build`, to be filled beforehand.

    It allows one computation to write files of several artefacts in turn. The result is None if the
    artefact is up to date, or complete but for its rename.

    Raises:
        ArtefactError: `folder` contains something that must not be replaced.
    """
    if state_of(folder, artefact_key, is_hashed=True) == "made":
        return None
    _make_way(folder, artefact_key)
    partial = _partial_of(folder)
    return None if _finished(partial, artefact_key) else _open(partial, artefact_key)


def _partial_of(folder: Path) -> Path:
    return folder.parent / f".{folder.name}.partial"


def _open(partial: Path, artefact_key: ArtefactKey) -> Path:
    """Return the folder of the attempt, emptied if it was made for another artefact key."""
    plan = partial / _PLAN
    if partial.exists() and not (plan.is_file() and plan.read_text() == artefact_key.key):
        shutil.rmtree(partial)
    partial.mkdir(parents=True, exist_ok=True)
    sweep_partials(partial)
    plan.write_text(artefact_key.key)
    return partial


def _make(
    partial: Path, artefact_key: ArtefactKey, build: Callable[[Path], Iterable[str]]
) -> dict[str, Any]:
    plan = _open(partial, artefact_key) / _PLAN
    start = time.monotonic()
    notes = tuple(build(partial))
    seconds = round(time.monotonic() - start, 2)
    record = {
        **json_ready(artefact_key),
        "format": _FORMAT,
        "key": artefact_key.key,
        "package_version": __version__,
        "seconds": seconds,
        "peak_memory_mb": peak_memory_mb(),
        "notes": list(notes),
        # Every file but the plan, which is deleted when the record is complete.
        "files": {
            path.relative_to(partial).as_posix(): [path.stat().st_size, hash_file(path)]
            for path in sorted(partial.rglob("*"))
            if path.is_file() and path != plan
        },
    }
    # The record is written last: a folder with a record is complete.
    write_text(partial / RECORD_NAME, json.dumps(record, indent=1))
    plan.unlink()
    return record


def _finished(partial: Path, artefact_key: ArtefactKey) -> dict[str, Any] | None:
    """Return the record of a complete attempt whose process ended before the rename, else None."""
    return (
        read_record(partial) if state_of(partial, artefact_key, is_hashed=True) == "made" else None
    )


def _make_way(folder: Path, artefact_key: ArtefactKey) -> None:
    """Check that `folder` may be replaced: it is missing, empty or an artefact of the same stage.

    A folder whose record cannot be read is renamed instead, since its content is unknown.
    """
    if not folder.exists() and not folder.is_symlink():
        return
    try:
        record = read_record(folder)
    except ArtefactError as error:
        aside = _free_name(folder)
        os.replace(folder, aside)
        logger.warning("%s The folder was renamed to %s.", error, aside.name)
        return
    is_empty = folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())
    if is_empty or (record is not None and record["stage"] == artefact_key.stage):
        return
    raise ArtefactError(
        f"the folder for the artefact '{artefact_key.stage}' contains other files",
        where=folder,
        got="no artefact.json" if record is None else f"the artefact '{record['stage']}'",
        remedy="Nothing was changed. Move the folder away.",
    )


def _free_name(folder: Path) -> Path:
    names = (folder.with_name(f"{folder.name}.broken-{n}") for n in range(1, 1_000_000))
    return next(name for name in names if not name.exists())


def peak_memory_mb() -> int:
    """Return the largest resident size of this process so far, in MB."""
    # It includes all earlier stages of the process. Linux gives kilobytes (getrusage(2)).
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def write_text(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text)


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON that appears whole or not at all.

    Raises:
        ValueError: a number is not finite, which JSON cannot hold.
    """
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Return the parsed JSON of a file that LightSim wrote.

    Raises:
        ArtefactError: missing or broken.
    """
    return _parsed_json(path, "Run lightsim build again.")


def _parsed_json(path: Path, remedy: str) -> Any:
    try:
        return json.loads(read_bytes(path, "JSON file", MAX_JSON_BYTES))
    except InputError as error:
        raise ArtefactError(error.what, where=path, got=error.got, remedy=remedy) from error
    except (ValueError, RecursionError) as error:
        raise ArtefactError(
            "the file is not valid JSON", where=path, got=f"{error}"[:200], remedy=remedy
        ) from error


def hash_file(path: Path) -> str:
    """Return the 128-bit BLAKE2b hash of a file's bytes."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def hash_files(root: Path) -> dict[str, str]:
    """Return the hash of every regular file below a folder, by its relative path."""
    return {
        path.relative_to(root).as_posix(): hash_file(path)
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def hash_names(value_by_name: Mapping[str, Any]) -> str:
    """Return one hash of named JSON values, such as the hashes of many files."""
    text = json.dumps(json_ready(value_by_name), sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _replace(new: Path, old: Path) -> None:
    # Rename, then delete: a command that is interrupted never leaves half of a folder.
    retired = old.parent / f".{old.name}.retired"
    if retired.exists():
        shutil.rmtree(retired)
    if old.exists():
        os.replace(old, retired)
    os.replace(new, old)
    if retired.exists():
        shutil.rmtree(retired)
