"""Files of an alignment: arrays with all corrections, and a JSON summary for people."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.alignment import Alignment, CameraCorrection, PathCorrection
from lightsim.errors import ArtefactError
from lightsim.store.arrays import ArrayFile, save_arrays
from lightsim.store.artefact import write_json
from lightsim.store.entries import Entries

ARRAYS_NAME = "alignment.npz"
SUMMARY_NAME = "alignment.json"
_SWITCHES = ("has_rolling_shutter", "has_point_times", "has_ego_vehicle_masks")


def write_alignment(folder: Path, alignment: Alignment) -> None:
    """Write alignment.npz with all corrections, and alignment.json with a summary."""
    arrays = {
        f"camera/{name}": np.array([*c.rotation_rad, *c.shift_m, c.time_offset_s])
        for name, c in alignment.cameras.items()
    }
    # Arrays are named by the actor's number, since NumPy cuts ".npy" from the end of a name, and an
    # actor id may end so.
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
    """Return the alignment that `write_alignment` wrote, without loss.

    Raises:
        ArtefactError: an entry or array is missing or broken.
        InputError: the arrays cannot be read.
    """
    summary = Entries.of_file(folder / SUMMARY_NAME)
    arrays = ArrayFile(folder / ARRAYS_NAME)
    cameras: dict[str, CameraCorrection] = {}
    for name in arrays.names("camera/"):
        x = arrays.take(f"camera/{name}", "f8", "7")
        cameras[name] = CameraCorrection(x[:3].copy(), x[3:6].copy(), float(x[6]))
    ids = summary.texts("actor_ids")
    actors = {a: arrays.take(f"actor/{i}", "f8", "_ 4 4") for i, a in enumerate(ids)}
    path = None
    if "path/times_ns" in arrays:
        path = PathCorrection(
            arrays.take("path/times_ns", "i8", "n"),
            arrays.take("path/pivot_world", "f8", "3"),
            arrays.take("path/rotations_rad", "f8", "n 3"),
            arrays.take("path/shifts_m", "f8", "n 3"),
        )
        if not len(path.times_ns) or (np.diff(path.times_ns) <= 0).any():
            raise ArtefactError(
                "the times of the corrected ego path do not increase",
                where=arrays.path,
                remedy="Build again.",
            )
    numbers = summary.object("numbers")
    return Alignment(
        path,
        cameras,
        actors,
        **{name: summary.flag(name) for name in _SWITCHES},
        numbers={name: numbers.number(name) for name in numbers},
        notes=summary.texts("notes"),
    )
