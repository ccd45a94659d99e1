"""Significance of the differences between two evaluations of the same frames."""

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
from lightsim.errors import ArtefactError, InputError
from lightsim.store.artefact import read_json

_HIGHER_IS_BETTER = {"psnr_db": True, "ssim": True, "lpips": False, "lpips_alex": False}
# (region, whether exposure was fitted, method, score)
Key = tuple[str, bool, str, str]


@dataclass(frozen=True)
class ComparedRow:
    """Paired difference of one score of one method, over all conditions, cameras and logs.

    Args:
        q_value: the p-value adjusted for the number of rows (Benjamini & Hochberg 1995,
            doi:10.1111/j.2517-6161.1995.tb02031.x); NaN for too few sequences.
    """

    region: str
    is_exposed: bool
    method: str
    score: str
    found: PairedDifference
    q_value: float

    @property
    def verdict(self) -> str:
        """Verdict on the second evaluation: `better` or `worse` if the difference is
        significant."""
        if np.isnan(self.q_value):
            return "too few frames"
        if self.q_value >= SIGNIFICANT_BELOW:
            return "not significant"
        is_better = (self.found.difference > 0) is _HIGHER_IS_BETTER[self.score]
        return "better" if is_better else "worse"

    @property
    def shown_q(self) -> str:
        """The q-value as text; small values are given as an upper bound, because none is 0."""
        if np.isnan(self.q_value):
            return "-"
        return "< .001" if self.q_value < 0.001 else f"{self.q_value:.3f}"


@dataclass(frozen=True)
class ComparisonReport:
    """Rows of the scores that both evaluations contain."""

    rows: tuple[ComparedRow, ...]

    def to_table(self) -> str:
        """Return the report as Markdown."""
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
        """Return all rows as JSON; undefined values are null."""
        rows: list[dict[str, Any]] = []
        for row in self.rows:
            values = {**asdict(row), **asdict(row.found), "verdict": row.verdict}
            del values["found"]
            # NaN is the only value that differs from itself.
            rows.append({k: None if v != v else v for k, v in values.items()})
        return json.dumps({"rows": rows}, indent=2, allow_nan=False)


def compare_evaluations(
    first: Path, second: Path, methods: tuple[str, ...] = ()
) -> ComparisonReport:
    """Compute paired differences, second minus first.

    Frames of one camera of one log, under all skies, are one sequence, because they show the same
    scene.

    Args:
        first, second: JSON files of `lightsim evaluate frames|relight`, or folders of such files,
            one per log, with equal names.
        methods: one method of the first and one of the second; empty compares methods of equal
            names.

    Raises:
        InputError, ArtefactError: a file is no evaluation, or the evaluations have no frame in
            common.
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
    common = [key for key in sides[0] if sides[0][key].keys() & sides[1].get(key, {}).keys()]
    if not common:
        raise InputError(
            "the evaluations have no frame of one method and region in common",
            where=f"{first}, {second}",
            expected="the same log and skies; other methods are paired by --methods A,B",
        )
    return compare_samples({key: (sides[0][key], sides[1][key]) for key in common})


def compare_samples(pairs: Mapping[Key, tuple[Samples, Samples]]) -> ComparisonReport:
    """Compute paired differences, second minus first, with p-values adjusted for all pairs.

    Raises:
        InputError: a pair has no frame in common.
    """
    found = [compare_paired(*pair) for pair in pairs.values()]
    adjusted = _adjusted([f.p_value for f in found])
    return ComparisonReport(
        tuple(ComparedRow(*key, f, q) for key, f, q in zip(pairs, found, adjusted, strict=True))
    )


def _read(path: Path) -> dict[Key, Samples]:
    """Read the samples of every score; sequences are named by file and camera."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found: dict[Key, dict[tuple[Any, str], float]] = {}
    for file in files:
        log = file.stem if path.is_dir() else ""
        for row in read_rows(file):
            for stem, scores in row.scores_by_stem.items():
                for score in DIGITS:
                    value = getattr(scores, score)
                    # Equal pictures have infinite PSNR, which has no mean.
                    if np.isfinite(value):
                        key = (row.region, row.is_exposed, row.method, score)
                        frame = ((log, row.camera_name), f"{row.condition}/{stem}")
                        # The condition is part of the frame: a sequence contains all skies.
                        found.setdefault(key, {})[frame] = value
    return dict(found)


def read_rows(file: Path) -> list[FrameRow]:
    """Read the rows of an evaluation.

    Raises:
        InputError: the file is missing, broken or no evaluation.
    """
    try:
        rows = read_json(file)["rows"]
        return [FrameRow.from_json(row) for row in rows]
    except ArtefactError as error:
        raise InputError(
            error.what,
            where=file,
            got=error.got,
            expected="a file that lightsim evaluate frames or relight wrote with --out",
        ) from error
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "the file is no evaluation of frames",
            where=file,
            got=f"{type(error).__name__}: {error}"[:100],
            expected="a file that lightsim evaluate frames or relight wrote with --out",
        ) from error


def _adjusted(p_values: list[float]) -> list[float]:
    """Return the q-values; undefined p-values stay NaN and do not count."""
    from scipy.stats import false_discovery_control

    values = np.array(p_values)
    is_known = ~np.isnan(values)
    if is_known.any():
        values[is_known] = false_discovery_control(values[is_known])
    return values.tolist()
