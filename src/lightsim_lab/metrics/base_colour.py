"""Errors of base colour against the truth, and remaining shadows in base colour."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress

LoadColour = Callable[[], Float32[np.ndarray, "h w 3"]]

# Range to which true base colour is clipped: darker pixels would dominate errors of logarithms.
_RANGE = (0.02, 0.95)

# Definitions of the classes of surface and light, common to all measures; sensitivity not measured.

# Sun visibility above which a pixel is lit.
LIT_ABOVE = 0.95
# Sun visibility below which a pixel is in shadow.
SHADOW_BELOW = 0.05
# z component of unit normals above which a surface is ground.
GROUND_ABOVE = 0.9
# Absolute z component of unit normals below which a surface is a facade.
FACADE_BELOW = 0.3
# Smallest number of lit and of shadowed pixels for which a ratio is reported.
_MIN_PIXELS = 200


@dataclass(frozen=True, eq=False)
class BaseColourTask:
    """Inputs of one frame.

    Args:
        truth: true base colour, linear.
        sun_visibility: true visible fraction of the solar disc, 0 on surfaces turned away.
        normal_world: true unit normals.
        is_valid: pixels to compare: static surface in the truth and in the twin.
        load_by_method: loaders of estimated base colour by method. The scale-invariant score and
            the ratio do not depend on a common factor.
    """

    truth: Float32[np.ndarray, "h w 3"]
    sun_visibility: Float32[np.ndarray, "h w"]
    normal_world: Float32[np.ndarray, "h w 3"]
    is_valid: Bool[np.ndarray, "h w"]
    load_by_method: Mapping[str, LoadColour]


@dataclass(frozen=True)
class BaseColourRow:
    """Scores of one method on one class of surface, over all frames.

    Args:
        region: "all", "ground" or "facades".
        pixels: number of compared pixels.
        log_rmse: RMS of ln(estimate / truth) over pixels and channels.
        si_log_rmse: `log_rmse` after the optimal factor of each channel.
        factor: geometric mean of estimate / truth.
        lit_shadow_ratio: geometric mean of estimate / truth over lit pixels, divided by that over
            shadowed pixels. 1 means no remaining shadow; None means too few pixels.
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
    """Rows ordered by method, then by region."""

    rows: tuple[BaseColourRow, ...]

    def to_table(self) -> str:
        """Return the report as Markdown."""
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
        """Return all figures as JSON; an undefined ratio is null."""
        return json.dumps(asdict(self), indent=2)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Compared pixels of one method: of one frame, or of all frames concatenated."""

    log_error: Float64[np.ndarray, "n 3"]
    is_lit: Bool[np.ndarray, " n"]
    is_shadowed: Bool[np.ndarray, " n"]
    upward: Float64[np.ndarray, " n"]


def score_base_colour(
    tasks: Iterable[BaseColourTask],
    *,
    progress: Progress | None = None,
) -> BaseColourReport:
    """Score every method over all frames.

    The truth is clipped to [0.02, 0.95] and the estimate to at least 0.002, so that black pixels do
    not dominate.

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
    estimate = np.maximum(colour[valid].astype(np.float64), _RANGE[0] / 10)
    truth = np.clip(task.truth[valid].astype(np.float64), *_RANGE)
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
        # Base colour without remaining shadows has the same error in light and in shadow.
        ratio = float(np.exp(error[lit].mean() - error[shadowed].mean()))
    return BaseColourRow(
        method,
        region,
        len(error),
        float(np.sqrt((error**2).mean())),
        # Subtracting the mean log error of a channel applies its optimal factor.
        float(np.sqrt(((error - error.mean(axis=0)) ** 2).mean())),
        float(np.exp(error.mean())),
        ratio,
    )
