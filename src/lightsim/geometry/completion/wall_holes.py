"""Find holes in measured walls, mostly windows, through which beams pass. `glass` classifies which
of them are glass."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from lightsim.geometry.completion.wall_cells import WallCells

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Largest hole that is closed, in square metres.
_MAX_HOLE_M2 = 40.0
# Least fraction of a hole's border, and of the cells directly above it, that must be wall.
_MIN_BORDER = 0.6
# Fraction of views of sky above which a cell is open; lower fractions may be reflections in glass.
_MAX_SKY_FRACTION = 0.7


def find_wall_holes(cells: WallCells) -> Bool[np.ndarray, "s z"]:
    """Return the missing cells that wall encloses on all sides; unobserved cells count as wall."""
    views = np.maximum(cells.sky + cells.surface_views, 1)
    levels = np.arange(cells.is_covered.shape[1])
    is_wall = cells.is_covered | cells.is_hidden
    is_within = levels <= cells.measured_top[:, None]
    is_missing = is_within & ~is_wall & (cells.sky <= _MAX_SKY_FRACTION * views)
    panes = _surrounded(is_missing, is_wall, cells.cell_m)
    # Cells between window bars, which few rays meet, are closed after the holes around them.
    is_barred = is_within & cells.is_covered & ~cells.is_whole
    return panes | _surrounded(is_barred, is_wall | panes, cells.cell_m)


def _surrounded(
    is_open: Bool[np.ndarray, "s z"], is_wall: Bool[np.ndarray, "s z"], cell_m: float
) -> Bool[np.ndarray, "s z"]:
    """Return the connected pieces of open cells that wall surrounds."""
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
    """Return whether enough of a hole's border, and enough of the cells above it, are wall."""
    from scipy.ndimage import binary_dilation

    border = np.asarray(binary_dilation(piece)) & ~piece
    lintel = np.zeros_like(piece)
    lintel[:, 1:] = piece[:, :-1]
    lintel &= ~piece
    return bool(covered[border].mean() >= _MIN_BORDER and covered[lintel].mean() >= _MIN_BORDER)
