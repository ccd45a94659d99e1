"""Completion of unobserved surface along a street by shift maps.

Lanes, kerbs and pavements extend along the street. A hole is filled with colours shifted along it,
at the shifts that match the hole's surroundings best (shift maps, Pritch et al. 2009,
doi:10.1109/ICCV.2009.5459159; few shifts suffice, He and Sun 2012,
doi:10.1007/978-3-642-33709-3_2), adjusted to the brightness of the surroundings. Panes and pillars
of fronts are vertical, so the lower part of a front is filled with the colours above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    find_objects,
    gaussian_filter,
    generate_binary_structure,
    label,
    uniform_filter1d,
)

from lightsim.appearance.intrinsic.shift_kernels import ring_differences
from lightsim.core.outline import nearest_of

# The values below were chosen on synthetic streets 0 and 1. Only their joint effect is measured
# (docs/benchmarks/leaderboard.md, edits).

# Size of a cell of the map, in metres.
_CELL_M = 0.05
# Distance from the nearest sample, in metres, up to which a cell has the sample's state.
_REACH_M = 0.3
# Width in metres below which holes, such as window jambs, are not filled.
_NARROW_M = 0.5
# Area in cells below which holes are not filled (0.1 m2).
_MIN_CELLS = 40
# Length along the street, in metres, of the pieces of long holes.
_PIECE_M = 12.0
# Least and greatest shift along the street, in metres.
_SHIFT_M = (1.0, 40.0)
# Width of the ring around a piece whose agreement is compared, in metres.
_RING_M = 0.6
# Least known fraction of the ring, both around the piece and at the shifted position.
_MIN_RING = 0.25

# Greatest difference in log colour that one cell of the ring contributes.
_RING_LIMIT = 0.4
# Cost, in log colour, of a shift whose ring is unknown at the shifted position.
_UNKNOWN_COST = 0.1
# Cost per metre of shift, in log colour: near sources are preferred.
_COST_PER_M = 0.001
# Number of shifts that may fill one piece.
_MAX_SHIFTS = 40
# Least fraction of a piece that a shift must fill.
_MIN_GAIN = 0.03
# Greatest adjustment of brightness and colour, in log colour.
_LEVEL_LIMIT = 0.5
# Standard deviation of the filter that extends the ring's adjustment into the hole, in metres.
_LEVEL_REACH_M = 0.5
# Weight of the ring's median adjustment in that filter: it prevails far from the ring.
_LEVEL_FADE = 0.03
# Height in metres over which the colours above the foot of a front are averaged.
_STRIP_M = 0.3


@dataclass(frozen=True, eq=False)
class Samples:
    """Colours at points of a surface.

    Args:
        places: coordinates along and across the street (on a front: up), metres.
        colours: linear RGB.
        is_known: mask of points with an observed colour.
        is_hidden: mask of unobserved points. Points in neither mask are neither read nor filled.
    """

    places: Float64[np.ndarray, "t 2"]
    colours: Float32[np.ndarray, "t 3"]
    is_known: Bool[np.ndarray, " t"]
    is_hidden: Bool[np.ndarray, " t"]


@dataclass(frozen=True, eq=False)
class ShiftMap:
    """Unrolled surface with rows along the street, whose holes are filled in place.

    Args:
        low_m: coordinates of the first cell's corner, along and across.
        colour: log of linear RGB.
        is_known: mask of cells with a colour.
        is_hole: mask of cells to be filled.
    """

    low_m: Float64[np.ndarray, "2"]
    colour: Float32[np.ndarray, "t s 3"]
    is_known: Bool[np.ndarray, "t s"]
    is_hole: Bool[np.ndarray, "t s"]

    @classmethod
    def of(cls, samples: Samples) -> ShiftMap:
        """Average the known samples in each cell, and detect the holes."""
        low = samples.places.min(axis=0)
        column, row = np.floor((samples.places - low) / _CELL_M).astype(np.int64).T
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        cell, size = row * shape[1] + column, shape[0] * shape[1]
        known, hidden = (
            np.bincount(cell[chosen], minlength=size).reshape(shape)
            for chosen in (samples.is_known, samples.is_hidden)
        )
        colour = np.zeros((*shape, 3), np.float32)
        logs = np.log(np.maximum(samples.colours[samples.is_known], 1e-3))
        for channel in range(3):
            total = np.bincount(cell[samples.is_known], logs[:, channel], minlength=size)
            colour[..., channel] = total.reshape(shape) / np.maximum(known, 1)
        away_px, (i, j) = nearest_of(known + hidden > 0)
        is_near = np.asarray(away_px < _REACH_M / _CELL_M, dtype=bool)
        is_hole = is_near & (known[i, j] == 0)
        is_hole = np.asarray(binary_opening(is_hole, iterations=_cells(_NARROW_M) // 2))
        is_known = is_near & (hidden[i, j] == 0)
        return cls(low, colour[i, j], np.asarray(binary_opening(is_known, iterations=2)), is_hole)

    def at(
        self, places: Float64[np.ndarray, "n 2"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Return linear RGB at points, and the mask of points in filled holes."""
        column, row = np.floor((places - self.low_m) / _CELL_M).astype(np.int64).T
        height, width = self.is_known.shape
        is_inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        row, column = np.where(is_inside, row, 0), np.where(is_inside, column, 0)
        is_filled = is_inside & (self.is_known & self.is_hole)[row, column]
        return np.exp(self.colour[row, column]), is_filled

    def complete_down(self) -> None:
        """Fill cells below known ones with the mean colour of a strip above."""
        known = self.is_known[..., None].astype(np.float32)
        strip = _cells(_STRIP_M)
        above = uniform_filter1d(self.colour * known, strip, axis=0, origin=-(strip // 2))
        count = uniform_filter1d(known, strip, axis=0, origin=-(strip // 2))
        rows = np.arange(len(known), dtype=np.int32)[:, None]
        lowest = np.where(self.is_known, rows, len(rows))
        nearest = np.minimum.accumulate(lowest[::-1], axis=0)[::-1]
        row, column = np.nonzero(self.is_hole & (nearest < len(rows)))
        source = nearest[row, column]
        self.colour[row, column] = above[source, column] / count[source, column]
        self.is_known[row, column] = True

    def complete_along(self) -> None:
        """Fill the holes with shifted colours, where the street has similar surroundings."""
        left = self._pieces()
        # Filled pieces become surroundings of others, so pieces with the most known surroundings
        # come first, and the others are tried again, at most six times.
        for _ in range(6):
            left.sort(key=lambda piece: -self._surrounded(piece))
            before, left = left, [piece for piece in left if not self._fill(piece)]
            if len(left) in (0, len(before)):
                break

    def _pieces(self) -> list[_Piece]:
        """Holes, divided along the street into pieces."""
        number = np.zeros(self.is_hole.shape, np.int32)
        label(self.is_hole, np.ones((3, 3)), output=number)
        pieces = []
        for index, box in enumerate(find_objects(number), 1):
            cells = np.argwhere(number[box] == index)
            part = cells[:, 1] // _cells(_PIECE_M)
            first = np.array([side.start for side in box])
            chosen = (cells[part == k] + first for k in range(int(part.max()) + 1))
            pieces += [_Piece.of(c, number.shape) for c in chosen if len(c) >= _MIN_CELLS]
        return pieces

    def _surrounded(self, piece: _Piece) -> float:
        return float(self.is_known[tuple(piece.ring.T)].mean()) if len(piece.ring) else 0.0

    def _fill(self, piece: _Piece) -> bool:
        """Fill a piece by the best shifts in turn; return True if it is complete."""
        ring = piece.ring[self.is_known[tuple(piece.ring.T)]]
        if len(ring) < _MIN_RING * len(piece.ring):
            return False
        left = piece.cells[~self.is_known[tuple(piece.cells.T)]]
        least = max(_MIN_GAIN * len(left), 1.0)
        for shift in self._best_shifts(ring):
            is_there, there = self._shifted(left, shift)
            if is_there.sum() < least:
                continue
            here = tuple(left[is_there].T)
            level = self._level(ring, shift, piece)[tuple((left[is_there] - piece.low).T)]
            self.colour[here] = self.colour[tuple(there[is_there].T)] + level
            self.is_known[here] = True
            left = left[~is_there]
            if len(left) == 0:
                return True
        return False

    def _shifted(
        self, cells: Int64[np.ndarray, "n 2"], shift: int
    ) -> tuple[Bool[np.ndarray, " n"], Int64[np.ndarray, "n 2"]]:
        """Return the mask of cells whose shifted cells are known, and the shifted cells."""
        column = cells[:, 1] + shift
        is_inside = (column >= 0) & (column < self.is_known.shape[1])
        there = np.stack([cells[:, 0], np.where(is_inside, column, 0)], axis=1)
        return is_inside & self.is_known[tuple(there.T)], there

    def _colour_differences(
        self, cells: Int64[np.ndarray, "n 2"], shift: int
    ) -> tuple[Int64[np.ndarray, "m 2"], Float32[np.ndarray, "m 3"]]:
        """Return cells whose shifted cells are known, and the differences of their log colours."""
        is_there, there = self._shifted(cells, shift)
        here = cells[is_there]
        return here, self.colour[tuple(here.T)] - self.colour[tuple(there[is_there].T)]

    def _best_shifts(self, ring: Int64[np.ndarray, "n 2"]) -> list[int]:
        """Return the shifts, in cells, at which a piece's ring matches the street, best first."""
        # At most some 1000 cells of the ring, to save time.
        ring = ring[:: max(1, len(ring) // 1000)]
        low, high = (_cells(metres) for metres in _SHIFT_M)
        # Every second shift: a search at half of the resolution.
        shifts = np.arange(low, high + 1, 2)
        shifts = np.concatenate([shifts, -shifts])
        gap, fraction = ring_differences(self.colour, self.is_known, ring, shifts, _RING_LIMIT)
        cost = gap + _UNKNOWN_COST * (1 - fraction) + _COST_PER_M * _CELL_M * np.abs(shifts)
        is_usable = fraction >= _MIN_RING
        best = np.argsort(cost[is_usable], kind="stable")[:_MAX_SHIFTS]
        return shifts[is_usable][best].tolist()

    def _level(
        self, ring: Int64[np.ndarray, "n 2"], shift: int, piece: _Piece
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return the log colour difference between ring and shifted ring, extended into the hole.

        It varies smoothly near the ring, and tends to the ring's median further inside.
        """
        here, gap = self._colour_differences(ring, shift)
        gap = np.clip(gap, -_LEVEL_LIMIT, _LEVEL_LIMIT)
        middle = np.median(gap, axis=0)
        image = np.zeros((*piece.shape, 4), np.float32)
        image[tuple((here - piece.low).T)] = np.c_[gap - middle, np.ones(len(gap))]
        reach = _LEVEL_REACH_M / _CELL_M
        smooth = np.asarray(gaussian_filter(image, (reach, reach, 0)))
        return middle + smooth[..., :3] / (smooth[..., 3:] + _LEVEL_FADE)


@dataclass(frozen=True, eq=False)
class _Piece:
    """Piece of a hole.

    Args:
        low: first row and column of the window that contains the cells and the ring.
        shape: of the window.
        cells: rows and columns of the piece's cells.
        ring: rows and columns of the cells around the piece, within the map.
    """

    low: Int64[np.ndarray, "2"]
    shape: tuple[int, ...]
    cells: Int64[np.ndarray, "n 2"]
    ring: Int64[np.ndarray, "r 2"]

    @classmethod
    def of(cls, cells: Int64[np.ndarray, "n 2"], map_shape: tuple[int, ...]) -> _Piece:
        width = _cells(_RING_M)
        low = np.maximum(cells.min(axis=0) - width, 0)
        high = np.minimum(cells.max(axis=0) + width + 1, map_shape)
        inside = np.zeros(tuple(high - low), bool)
        inside[tuple((cells - low).T)] = True
        grown = binary_dilation(inside, generate_binary_structure(2, 1), iterations=width)
        return cls(low, inside.shape, cells, np.argwhere(grown & ~inside) + low)


def _cells(metres: float) -> int:
    return round(metres / _CELL_M)
