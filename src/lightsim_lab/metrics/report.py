"""Report of an evaluation of frames, with one table per kind of measure."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lightsim.build.quality.frame_report import FramesReport, finite
from lightsim.store.entries import Entries
from lightsim_lab.metrics.consistency import ConsistencyRow
from lightsim_lab.metrics.distribution import SetRow
from lightsim_lab.metrics.left_shadows import LeftShadowRow
from lightsim_lab.metrics.shadows import ShadowRow

# Columns with text; all others have numbers.
_WORDS = {"condition", "region", "exposure", "method", "between"}
_FRAMES = (
    *("condition", "region", "exposure", "method"),
    *("PSNR dB", "SSIM", "LPIPS VGG", "LPIPS Alex"),
)
_CLASSES = ("condition", "region", "method", "PSNR dB", "SSIM")
_SETS = ("condition", "method", "pictures", "reference", "FID", "KID x 1000")
_SHADOWS = ("condition", "method", "pixels", "shadow IoU", "precision", "recall")
_LEFT = ("condition", "method", "pixels", "source shadow left %")
_CONSISTENCY = (
    *("condition", "method", "between", "pairs", "points"),
    *("delta E 2000", "warp error x 255", "over recorded"),
)


@dataclass(frozen=True)
class Cost:
    """Computing cost of a method.

    Args:
        seconds_a_frame: processor seconds per frame, summed over threads, loading included.
        peak_memory_mb: peak memory of the process.
    """

    seconds_a_frame: float
    peak_memory_mb: int

    @staticmethod
    def read(entries: Entries) -> Cost:
        """Read the cost from a JSON file.

        Raises:
            ArtefactError: a figure is missing or no number.
        """
        seconds, memory = entries.number("seconds_a_frame"), entries.number("peak_memory_mb")
        return Cost(seconds, int(memory))


@dataclass(frozen=True)
class EvaluationReport:
    """Scores of frames, optional further measures, and the known costs by method."""

    frames: FramesReport
    sets: tuple[SetRow, ...] = ()
    shadows: tuple[ShadowRow, ...] = ()
    left_shadows: tuple[LeftShadowRow, ...] = ()
    consistency: tuple[ConsistencyRow, ...] = ()
    costs: Mapping[str, Cost] = field(default_factory=dict)

    def tables(self) -> list[tuple[str, tuple[str, ...], list[tuple[str, ...]]]]:
        """Return title, columns and lines of each table that is not empty."""
        frames = self.frames.lines()
        found = [
            ("Frames", _FRAMES, [line for line in frames if line[1] in ("masked", "whole")]),
            ("Classes of pixels", _CLASSES, _class_lines(frames)),
            ("Sets of frames", _SETS, [_set_line(row) for row in self.sets]),
            ("Shadows", _SHADOWS, [_shadow_line(row) for row in self.shadows]),
            ("Shadows of the source", _LEFT, [_left_line(row) for row in self.left_shadows]),
            (
                "Agreement between pictures",
                _CONSISTENCY,
                [_consistency_line(row) for row in self.consistency],
            ),
        ]
        return [table for table in found if table[2]]

    def to_table(self) -> str:
        """Return all tables as Markdown."""
        return "\n\n".join(_markdown(columns, lines) for _, columns, lines in self.tables())

    def to_json(self) -> str:
        """Return all figures as JSON, frame by frame; undefined values are null."""
        parts = {
            "sets": self.sets,
            "shadows": self.shadows,
            "left_shadows": self.left_shadows,
            "consistency": self.consistency,
        }
        # The key `rows` is what `lightsim evaluate compare` reads.
        found: dict[str, Any] = {"rows": self.frames.json_rows()}
        found["costs"] = {method: asdict(cost) for method, cost in self.costs.items()}
        for name, rows in parts.items():
            found[name] = [finite(asdict(row)) for row in rows]
        return json.dumps(found, indent=2, allow_nan=False)


def _class_lines(lines: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the raw scores by class; scores with fitted exposure are only in the JSON."""
    return [
        (condition, region, method, *scores[:2])
        for condition, region, exposure, method, *scores in lines
        if region not in ("masked", "whole") and exposure == "raw"
    ]


def _set_line(row: SetRow) -> tuple[str, ...]:
    names = (row.condition, row.method)
    return *names, str(row.count), str(row.reference_count), f"{row.fid:.1f}", row.kid_text


def _shadow_line(row: ShadowRow) -> tuple[str, ...]:
    figures = (f"{x:.3f}" for x in (row.iou, row.precision, row.recall))
    return row.condition, row.method, str(row.pixels), *figures


def _left_line(row: LeftShadowRow) -> tuple[str, ...]:
    return row.condition, row.method, str(row.pixels), f"{100 * row.contrast:.1f}"


def _consistency_line(row: ConsistencyRow) -> tuple[str, ...]:
    relative = row.relative_warp_error
    return (
        *(row.condition, row.method, row.pairs, str(row.count), str(row.points)),
        *(f"{row.delta_e:.2f}", f"{255 * row.warp_error:.2f}"),
        "-" if np.isnan(relative) else f"{relative:.2f}",
    )


def _markdown(names: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---" if name in _WORDS else "---:" for name in names]
    rows = (names, *lines)
    text = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([text[0], f"|{'|'.join(rule)}|", *text[1:]])
