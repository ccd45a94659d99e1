"""Panes of glass in facades: upright rectangles of cells that a network classifies as glass.

The network (`networks/panes.py`) predicts log-odds of glass from the features of each cell
(`facade_cells`). Windows are upright rectangles, so rectangles with the greatest sum of log-odds
are selected; isolated cells are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from lightsim.core.buildings import WallPart
from lightsim.geometry.completion.facade_cells import BEHIND_M, CELL_M, FacadeCells

GlassLogOdds = Callable[[Float32[np.ndarray, "p s z"]], Float32[np.ndarray, "s z"]]
"""Function from the features [p, s, z] of cells to their log-odds of glass [s, z]."""

# The values below were chosen on log 002 and training streets; their effect is measured together
# (docs/benchmarks/reconstruction.md, panes).


class _Limits:
    """Selection of rectangles, and depth of panes."""

    surest = 4.0  # Limit of the absolute log-odds of a cell.
    # Log-odds subtracted from each cell: facades of other logs differ from the training streets,
    # and a wall that reflects is a worse error than a matt pane.
    offset_nats = 0.5
    # Least sum of a rectangle's log-odds: about the logarithm of the number of rectangles of a
    # large wall.
    min_sum = 17.0
    widths_m = (0.5, 6.0)  # Least and greatest width of a pane.
    heights_m = (0.75, 4.0)  # Least and greatest height.
    rounds = 4  # Rounds of selection; each fills the remaining space.
    around = 2  # Width of the wall around a pane that gives its level, in cells.
    min_on_frame = 8  # Least number of returns that determine a pane's depth.
    recess_m = (0.03, 0.35)  # Least and greatest depth behind the wall.
    deepest = 25  # Percentile of these returns' offsets; low, as rectangles may contain some wall.


@dataclass(frozen=True)
class Pane(WallPart):
    """A rectangle of glass in a wall.

    Args:
        wall_m: offset of the surrounding wall in front of the wall's plane, in metres.
        out_m: offset of the glass in front of the plane, in metres.
    """

    wall_m: float
    out_m: float


def find_glass(facades: Sequence[FacadeCells], glass_log_odds: GlassLogOdds) -> list[Pane]:
    """Return the panes of all walls.

    Args:
        facades: features of each wall's cells.
        glass_log_odds: the classifier.
    """
    panes: list[Pane] = []
    for facade in facades:
        log_odds = np.clip(
            glass_log_odds(facade.features).astype(np.float64), -_Limits.surest, _Limits.surest
        )
        found = _panes(facade, np.where(facade.is_known, log_odds, 0.0) - _Limits.offset_nats)
        panes += [pane for pane in found if not _is_among(pane, panes)]
    return panes


def _is_among(pane: Pane, others: Sequence[Pane]) -> bool:
    """Return whether a pane's centre lies in one of another wall: planes may be close."""
    middle = pane.middle()
    return any(other.holds(middle, 0.0, BEHIND_M) for other in others)


def _panes(facade: FacadeCells, log_odds: Float64[np.ndarray, "s z"]) -> list[Pane]:
    """Return the panes of one wall, greatest log-odds first; none overlap."""
    boxes = find_rectangles(log_odds)
    level = [_level_m(facade, box) for box in boxes]
    recess = np.array(
        [_recess_m(facade, box, around) for box, around in zip(boxes, level, strict=True)]
    )
    # Panes of one wall have similar depths: those without returns have the median of the others.
    usual = float(np.nanmedian(recess)) if np.isfinite(recess).any() else _Limits.recess_m[0]
    depth = np.where(np.isfinite(recess), recess, usual)
    wall = facade.wall
    panes: list[Pane] = []
    for (i, j, width, height), around, deep in zip(boxes, level, depth.tolist(), strict=True):
        s, z = wall.span_m[0] + i * CELL_M, wall.height_m[0] + j * CELL_M
        span, rise = (s, s + width * CELL_M), (z, z + height * CELL_M)
        panes.append(Pane(wall, span, rise, around, around - deep))
    return panes


def find_rectangles(log_odds: Float64[np.ndarray, "s z"]) -> list[tuple[int, int, int, int]]:
    """Return rectangles with the greatest sums of log-odds, greatest first; none overlap.

    A rectangle is (first s, first z, width, height) in cells.
    """
    from lightsim.geometry.completion.glass_kernels import best_rectangles

    sizes = [
        [max(1, round(m / CELL_M)) for m in limits]
        for limits in (_Limits.widths_m, _Limits.heights_m)
    ]
    found: list[tuple[int, int, int, int]] = []
    is_free = np.ones(log_odds.shape, dtype=bool)
    for _ in range(_Limits.rounds):
        score, size = best_rectangles(log_odds, is_free, (*sizes[0], *sizes[1]))
        order = np.argsort(-score, axis=None, kind="stable")
        order = order[score.reshape(-1)[order] > _Limits.min_sum]
        for i, j in zip(*np.unravel_index(order, score.shape), strict=True):
            width, height = size[i, j].tolist()
            own = slice(i, i + width), slice(j, j + height)
            if is_free[own].all():
                is_free[own] = False
                found.append((int(i), int(j), width, height))
        if len(order) == 0:
            break
    return found


def _level_m(facade: FacadeCells, box: tuple[int, int, int, int]) -> float:
    """Return the offset of the wall around a rectangle in front of the plane, in metres."""
    i, j, width, height = box
    outer = (
        slice(max(i - _Limits.around, 0), i + width + _Limits.around),
        slice(max(j - _Limits.around, 0), j + height + _Limits.around),
    )
    ring = facade.offset_m.copy()
    ring[i : i + width, j : j + height] = np.nan
    values = ring[outer]
    return float(np.nanmedian(values)) if np.isfinite(values).any() else facade.typical_m


def _recess_m(facade: FacadeCells, box: tuple[int, int, int, int], level_m: float) -> float:
    """Return the depth of a pane behind the wall, in metres; NaN with too few returns."""
    place, out_m = facade.returns_place, facade.returns_out_m
    low, size = np.array(box[:2]), np.array(box[2:])
    is_inside = ((place > low + 1) & (place < low + size - 1)).all(axis=1)
    is_inside &= np.abs(out_m - level_m) < _Limits.recess_m[1]
    if is_inside.sum() < _Limits.min_on_frame:
        return np.nan
    return float(
        np.clip(level_m - np.percentile(out_m[is_inside], _Limits.deepest), *_Limits.recess_m)
    )
