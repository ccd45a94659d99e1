"""Panes of glass in facades: upright rectangles of what a network takes for glass.

The network (`networks/panes.py`) tells cell by cell, from what views and beams tell of the facade
(`facade_cells`). Windows are upright rectangles: the sum of its log-odds finds them, and leaves out
what is only spotted with glass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from lightsim.core.buildings import WallPart
from lightsim.geometry.completion.facade_cells import BEHIND_M, CELL_M, FacadeCells

GlassOdds = Callable[[Float32[np.ndarray, "p s z"]], Float32[np.ndarray, "s z"]]
"""Log-odds that cells are glass, of their planes."""

# Most that one cell says for or against glass, log-odds; and what is taken off, since facades of
# another log are not those that taught: a wall that mirrors is worse than a pane of wall.
_SUREST, _DOUBT = 4.0, 0.5
# What a rectangle must bring: nats that it takes to tell one of those of a large wall.
_LEAST_SUM = 17.0
# Panes' least and greatest width and height.
_WIDTHS_M, _HEIGHTS_M = (0.5, 6.0), (0.75, 4.0)
_ROUNDS = 4
# The wall around a pane, in cells.
_AROUND = 2
# Returns that tell how deep a pane lies in its frame, and between which depths.
_LEAST_ON_FRAME, _RECESS_M = 8, (0.03, 0.35)
# Percentile of these returns: rectangles may hold some of the wall, too.
_DEEPEST = 25


@dataclass(frozen=True)
class Pane(WallPart):
    """A rectangle of glass in a wall.

    Args:
        wall_m, out_m: of the wall around and of the glass before the wall's plane.
    """

    wall_m: float
    out_m: float


def find_glass(facades: Sequence[FacadeCells], glass_odds: GlassOdds) -> list[Pane]:
    """Panes of all walls."""
    panes: list[Pane] = []
    for facade in facades:
        odds = np.clip(glass_odds(facade.planes).astype(np.float64), -_SUREST, _SUREST)
        found = _panes(facade, np.where(facade.is_known, odds, 0.0) - _DOUBT)
        panes += [pane for pane in found if not _is_among(pane, panes)]
    return panes


def _is_among(pane: Pane, others: Sequence[Pane]) -> bool:
    """Whether a pane's middle lies in one of another wall: planes may lie close together."""
    middle = pane.middle()
    return any(other.holds(middle, 0.0, BEHIND_M) for other in others)


def _panes(facade: FacadeCells, odds: Float64[np.ndarray, "s z"]) -> list[Pane]:
    """The most evident rectangles first; none overlap."""
    boxes = find_rectangles(odds)
    level = [_level_m(facade, box) for box in boxes]
    recess = np.array(
        [_recess_m(facade, box, around) for box, around in zip(boxes, level, strict=True)]
    )
    # Panes of one wall lie equally deep: what beams tell of some holds for the others.
    usual = float(np.nanmedian(recess)) if np.isfinite(recess).any() else _RECESS_M[0]
    depth = np.where(np.isfinite(recess), recess, usual)
    wall = facade.wall
    panes: list[Pane] = []
    for (i, j, width, height), around, deep in zip(boxes, level, depth.tolist(), strict=True):
        s, z = wall.span_m[0] + i * CELL_M, wall.height_m[0] + j * CELL_M
        span, rise = (s, s + width * CELL_M), (z, z + height * CELL_M)
        panes.append(Pane(wall, span, rise, around, around - deep))
    return panes


def find_rectangles(odds: Float64[np.ndarray, "s z"]) -> list[tuple[int, int, int, int]]:
    """Rectangles (first s, first z, width, height; cells) in which the log-odds of glass sum up to
    most, greatest sums first; none overlap."""
    from lightsim.geometry.completion.glass_kernels import best_rectangles

    sizes = [[max(1, round(m / CELL_M)) for m in limits] for limits in (_WIDTHS_M, _HEIGHTS_M)]
    found: list[tuple[int, int, int, int]] = []
    is_free = np.ones(odds.shape, dtype=bool)
    for _ in range(_ROUNDS):
        score, size = best_rectangles(odds, is_free, (*sizes[0], *sizes[1]))
        order = np.argsort(-score, axis=None, kind="stable")
        order = order[score.reshape(-1)[order] > _LEAST_SUM]
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
    """Of the wall around a rectangle, before the plane."""
    i, j, width, height = box
    outer = (
        slice(max(i - _AROUND, 0), i + width + _AROUND),
        slice(max(j - _AROUND, 0), j + height + _AROUND),
    )
    ring = facade.offset_m.copy()
    ring[i : i + width, j : j + height] = np.nan
    values = ring[outer]
    return float(np.nanmedian(values)) if np.isfinite(values).any() else facade.typical_m


def _recess_m(facade: FacadeCells, box: tuple[int, int, int, int], level_m: float) -> float:
    """How far behind the wall around it a pane and its bars lie; NaN where no beams tell."""
    place, out_m = facade.returns_place, facade.returns_out_m
    low, size = np.array(box[:2]), np.array(box[2:])
    is_inside = ((place > low + 1) & (place < low + size - 1)).all(axis=1)
    is_inside &= np.abs(out_m - level_m) < _RECESS_M[1]
    if is_inside.sum() < _LEAST_ON_FRAME:
        return np.nan
    return float(np.clip(level_m - np.percentile(out_m[is_inside], _DEEPEST), *_RECESS_M))
