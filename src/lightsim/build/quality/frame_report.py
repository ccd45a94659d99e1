"""Tables of image scores: rows of sequences, and means for each condition."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from lightsim.build.quality.metrics import ImageScores
from lightsim.build.quality.statistics import Samples, Spread, clustered_mean
from lightsim.errors import InputError

Region = str
"""`whole`: all pixels; `masked`: valid pixels; any other name: a class of pixels."""
DIGITS = {"psnr_db": 2, "ssim": 3, "lpips": 3, "lpips_alex": 3}
"""Decimals to print for each score."""


@dataclass(frozen=True)
class FrameRow:
    """Mean scores over the frames of one sequence. The exposure factor of raw rows is 1.

    Args:
        scores_by_stem: scores of each frame.
    """

    condition: str
    camera_name: str
    method: str
    region: Region
    is_exposed: bool
    exposure_factor: float
    count: int
    scores: ImageScores
    scores_by_stem: Mapping[str, ImageScores] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, Region, bool, str]:
        """Condition, region, exposure and method: the key of a line of the table."""
        return self.condition, self.region, self.is_exposed, self.method

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> FrameRow:
        """Read a row of `FramesReport.to_json`; null becomes NaN.

        Raises:
            KeyError, TypeError, AttributeError: the row is malformed.
        """
        by_stem = {stem: _scores(s) for stem, s in row.get("scores_by_stem", {}).items()}
        return cls(**{**row, "scores": _scores(row["scores"]), "scores_by_stem": by_stem})


@dataclass(frozen=True)
class FramesReport:
    """All rows, in the order of the tasks."""

    rows: tuple[FrameRow, ...]

    def mean(
        self, condition: str, method: str, region: Region, is_exposed: bool = False
    ) -> ImageScores:
        """Return the mean over all frames of all cameras of a condition.

        Raises:
            InputError: nothing was measured under these names.
        """
        rows = self._rows(condition, method, region, is_exposed)
        # Weighted by frames: each frame counts alike, whatever its camera.
        weights = np.array([row.count for row in rows], dtype=np.float64)
        table = np.array([[getattr(r.scores, name) for name in DIGITS] for r in rows])
        return ImageScores(*((table * weights[:, None]).sum(0) / weights.sum()).tolist())

    def spread(
        self, score: str, condition: str, method: str, region: Region, is_exposed: bool = False
    ) -> Spread:
        """Return the mean of one score with its standard error over the cameras' sequences.

        Raises:
            InputError: nothing was measured under these names.
        """
        rows = self._rows(condition, method, region, is_exposed)
        found = samples(rows, score)
        # Without a score of any single frame (all are NaN, or the report is of an older version),
        # the mean has no standard error.
        if found:
            return clustered_mean(found)
        mean = getattr(self.mean(condition, method, region, is_exposed), score)
        return Spread(mean, float("nan"), len(rows), "sequences")

    def _rows(
        self, condition: str, method: str, region: Region, is_exposed: bool
    ) -> list[FrameRow]:
        wanted = (condition, region, is_exposed, method)
        rows = [row for row in self.rows if row.key == wanted]
        if not rows:
            raise InputError(
                "no such row in the report",
                got=(condition, method, region, is_exposed),
                expected=f"conditions {self.conditions}, methods {self.methods}",
            )
        return rows

    @property
    def conditions(self) -> tuple[str, ...]:
        """Each condition once, in the order of the rows."""
        return tuple(dict.fromkeys(row.condition for row in self.rows))

    @property
    def methods(self) -> tuple[str, ...]:
        """Each method once, in the order of the rows."""
        return tuple(dict.fromkeys(row.method for row in self.rows))

    def lines(self) -> list[tuple[str, ...]]:
        """Return the cells of the table: condition, region, exposure, method and every score,
        pooled over cameras."""
        keys = dict.fromkeys(row.key for row in self.rows)
        cells = []
        for condition, region, is_exposed, method in sorted(keys, key=lambda k: k[:3]):
            scores = [
                self.spread(name, condition, method, region, is_exposed).format(digits)
                for name, digits in DIGITS.items()
            ]
            exposure = "fitted" if is_exposed else "raw"
            cells.append((condition, region, exposure, method, *scores))
        return cells

    def to_table(self) -> str:
        """Return a Markdown table of `lines`."""
        lines = [
            "| condition | region | exposure | method | PSNR dB | SSIM | LPIPS VGG | LPIPS Alex |",
            "|---|---|---|---|---:|---:|---:|---:|",
        ]
        return "\n".join(lines + [f"| {' | '.join(cells)} |" for cells in self.lines()])

    def to_json(self) -> str:
        """Return all rows of single cameras with their frames; scores without a value are null."""
        return json.dumps({"rows": self.json_rows()}, indent=2, allow_nan=False)

    def json_rows(self) -> list[dict[str, Any]]:
        """Return the rows of `to_json`."""
        return [finite(asdict(row)) for row in self.rows]


def samples(rows: list[FrameRow], score: str) -> Samples:
    """Return one score of all frames of some rows, for statistics; NaN is left out."""
    found = {
        ((row.condition, row.camera_name), stem): float(getattr(scores, score))
        for row in rows
        for stem, scores in row.scores_by_stem.items()
    }
    return {key: value for key, value in found.items() if not np.isnan(value)}


def _scores(values: Mapping[str, float | None]) -> ImageScores:
    # Scores of other versions are ignored.
    known = {f.name for f in fields(ImageScores)}
    return ImageScores(**{k: np.nan if v is None else v for k, v in values.items() if k in known})


def finite(value: Any) -> Any:
    """Return a JSON value in which NaN and infinity are null."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
