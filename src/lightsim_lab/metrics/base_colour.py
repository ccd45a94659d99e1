"""How well base colour agrees with the truth, and how much of the shadows is left in it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress

LoadColour = Callable[[], Float32[np.ndarray, "h w 3"]]

_LEAST, _GREATEST = 0.02, 0.95


# What the measure is defined by.

# A pixel that sees more of the sun than this is lit.
LIT_ABOVE = 0.95
# A pixel that sees less of it is in shadow.
SHADOW_BELOW = 0.05
# Upward part of the normals of ground.
GROUND_ABOVE = 0.9
# Upward part of the normals of facades, up or down.
FACADE_BELOW = 0.3
# Regions with fewer lit or fewer shadowed pixels have no ratio.
_MIN_PIXELS = 200


@dataclass(frozen=True, eq=False)
class BaseColourTask:
    """One frame.

    Args:
        truth: true base colour, linear.
        sun_visibility: true fraction of the solar disc, 0 behind a surface's own horizon.
        normal_world: true normals.
        is_valid: pixels to compare: static surface, where the twin has its surface, too.
        load_by_method: base colour by each method; any common factor is allowed for by the
            scale-invariant score and the ratio.
    """

    truth: Float32[np.ndarray, "h w 3"]
    sun_visibility: Float32[np.ndarray, "h w"]
    normal_world: Float32[np.ndarray, "h w 3"]
    is_valid: Bool[np.ndarray, "h w"]
    load_by_method: Mapping[str, LoadColour]


@dataclass(frozen=True)
class BaseColourRow:
    """Scores of one method on one kind of surface, over all frames.

    Args:
        region: "all", "ground" or "facades".
        pixels: compared.
        log_rmse: RMS of ln(estimate / truth) over pixels and channels.
        si_log_rmse: the same at the best factor of each channel.
        factor: geometric mean of estimate / truth.
        lit_shadow_ratio: geometric mean of estimate / truth over lit pixels divided by that over
            shadowed ones: 1 without any shadow left; None where there are too few of either.
    """

    method: str
    region: str
    pixels: int
    log_rmse: float
    si_log_rmse: float
    factor: float
    lit_shadow_ratio: float | None


@dataclass(frozen=True)
class BaseColourReport:
    """All rows: by method, then by region."""

    rows: tuple[BaseColourRow, ...]

    def row(self, method: str, region: str) -> BaseColourRow:
        """One row.

        Raises:
            InputError: nothing was measured under these names.
        """
        for row in self.rows:
            if (row.method, row.region) == (method, region):
                return row
        raise InputError(
            "no such row in the report",
            got=f"{method}, {region}",
            expected="; ".join(f"{row.method}, {row.region}" for row in self.rows),
        )

    def to_table(self) -> str:
        """Markdown."""
        lines = [
            "| base colour | surface | pixels | log RMSE | at best scale | factor | lit/shadow |",
            "|---|---|---:|---:|---:|---:|---:|",
        ]
        for row in self.rows:
            ratio = "-" if row.lit_shadow_ratio is None else f"{row.lit_shadow_ratio:.3f}"
            lines.append(
                f"| {row.method} | {row.region} | {row.pixels} | {row.log_rmse:.3f} "
                f"| {row.si_log_rmse:.3f} | {row.factor:.2f} | {ratio} |"
            )
        return "\n".join(lines)

    def to_json(self) -> str:
        """All rows with every figure; a ratio without a value is null."""
        return json.dumps(asdict(self), indent=2)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Compared pixels of all frames, for one method."""

    log_error: Float64[np.ndarray, "n 3"]
    is_lit: Bool[np.ndarray, " n"]
    is_shadowed: Bool[np.ndarray, " n"]
    upward: Float64[np.ndarray, " n"]


def score_base_colour(
    tasks: Iterable[BaseColourTask],
    *,
    progress: Progress | None = None,
) -> BaseColourReport:
    """Scores of every method over all frames.

    Colours are clipped to [0.02, 0.95] (the truth) and from below (the estimate), so that black
    pixels do not decide.

    Raises:
        InputError: nothing can be compared.
    """
    parts: dict[str, list[_Pixels]] = {}
    for task in (progress or SilentProgress()).track(tasks, "compare base colour"):
        for method, load in task.load_by_method.items():
            parts.setdefault(method, []).append(_compare(task, load()))
    if not parts or all(len(part.upward) == 0 for part in next(iter(parts.values()))):
        raise InputError(
            "no pixel of the truth can be compared with the twin",
            remedy="Give the truth of the log that the twin was built from.",
        )
    rows = []
    for method, found in parts.items():
        pixels = _Pixels(
            np.concatenate([p.log_error for p in found]),
            np.concatenate([p.is_lit for p in found]),
            np.concatenate([p.is_shadowed for p in found]),
            np.concatenate([p.upward for p in found]),
        )
        for region, chosen in _regions(pixels).items():
            if chosen.any():
                rows.append(_row(method, region, pixels, chosen))
    return BaseColourReport(tuple(rows))


def _compare(task: BaseColourTask, colour: Float32[np.ndarray, "h w 3"]) -> _Pixels:
    valid = task.is_valid
    estimate = np.maximum(colour[valid].astype(np.float64), _LEAST / 10)
    truth = np.clip(task.truth[valid].astype(np.float64), _LEAST, _GREATEST)
    visibility = task.sun_visibility[valid]
    return _Pixels(
        np.log(estimate / truth),
        visibility > LIT_ABOVE,
        visibility < SHADOW_BELOW,
        task.normal_world[valid][:, 2].astype(np.float64),
    )


def _regions(pixels: _Pixels) -> dict[str, Bool[np.ndarray, " n"]]:
    return {
        "all": np.ones(len(pixels.upward), dtype=bool),
        "ground": pixels.upward > GROUND_ABOVE,
        "facades": np.abs(pixels.upward) < FACADE_BELOW,
    }


def _row(
    method: str,
    region: str,
    pixels: _Pixels,
    chosen: Bool[np.ndarray, " n"],
) -> BaseColourRow:
    error = pixels.log_error[chosen]
    lit, shadowed = pixels.is_lit[chosen], pixels.is_shadowed[chosen]
    ratio = None
    if min(lit.sum(), shadowed.sum()) >= _MIN_PIXELS:
        ratio = float(np.exp(error[lit].mean() - error[shadowed].mean()))
    return BaseColourRow(
        method,
        region,
        len(error),
        float(np.sqrt((error**2).mean())),
        float(np.sqrt(((error - error.mean(axis=0)) ** 2).mean())),
        float(np.exp(error.mean())),
        ratio,
    )
