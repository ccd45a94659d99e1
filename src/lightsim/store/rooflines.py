"""File of rooflines between the stages: the columns of all walls in sequence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightsim.core.buildings import Roofline, Wall
from lightsim.errors import ArtefactError
from lightsim.store.arrays import ArrayFile, save_arrays


def write_rooflines(path: Path, rooflines: Sequence[Roofline]) -> None:
    """Write rooflines as named arrays, without loss."""
    walls = [r.wall for r in rooflines]
    labels = rooflines[0].energy.shape[1] if rooflines else 0

    def joined(name: str, kind: str) -> np.ndarray:
        parts = [np.asarray(getattr(r, name), dtype=kind) for r in rooflines]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=kind)

    save_arrays(
        path,
        {
            "origin_m": np.array([w.origin_m for w in walls], dtype="f8").reshape(-1, 3),
            "normal": np.array([w.normal for w in walls], dtype="f8").reshape(-1, 3),
            "along": np.array([w.along for w in walls], dtype="f8").reshape(-1, 3),
            "span_m": np.array([w.span_m for w in walls], dtype="f8").reshape(-1, 2),
            "height_m": np.array([w.height_m for w in walls], dtype="f8").reshape(-1, 2),
            "cell_m": np.array([r.cell_m for r in rooflines], dtype="f8"),
            "log_std": np.array([r.log_std for r in rooflines], dtype="f8"),
            "columns": np.array([len(r.top) for r in rooflines], dtype="i8"),
            "energy": np.concatenate([r.energy for r in rooflines])
            if rooflines
            else np.zeros((0, labels), np.float32),
            "ground_m": joined("ground_m", "f8"),
            "shown": joined("shown", "i8"),
            "top": joined("top", "i8"),
            "is_seen": joined("is_seen", "u1"),
            "depth_m": joined("depth_m", "f8"),
        },
    )


def read_rooflines(path: Path) -> list[Roofline]:
    """Return the rooflines that `write_rooflines` wrote.

    Raises:
        InputError: the file is damaged.
        ArtefactError: an array is missing, of another shape or type, or not finite; or a roof lies
            outside its wall.
    """
    arrays = ArrayFile(path)
    walls = {name: arrays.take(name, "f8", "w 3") for name in ("origin_m", "normal", "along")}
    spans = {name: arrays.take(name, "f8", "w 2") for name in ("span_m", "height_m")}
    cell_m, log_std = arrays.take("cell_m", "f8", "w"), arrays.take("log_std", "f8", "w")
    columns = arrays.take("columns", "i8", "w")
    energy = arrays.take("energy", "f4", "s t")
    ground_m, depth_m = arrays.take("ground_m", "f8", "s"), arrays.take("depth_m", "f8", "s")
    shown, top = arrays.take("shown", "i8", "s"), arrays.take("top", "i8", "s")
    is_seen = arrays.take("is_seen", "u1", "s").astype(bool)
    is_whole = bool((columns > 0).all() and columns.sum() == len(top) and (cell_m > 0).all())
    is_whole &= bool((top >= 0).all() and (top < max(energy.shape[1], 1)).all())
    is_whole &= bool((shown >= 0).all() and (shown <= energy.shape[1]).all())
    is_whole &= bool((depth_m >= 0).all() and (log_std > 0).all())
    if not is_whole:
        raise ArtefactError(
            "the rooflines contain inconsistent values", where=path, remedy="Build again."
        )
    rooflines, start = [], 0
    for k, count in enumerate(columns.tolist()):
        part = slice(start, start + count)
        start += count
        wall = Wall(
            walls["origin_m"][k],
            walls["normal"][k],
            walls["along"][k],
            (float(spans["span_m"][k, 0]), float(spans["span_m"][k, 1])),
            (float(spans["height_m"][k, 0]), float(spans["height_m"][k, 1])),
        )
        rooflines.append(
            Roofline(
                wall,
                float(cell_m[k]),
                ground_m[part],
                energy[part],
                shown[part],
                top[part],
                is_seen[part],
                depth_m[part],
                float(log_std[k]),
            )
        )
    return rooflines
