"""Reconstructed fields on disk."""

from __future__ import annotations

from pathlib import Path

from lightsim.core.fields import SceneFields
from lightsim.store.arrays import load_arrays, save_arrays

FIELDS_NAME = "fields.npz"


def write_fields(folder: Path, fields: SceneFields) -> None:
    save_arrays(folder / FIELDS_NAME, fields.to_arrays())


def read_fields(folder: Path) -> SceneFields:
    """The fields written by `write_fields`, without loss."""
    return SceneFields.from_arrays(load_arrays(folder / FIELDS_NAME))
