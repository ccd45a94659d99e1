"""What the paper's tables of FID and KID share: front pictures, kept features, rows and notes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from lightsim.core.sky_choice import SkyChoice
from lightsim.simulation.skies import parse_sky
from lightsim.store.arrays import load_arrays
from lightsim.store.atomic import whole_file
from lightsim.store.images import read_srgb8

if TYPE_CHECKING:
    from lightsim_lab.metrics.distribution import SetRow
    from lightsim_lab.metrics.inception import Inception

CAMERA = "front_camera"
"""The one whose pictures the paper relights and compares with."""


@dataclass(frozen=True)
class PaperTable:
    """Rows of methods, and what the table lacks beside the paper's."""

    rows: tuple[SetRow, ...]
    notes: tuple[str, ...]

    def to_table(self) -> str:
        """Markdown."""
        lines = [
            "| method | FID | KID x 1000 | pictures | reference |",
            "|---|---:|---:|---:|---:|",
        ]
        for r in self.rows:
            figures = (f"{r.fid:.1f}", r.kid_text, str(r.count), str(r.reference_count))
            lines.append(f"| {r.method} | {' | '.join(figures)} |")
        return "\n".join([*lines, "", *self.notes])

    def to_json(self) -> str:
        """Rows and notes."""
        rows = [asdict(row) for row in self.rows]
        return json.dumps({"sets": rows, "notes": self.notes}, indent=2)


def front_pictures(log: Path) -> list[Path]:
    """Those of a PandaSet sequence."""
    return sorted((log / "camera" / CAMERA).glob("*.jpg"))


def relit_pictures(work: Path, name: str, skies: Sequence[str]) -> list[Path]:
    """Front pictures of a result of relight under some skies, as --sky takes them: what was made
    under others does not count."""
    scenario = work / "scenarios" / name
    folders = [
        scenario / parse_sky(SkyChoice(sky)).name if len(skies) > 1 else scenario for sky in skies
    ]
    return sorted(p for f in folders for p in (f / "frames" / CAMERA).glob("*.png"))


def kept_features(
    network: Inception, path: Path, pictures: Sequence[Path]
) -> Float64[np.ndarray, "n 2048"]:
    """Of some pictures; kept in `path` (.npz), with what tells whether they are still the same."""
    facts = [p.stat() for p in pictures]
    state = np.array([[s.st_size, s.st_mtime_ns] for s in facts], np.int64).reshape(-1, 2)
    if path.is_file():
        known = load_arrays(path)
        if np.array_equal(known["state"], state):
            return known["features"]
    features = network.features(read_srgb8(p) for p in pictures)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, features=features, state=state)
    return features
