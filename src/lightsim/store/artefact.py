"""Artefacts: folders that appear whole or not at all, and know what they were made from.

A folder is written under a hidden temporary name and renamed when complete. Its artefact.json
records stage, schema, config, the keys of its inputs, seed, package version and seconds; the
`key` is a hash of all that decides the content, so an artefact is stale exactly when the key that
would be made now differs.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lightsim import __version__
from lightsim.errors import ArtefactError, InputError
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

RECORD_NAME = "artefact.json"
_HASH_BLOCK = 1 << 20

State = Literal["made", "stale", "missing"]


@dataclass(frozen=True)
class Recipe:
    """All that decides the content of an artefact.

    Args:
        stage: name of the stage.
        schema: version of the stage's files and algorithm; raise it when either changes.
        config: JSON-ready configuration.
        inputs: key of every input artefact or source, by name.
        seed: of the stage's random numbers.
    """

    stage: str
    schema: int
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    seed: int

    @property
    def key(self) -> str:
        text = json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def json_ready(value: Any) -> Any:
    """Dataclasses, tuples, paths and numpy scalars as plain JSON values."""
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
    """artefact.json of a complete artefact, or None where there is none.

    Raises:
        ArtefactError: the record is there but broken.
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        return None
    record = _parsed_json(path, "Delete the folder.")
    if not isinstance(record, dict) or "key" not in record:
        raise ArtefactError("the record has no key", where=path, remedy="Delete the folder.")
    return record


def state_of(folder: Path, recipe: Recipe) -> State:
    """Whether the artefact exists, and was made from this very recipe."""
    record = read_record(folder)
    if record is None:
        return "missing"
    return "made" if record["key"] == recipe.key else "stale"


def make_artefact(
    folder: Path, recipe: Recipe, build: Callable[[Path], Iterable[str]]
) -> dict[str, Any]:
    """Make the artefact unless it is up to date; returns its record.

    `build` fills the folder it is given and returns notes. An earlier attempt at the same recipe
    is handed to it as it was left, so a stage that writes one file a frame can go on from there;
    leftovers of another recipe are removed first.
    """
    if state_of(folder, recipe) == "made":
        record = read_record(folder)
        assert record is not None
        return record
    partial = folder.parent / f".{folder.name}.partial"
    plan = partial / ".plan"
    if partial.exists() and not (plan.is_file() and plan.read_text() == recipe.key):
        shutil.rmtree(partial)
    partial.mkdir(parents=True, exist_ok=True)
    plan.write_text(recipe.key)
    start = time.monotonic()
    notes = tuple(build(partial))
    record = {
        **json_ready(recipe),
        "key": recipe.key,
        "package_version": __version__,
        "seconds": round(time.monotonic() - start, 2),
        "peak_memory_mb": peak_memory_mb(),
        "notes": list(notes),
    }
    write_text(partial / RECORD_NAME, json.dumps(record, indent=1))
    plan.unlink()
    _replace(partial, folder)
    return record


def peak_memory_mb() -> int:
    """Largest resident size of this process so far (all stages run before included)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def write_text(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Parsed JSON of our own file.

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
            "the file is no valid JSON", where=path, got=f"{error}"[:200], remedy=remedy
        ) from error


def fingerprint(root: Path) -> str:
    """Hash of the names and bytes of all files under a folder, or of one file."""
    digest = hashlib.blake2b(digest_size=16)
    files = [root] if root.is_file() else sorted(p for p in root.rglob("*") if p.is_file())
    for path in files:
        digest.update(str(path.relative_to(root.parent)).encode())
        with path.open("rb") as handle:
            while block := handle.read(_HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _replace(new: Path, old: Path) -> None:
    retired = old.parent / f".{old.name}.retired"
    if retired.exists():
        shutil.rmtree(retired)
    if old.exists():
        os.replace(old, retired)
    os.replace(new, old)
    if retired.exists():
        shutil.rmtree(retired)
