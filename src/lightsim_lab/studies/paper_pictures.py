"""Common parts of the paper's tables of FID and KID: front pictures, cached features, rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from lightsim.core.sky_choice import SkyChoice
from lightsim.progress import Progress
from lightsim.simulation.skies import parse_sky
from lightsim.store.arrays import load_arrays
from lightsim.store.atomic import whole_file
from lightsim.store.images import read_srgb8

if TYPE_CHECKING:
    from lightsim_lab.metrics.distribution import SetRow
    from lightsim_lab.metrics.inception import Inception

# Camera whose pictures the paper relights and uses as reference.
CAMERA = "front_camera"


@dataclass(frozen=True)
class PaperTable:
    """Rows of methods, and notes on differences from the paper's table."""

    rows: tuple[SetRow, ...]
    notes: tuple[str, ...]

    def to_table(self) -> str:
        """Return the report as Markdown."""
        lines = [
            "| method | FID | KID x 1000 | pictures | reference |",
            "|---|---:|---:|---:|---:|",
        ]
        for r in self.rows:
            figures = (f"{r.fid:.1f}", r.kid_text, str(r.count), str(r.reference_count))
            lines.append(f"| {r.method} | {' | '.join(figures)} |")
        return "\n".join([*lines, "", *self.notes])

    def to_json(self) -> str:
        """Return rows and notes as JSON."""
        rows = [asdict(row) for row in self.rows]
        return json.dumps({"sets": rows, "notes": self.notes}, indent=2)


def logs_of(pandaset: Path) -> list[Path]:
    """Return the sequences of a folder of PandaSet that have front pictures."""
    return sorted(path.parents[1] for path in pandaset.glob(f"*/camera/{CAMERA}"))


def front_pictures(log: Path) -> list[Path]:
    """Return the front pictures of a PandaSet sequence."""
    return sorted((log / "camera" / CAMERA).glob("*.jpg"))


def relit_pictures(work: Path, name: str, skies: Sequence[str]) -> list[Path]:
    """Return the relit front pictures of a scenario under the given skies, spelt as for `--sky`."""
    scenario = work / "scenarios" / name
    # `relight` writes a folder per sky only for more than one sky.
    folders = [
        scenario / parse_sky(SkyChoice(sky)).name if len(skies) > 1 else scenario for sky in skies
    ]
    return sorted(p for f in folders for p in (f / "frames" / CAMERA).glob("*.png"))


def compare_pictures(
    title: str,
    pictures: Mapping[str, Mapping[str, Sequence[Path]]],
    reference: Mapping[str, Sequence[Path]],
    inception: Inception,
    folder: Path,
    kid_subset_size: int,
    progress: Progress,
) -> tuple[tuple[SetRow, ...], list[str]]:
    """Compare the pictures of each row with the reference; return rows, and notes on empty ones.

    Args:
        pictures: pictures of each row, by the name of the file that caches their features.
        reference: reference pictures, by the name of the file that caches their features.
        folder: folder of these files.
    """
    from lightsim_lab.metrics.distribution import compare_sets

    def features(name: str, paths: Sequence[Path]) -> Float64[np.ndarray, "n 2048"]:
        return cached_features(inception, folder / f"{name}.npz", paths)

    tracked = progress.track(reference.items(), "features of real frames")
    real = np.concatenate([features(*part) for part in tracked])
    rows, notes = [], []
    for row, parts in progress.track(pictures.items(), "features of relit frames"):
        # A single picture has no covariance.
        if sum(map(len, parts.values())) < 2:
            notes.append(f"{row}: nothing was relit.")
            continue
        made = np.concatenate([features(*part) for part in parts.items()])
        rows.append(compare_sets((title, row), made, real, kid_subset_size))
    return tuple(rows), notes


def cached_features(
    network: Inception, path: Path, pictures: Sequence[Path]
) -> Float64[np.ndarray, "n 2048"]:
    """Return the features of pictures, cached in `path` (.npz).

    The cache is valid while size and modification time of all pictures are unchanged.
    """
    facts = [p.stat() for p in pictures]
    state = np.array([[s.st_size, s.st_mtime_ns] for s in facts], np.int64).reshape(-1, 2)
    if path.is_file():
        known = load_arrays(path)
        if np.array_equal(known["state"], state):
            return known["features"]
    features = network.features(read_srgb8(p) for p in pictures)
    path.parent.mkdir(parents=True, exist_ok=True)
    # np.savez would append .npz to the name of the temporary file.
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, features=features, state=state)
    return features
