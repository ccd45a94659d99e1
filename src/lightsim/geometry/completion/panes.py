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
    from scipy.ndimage import find_objects
    from skimage.measure import label

    seen = np.maximum(cells.sky + cells.matter, 1)
    levels = np.arange(cells.is_covered.shape[1])
    is_wall = cells.is_covered | cells.is_hidden
    is_missing = (levels <= cells.measured_top[:, None]) & ~is_wall
    is_missing &= cells.sky <= _MAX_SKY_FRACTION * seen
    pieces = np.asarray(label(is_missing, connectivity=1))
    covered = np.pad(is_wall, 1)
    kept = np.zeros_like(is_missing)
    for number, box in enumerate(find_objects(pieces), start=1):
        piece = pieces[box] == number
        if piece.sum() * cells.cell_m**2 > _MAX_HOLE_M2:
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
