"""What a surface that goes on along a street looks like where nobody saw it.

Lanes, kerbs and pavements run along it. A hole takes over what lies further along, by the shifts
for which its surroundings agree best (shift maps, Pritch et al. 2009,
doi:10.1109/ICCV.2009.5459159; few shifts explain a picture, He and Sun 2012,
doi:10.1007/978-3-642-33709-3_2), at the level of those surroundings. Panes and pillars stand
upright: a front's foot takes over what is seen above it.
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

from lightsim.appearance.intrinsic.shift_kernels import ring_gaps
from lightsim.core.outline import nearest_of

# Chosen while looking at streets 0 and 1; what they do: docs/benchmarks/leaderboard.md (edits).

# Of the map; and how far a sample speaks for places without any.
_CELL_M, _SPREAD_M = 0.05, 0.3
# Narrower holes, such as jambs of windows, stay as they are.
_NARROW_M = 0.5
# Longer holes are filled piece by piece of this length along the street, from where they are best
# surrounded, so many times over at most: what is filled tells what lies beyond it.
_PIECE_M, _ROUNDS = 12.0, 6
# Least and greatest shift, and its step in cells.
_SHIFT_M, _SHIFT_STEP = (1.0, 40.0), 2
# Width of a piece's surroundings; what must be known of them both here and there, cells of them
# that are looked at, and the most that one may differ in log colour.
_RING_M, _LEAST_RING, _RING_CELLS, _RING_LIMIT = 0.6, 0.25, 1000, 0.4
# In log colour: for surroundings that are not known there, and for each metre.
_UNKNOWN_COST, _COST_PER_M = 0.1, 0.001
# Shifts that are tried, and the least that one must add, as a fraction of the piece.
_TRIED, _LEAST_GAIN = 40, 0.03
# Smaller holes stay as they are (.1 m2).
_LEAST_CELLS = 40
# Levels differ by no more (log), and follow the surroundings this far.
_LEVEL_LIMIT, _LEVEL_REACH_M, _LEVEL_FADE = 0.5, 0.5, 0.03
# A front goes on downward as it is within this height.
_STRIP_M = 0.3
_DARKEST = 1e-3


@dataclass(frozen=True, eq=False)
class Samples:
    """Colours of places on a surface.

    Args:
        places: along the street and across it (of a wall: up), metres.
        colours: linear RGB.
        is_hidden: nobody saw them, and their colours say nothing; a place that is neither known
            nor hidden is left alone.
    """

    places: Float64[np.ndarray, "t 2"]
    colours: Float32[np.ndarray, "t 3"]
    is_known: Bool[np.ndarray, " t"]
    is_hidden: Bool[np.ndarray, " t"]


@dataclass(frozen=True, eq=False)
class ShiftMap:
    """A surface unrolled, its rows along the street, with holes that are filled in place.

    Args:
        low_m: its corner, along and across.
        colour: log of linear RGB.
        is_known: of cells whose colour is told.
        is_hole: of cells whose colour is to be found.
    """

    low_m: Float64[np.ndarray, "2"]
    colour: Float32[np.ndarray, "t s 3"]
    is_known: Bool[np.ndarray, "t s"]
    is_hole: Bool[np.ndarray, "t s"]

    @classmethod
    def of(cls, samples: Samples) -> ShiftMap:
        """With the mean colours of all samples that are known."""
        low = samples.places.min(axis=0)
        column, row = np.floor((samples.places - low) / _CELL_M).astype(np.int64).T
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        cell, size = row * shape[1] + column, shape[0] * shape[1]
        known, hidden = (
            np.bincount(cell[chosen], minlength=size).reshape(shape)
            for chosen in (samples.is_known, samples.is_hidden)
        )
        colour = np.zeros((*shape, 3), np.float32)
        codes = np.log(np.maximum(samples.colours[samples.is_known], _DARKEST))
        for channel in range(3):
            total = np.bincount(cell[samples.is_known], codes[:, channel], minlength=size)
            colour[..., channel] = total.reshape(shape) / np.maximum(known, 1)
        away_px, (i, j) = nearest_of(known + hidden > 0)
        is_near = np.asarray(away_px < _SPREAD_M / _CELL_M, dtype=bool)
        is_hole = is_near & (known[i, j] == 0)
        is_hole = np.asarray(binary_opening(is_hole, iterations=_cells(_NARROW_M) // 2))
        is_known = is_near & (hidden[i, j] == 0)
        return cls(low, colour[i, j], np.asarray(binary_opening(is_known, iterations=2)), is_hole)

    def at(
        self, places: Float64[np.ndarray, "n 2"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Linear RGB of places, and which lay in holes that were filled."""
        column, row = np.floor((places - self.low_m) / _CELL_M).astype(np.int64).T
        height, width = self.is_known.shape
        is_inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        row, column = np.where(is_inside, row, 0), np.where(is_inside, column, 0)
        is_told = is_inside & (self.is_known & self.is_hole)[row, column]
        return np.exp(self.colour[row, column]), is_told

    def complete_down(self) -> None:
        """Fill what lies below known cells with what they show."""
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
        """Fill the holes as far as the street tells them."""
        left = self._pieces()
        for _ in range(_ROUNDS):
            left.sort(key=lambda piece: -self._surrounded(piece))
            before, left = left, [piece for piece in left if not self._fill(piece)]
            if len(left) in (0, len(before)):
                break

    def _pieces(self) -> list[_Piece]:
        """Holes, long ones cut."""
        number = np.zeros(self.is_hole.shape, np.int32)
        label(self.is_hole, np.ones((3, 3)), output=number)
        pieces = []
        for index, box in enumerate(find_objects(number), 1):
            cells = np.argwhere(number[box] == index)
            part = cells[:, 1] // _cells(_PIECE_M)
            first = np.array([side.start for side in box])
            chosen = (cells[part == k] + first for k in range(int(part.max()) + 1))
            pieces += [_Piece.of(c, number.shape) for c in chosen if len(c) >= _LEAST_CELLS]
        return pieces

    def _surrounded(self, piece: _Piece) -> float:
        return float(self.is_known[tuple(piece.ring.T)].mean()) if len(piece.ring) else 0.0

    def _fill(self, piece: _Piece) -> bool:
        """Shift by shift, those of the best surroundings first; whether nothing of it is left."""
        ring = piece.ring[self.is_known[tuple(piece.ring.T)]]
        if len(ring) < _LEAST_RING * len(piece.ring):
            return False
        left = piece.cells[~self.is_known[tuple(piece.cells.T)]]
        least = max(_LEAST_GAIN * len(left), 1.0)
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
        """Whether cells are known this far along the street, and those cells."""
        column = cells[:, 1] + shift
        is_inside = (column >= 0) & (column < self.is_known.shape[1])
        there = np.stack([cells[:, 0], np.where(is_inside, column, 0)], axis=1)
        return is_inside & self.is_known[tuple(there.T)], there

    def _gap(
        self, cells: Int64[np.ndarray, "n 2"], shift: int
    ) -> tuple[Int64[np.ndarray, "m 2"], Float32[np.ndarray, "m 3"]]:
        """Those of the cells that are known this far along the street, and how much their colours
        differ from those there."""
        is_there, there = self._shifted(cells, shift)
        here = cells[is_there]
        return here, self.colour[tuple(here.T)] - self.colour[tuple(there[is_there].T)]

    def _best_shifts(self, ring: Int64[np.ndarray, "n 2"]) -> list[int]:
        """Shifts along the street under which a piece's surroundings agree, best first."""
        ring = ring[:: max(1, len(ring) // _RING_CELLS)]
        low, high = (_cells(metres) for metres in _SHIFT_M)
        shifts = np.arange(low, high + 1, _SHIFT_STEP)
        shifts = np.concatenate([shifts, -shifts])
        gap, fraction = ring_gaps(self.colour, self.is_known, ring, shifts, _RING_LIMIT)
        cost = gap + _UNKNOWN_COST * (1 - fraction) + _COST_PER_M * _CELL_M * np.abs(shifts)
        is_told = fraction >= _LEAST_RING
        best = np.argsort(cost[is_told], kind="stable")[:_TRIED]
        return shifts[is_told][best].tolist()

    def _level(
        self, ring: Int64[np.ndarray, "n 2"], shift: int, piece: _Piece
    ) -> Float32[np.ndarray, "h w 3"]:
        """By how much (log) the surroundings here differ from those there: near them as they do,
        further in by their median."""
        here, gap = self._gap(ring, shift)
        gap = np.clip(gap, -_LEVEL_LIMIT, _LEVEL_LIMIT)
        middle = np.median(gap, axis=0)
        image = np.zeros((*piece.shape, 4), np.float32)
        image[tuple((here - piece.low).T)] = np.c_[gap - middle, np.ones(len(gap))]
        reach = _LEVEL_REACH_M / _CELL_M
        smooth = np.asarray(gaussian_filter(image, (reach, reach, 0)))
        return middle + smooth[..., :3] / (smooth[..., 3:] + _LEVEL_FADE)


@dataclass(frozen=True, eq=False)
class _Piece:
    """Of a hole.

    Args:
        low: first row and column of a window that holds cells and ring.
        shape: of the window.
        ring: cells around it, within the map.
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
