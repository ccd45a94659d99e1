"""An alignment on disk: arrays beside a JSON summary for people."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.alignment import Alignment, CameraCorrection, PathCorrection
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import read_json, write_json

ARRAYS_NAME = "alignment.npz"
SUMMARY_NAME = "alignment.json"
_SWITCHES = ("has_rolling_shutter", "has_point_times", "has_own_car_masks")


def write_alignment(folder: Path, alignment: Alignment) -> None:
    """alignment.npz with all corrections, alignment.json with what a reader wants to know."""
    arrays = {
        f"camera/{name}": np.array([*c.rotation_rad, *c.shift_m, c.time_offset_s])
        for name, c in alignment.cameras.items()
    }
    # By number: an id that ends in .npy would be taken for another one's array.
    arrays |= {f"actor/{i}": matrices for i, matrices in enumerate(alignment.actors.values())}
    path = alignment.path
    if path is not None:
        arrays["path/times_ns"] = path.times_ns
        arrays["path/pivot_world"] = path.pivot_world
        arrays["path/rotations_rad"] = path.rotations_rad
        arrays["path/shifts_m"] = path.shifts_m
    save_arrays(folder / ARRAYS_NAME, arrays)
    write_json(
        folder / SUMMARY_NAME,
        {
            **{name: getattr(alignment, name) for name in _SWITCHES},
            "actor_ids": list(alignment.actors),
            "corrected": sorted({name.split("/")[0] for name in arrays}),
            "numbers": dict(alignment.numbers),
            "notes": list(alignment.notes),
        },
    )


def read_alignment(folder: Path) -> Alignment:
    """The alignment written by `write_alignment`, without loss.

    Raises:
        ArtefactError: a file is missing or broken.
        InputError: the arrays are damaged.
    """
    summary = read_json(folder / SUMMARY_NAME)
    arrays = load_arrays(folder / ARRAYS_NAME)
    cameras = {
        name.removeprefix("camera/"): CameraCorrection(x[:3].copy(), x[3:6].copy(), float(x[6]))
        for name, x in arrays.items()
        if name.startswith("camera/")
    }
    tracks = {
        name.removeprefix("actor/"): matrices
        for name, matrices in arrays.items()
        if name.startswith("actor/")
    }
    path = None
    if "path/times_ns" in arrays:
        names = ("times_ns", "pivot_world", "rotations_rad", "shifts_m")
        path = PathCorrection(*(arrays[f"path/{name}"] for name in names))
    try:
        actors = tracks
        # Older versions named the arrays by the ids.
        if "actor_ids" in summary:
            actors = {str(a): tracks[str(i)] for i, a in enumerate(summary["actor_ids"])}
        return Alignment(
            path,
            cameras,
            actors,
            **{name: bool(summary[name]) for name in _SWITCHES},
            numbers=summary["numbers"],
            notes=tuple(summary["notes"]),
        )
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the summary of the alignment is broken",
            where=folder / SUMMARY_NAME,
            got=error,
            remedy="Build again.",
        ) from error
