"""Holes of walls that measured wall surrounds, mostly windows that beams went through; which of
them are panes of glass is told by `glass`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from lightsim.geometry.completion.wall_cells import WallCells

# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md).

# Larger holes stay open.
_MAX_HOLE_M2 = 40.0
# Fraction of a hole's border, and of its lintel, that must be wall.
_MIN_BORDER = 0.6
# Cells that more than this fraction of the views shows as sky are open; glass reflects it too.
_MAX_SKY_FRACTION = 0.7


def find_panes(cells: WallCells) -> Bool[np.ndarray, "s z"]:
    """Missing parts that wall surrounds, with a lintel: measured, or what no view looked at."""
    seen = np.maximum(cells.sky + cells.matter, 1)
    levels = np.arange(cells.is_covered.shape[1])
    is_wall = cells.is_covered | cells.is_hidden
    is_within = levels <= cells.measured_top[:, None]
    is_missing = is_within & ~is_wall & (cells.sky <= _MAX_SKY_FRACTION * seen)
    panes = _surrounded(is_missing, is_wall, cells.cell_m)
    # What lies between bars that few rays meet.
    is_barred = is_within & cells.is_covered & ~cells.is_whole
    return panes | _surrounded(is_barred, is_wall | panes, cells.cell_m)


def _surrounded(
    is_open: Bool[np.ndarray, "s z"], is_wall: Bool[np.ndarray, "s z"], cell_m: float
) -> Bool[np.ndarray, "s z"]:
    """The connected pieces of what is open around which wall is."""
    from scipy.ndimage import find_objects
    from skimage.measure import label

    pieces = np.asarray(label(is_open, connectivity=1))
    covered = np.pad(is_wall & ~is_open, 1)
    kept = np.zeros_like(is_open)
    for number, box in enumerate(find_objects(pieces), start=1):
        piece = pieces[box] == number
        if piece.sum() * cell_m**2 > _MAX_HOLE_M2:
            continue
        grown = tuple(slice(b.start, b.stop + 2) for b in box)
        if _is_surrounded(np.pad(piece, 1), covered[grown]):
            kept[box] |= piece
    return kept


def _is_surrounded(piece: Bool[np.ndarray, "a b"], covered: Bool[np.ndarray, "a b"]) -> bool:
    """Whether enough of a hole's border, and enough of what lies over it, is measured."""
    from scipy.ndimage import binary_dilation

    border = np.asarray(binary_dilation(piece)) & ~piece
    lintel = np.zeros_like(piece)
    lintel[:, 1:] = piece[:, :-1]
    lintel &= ~piece
    return bool(covered[border].mean() >= _MIN_BORDER and covered[lintel].mean() >= _MIN_BORDER)
