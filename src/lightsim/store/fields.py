"""File of the reconstructed fields (fields.npz)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lightsim.core.fields import BLOCK, SceneFields
from lightsim.errors import ArtefactError
from lightsim.store.arrays import ArrayFile, save_arrays
from lightsim.store.entries import Entries

FIELDS_NAME = "fields.npz"


def write_fields(folder: Path, fields: SceneFields) -> None:
    """Write fields.npz into the folder, without loss."""
    save_arrays(folder / FIELDS_NAME, fields.to_arrays())


def read_fields(folder: Path) -> SceneFields:
    """Read the signed distance fields, the ground map and the ego path of a twin, without loss.

    Raises:
        InputError: the file cannot be read.
        ArtefactError: an array is missing, or of another shape or type.
    """
    file = ArrayFile(folder / FIELDS_NAME)
    meta = _read_meta(file)
    for key, prefix in (("radius_m", "background"), ("actors", "actor")):
        for i in range(len(meta[key])):
            _check_grid(file, f"{prefix}/{i}")
    arrays = {
        "ground/origin_m": file.take("ground/origin_m", "f8", "2"),
        "ground/cell_m": file.take("ground/cell_m", "f8", ""),
        "ground/height_m": file.take("ground/height_m", "f4", "x y"),
        "ground/is_observed": file.take("ground/is_observed", "?", "x y"),
        "path_m": file.take("path_m", "f8", "_ 3"),
    }
    if not arrays["ground/height_m"].size or arrays["ground/cell_m"] <= 0:
        raise ArtefactError("the ground is empty", where=file.path, remedy="Build again.")
    return SceneFields.from_arrays(file.arrays)


def _read_meta(file: ArrayFile) -> dict[str, Any]:
    try:
        value = json.loads(file.take("meta", "u1", "_").tobytes())
    except (ValueError, RecursionError) as error:
        raise ArtefactError(
            "the description of the fields is not valid JSON",
            where=file.path,
            got=error,
            remedy="Build again.",
        ) from error
    entries = Entries(value, f"{file.path}, 'meta'")
    entries.number("version")
    entries.texts("notes")
    entries.numbers("radius_m", (None,))
    entries.texts("actors")
    return value


def _check_grid(file: ArrayFile, prefix: str) -> None:
    geometry = file.take(f"{prefix}/geometry", "f8", "5")
    count = len(file.take(f"{prefix}/block_coords", "i4", "_ 3"))
    for name in ("sdf_m", "weight"):
        file.take(f"{prefix}/{name}", "f4", f"{count} {BLOCK} {BLOCK} {BLOCK}")
    if (geometry[3:] <= 0).any():
        raise ArtefactError(
            "the voxel size or truncation distance is not positive",
            where=file.path,
            remedy="Build again.",
        )
