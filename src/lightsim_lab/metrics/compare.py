"""Two evaluations of the same frames: which differences are more than chance?"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.quality.frame_report import DIGITS, FrameRow
from lightsim.build.quality.statistics import (
    SIGNIFICANT_BELOW,
    PairedDifference,
    Samples,
    compare_paired,
)
from lightsim.errors import InputError
from lightsim.store.artefact import read_json

_LEAST_SHOWN = 0.001
_HIGHER_IS_BETTER = {"psnr_db": True, "ssim": True, "lpips": False, "lpips_alex": False}
Key = tuple[str, bool, str, str]
"""Region, whether exposure was fitted, method, score."""


@dataclass(frozen=True)
class ComparedRow:
    """One score of one method, over all conditions, cameras and logs.

    Args:
        q_value: the p-value adjusted for the number of rows (Benjamini & Hochberg 1995,
            doi:10.1111/j.2517-6161.1995.tb02031.x); NaN where there were too few sequences.
    """

    region: str
    is_exposed: bool
    method: str
    score: str
    found: PairedDifference
    q_value: float

    @property
    def verdict(self) -> str:
        """`better` or `worse` (the second) where the difference is significant."""
        if np.isnan(self.q_value):
            return "too few frames"
        if self.q_value >= SIGNIFICANT_BELOW:
            return "not significant"
        is_better = (self.found.difference > 0) is _HIGHER_IS_BETTER[self.score]
        return "better" if is_better else "worse"

    @property
    def shown_q(self) -> str:
        """For tables; no probability is 0."""
        if np.isnan(self.q_value):
            return "-"
        return "< .001" if self.q_value < _LEAST_SHOWN else f"{self.q_value:.3f}"


@dataclass(frozen=True)
class ComparisonReport:
    """All rows that both evaluations have."""

    rows: tuple[ComparedRow, ...]

    def to_table(self) -> str:
        """Markdown."""
        lines = [
            "| region | exposure | method | score | first | second | difference, 95 % | q "
            "| n | second is |",
            "|---|---|---|---|---:|---:|---:|---:|---:|---|",
        ]
        for row in self.rows:
            f, digits = row.found, DIGITS[row.score]
            exposure = "fitted" if row.is_exposed else "raw"
            span = f"{f.difference:+.{digits}f} [{f.low:+.{digits}f}, {f.high:+.{digits}f}]"
            lines.append(
                f"| {row.region} | {exposure} | {row.method} | {row.score} | {f.first:.{digits}f} "
                f"| {f.second:.{digits}f} | {span} | {row.shown_q} | {f.count} {f.unit} "
                f"| {row.verdict} |"
            )
        return "\n".join(lines)

    def to_json(self) -> str:
        """All rows; values that are not defined are null."""
        rows: list[dict[str, Any]] = []
        for row in self.rows:
            values = {**asdict(row), **asdict(row.found), "verdict": row.verdict}
            del values["found"]
            rows.append({k: None if v != v else v for k, v in values.items()})
        return json.dumps({"rows": rows}, indent=2, allow_nan=False)


def compare_evaluations(
    first: Path, second: Path, methods: tuple[str, ...] = ()
) -> ComparisonReport:
    """Paired differences, second minus first.

    Frames of one camera of one log, under all skies, count as one sequence: they show the same
    scene.

    Args:
        first, second: JSON files of `lightsim evaluate frames|relight`, or folders of them, one a
            log, of equal names.
        methods: one in the first, one in the second; empty compares methods of equal names.

    Raises:
        InputError, ArtefactError: a file is none of these, or nothing is in both.
    """
    if methods and len(methods) != 2:
        raise InputError(
            "methods are compared in pairs",
            where="--methods",
            got=", ".join(methods),
            expected="one of the first evaluation, one of the second",
        )
    label = " -> ".join(methods)
    sides = []
    for number, path in enumerate((first, second)):
        rows = _read(path)
        if methods:
            wanted = methods[number]
            rows = {(*k[:2], label, k[3]): s for k, s in rows.items() if k[2] == wanted}
        sides.append(rows)
    shared = [key for key in sides[0] if sides[0][key].keys() & sides[1].get(key, {}).keys()]
    if not shared:
        raise InputError(
            "the evaluations share no frame of one method and region",
            where=f"{first}, {second}",
            expected="the same log and skies; other methods are paired by --methods A,B",
        )
    return compare_samples({key: (sides[0][key], sides[1][key]) for key in shared})


def compare_samples(pairs: Mapping[Key, tuple[Samples, Samples]]) -> ComparisonReport:
    """Paired differences, second minus first; p-values are adjusted for all of them together.

    Raises:
        InputError: a pair shares no frame.
    """
    found = [compare_paired(*pair) for pair in pairs.values()]
    adjusted = _adjusted([f.p_value for f in found])
    return ComparisonReport(
        tuple(ComparedRow(*key, f, q) for key, f, q in zip(pairs, found, adjusted, strict=True))
    )


def _read(path: Path) -> dict[Key, Samples]:
    """Samples of every score of the files; sequences are named by file and camera."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found: dict[Key, dict[tuple[Any, str], float]] = {}
    for file in files:
        log = file.stem if path.is_dir() else ""
        for row in read_rows(file):
            for stem, scores in row.scores_by_stem.items():
                for score in DIGITS:
                    value = getattr(scores, score)
                    # Equal pictures have an endless PSNR, which JSON does not hold.
                    if np.isfinite(value):
                        key = (row.region, row.is_exposed, row.method, score)
                        frame = ((log, row.camera_name), f"{row.condition}/{stem}")
                        found.setdefault(key, {})[frame] = value
    return dict(found)


def read_rows(file: Path) -> list[FrameRow]:
    """The rows that an evaluation wrote.

    Raises:
        InputError, ArtefactError: the file is none.
    """
    try:
        return [FrameRow.from_json(row) for row in read_json(file)["rows"]]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "this is no evaluation of frames",
            where=file,
            got=f"{type(error).__name__}: {error}"[:100],
            expected="what lightsim evaluate frames or relight wrote with --out",
        ) from error


def _adjusted(p_values: list[float]) -> list[float]:
    """Q-values of those that are defined."""
    from scipy.stats import false_discovery_control

    values = np.array(p_values)
    is_known = ~np.isnan(values)
    if is_known.any():
        values[is_known] = false_discovery_control(values[is_known])
    return values.tolist()
