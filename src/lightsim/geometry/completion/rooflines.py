"""How high each wall rises: one profile along the wall that explains all that was seen of it.

A column of the wall is matter up to its roof and free above: an upright prism. Every cell of it
says so for or against (measured surface, sky, matter, beams that passed); the height of a building
has a prior, which matters where no view reaches the roof, as with every house near the road; and a
roof steps rarely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.profiles import best_profile, energy_of_filling
from lightsim.geometry.completion.wall_cells import WallCells

# Height of a building above the ground before anything is seen: between compact low-rise (3 to
# 10 m) and compact mid-rise (10 to 25 m; Stewart and Oke 2012, doi:10.1175/BAMS-D-11-00019.1).
_HEIGHT_M, _LOG_STD = 10.0, 0.5
# Spread of the heights of one street; its own roofs tell their middle. Not measured alone.
_STREET_LOG_STD = 0.3
# Buildings are about this wide: so often is the prior asked.
_BUILDING_M = 10.0
# Lower walls are fences: they tell nothing about buildings.
_MIN_BUILDING_M = 4.0
# Evidence of one cell in nats: a measured surface; each view, beam or sweep, and all at most.
# Neighbouring cells see the same pixels, so this is far less than one view alone would tell.
# Not measured alone.
_COVERED = 1.0
_SKY, _MATTER, _PASS, _SILENT = (0.5, 2.0), (0.1, 0.4), (0.5, 2.0), (0.2, 0.5)
# A step of the roof, and each metre of it.
_STEP, _STEP_PER_M = 4.0, 0.2
# The roof is seen where a view shows sky this near above it.
_SEEN_WITHIN_M = 1.0


@dataclass(frozen=True, eq=False)
class Roofline:
    """How high one wall rises.

    Args:
        cells: the wall and its evidence.
        ground_m: z of the ground before each column.
        top: number of filled cells of each column, from the wall's lowest part.
        is_seen: a view shows the sky above the roof.
    """

    cells: WallCells
    ground_m: Float64[np.ndarray, " s"]
    top: Int64[np.ndarray, " s"]
    is_seen: Bool[np.ndarray, " s"]

    @property
    def top_m(self) -> Float64[np.ndarray, " s"]:
        """z of the roof's edge."""
        return self.cells.wall.height_m[0] + self.top * self.cells.cell_m

    @property
    def height_m(self) -> Float64[np.ndarray, " s"]:
        """The roof's edge above the ground."""
        return self.top_m - self.ground_m


def find_rooflines(walls: Sequence[WallCells], ground: GroundMap) -> list[Roofline]:
    """The most probable height of every column, with the prior that the log's own roofs give."""
    height, log_std = _HEIGHT_M, _LOG_STD
    rooflines = [_roofline(cells, ground, height, log_std) for cells in walls]
    height, log_std = _height_prior(rooflines)
    return [_roofline(cells, ground, height, log_std) for cells in walls]


def _height_prior(rooflines: Sequence[Roofline]) -> tuple[float, float]:
    """Median and log spread of heights of this street's buildings: conjugate update of the prior,
    every wall with a seen roof as one draw."""
    draws = [
        float(np.median(np.log(r.height_m[seen])))
        for r in rooflines
        if (seen := r.is_seen & (r.height_m > _MIN_BUILDING_M)).any()
    ]
    weight = len(draws) / _STREET_LOG_STD**2
    prior = 1.0 / (_LOG_STD**2 - _STREET_LOG_STD**2)
    mean = (prior * np.log(_HEIGHT_M) + weight * (np.mean(draws) if draws else 0.0)) / (
        prior + weight
    )
    return float(np.exp(mean)), float(np.sqrt(_STREET_LOG_STD**2 + 1.0 / (prior + weight)))


def _roofline(cells: WallCells, ground: GroundMap, height_m: float, log_std: float) -> Roofline:
    wall, cell = cells.wall, cells.cell_m
    foot = wall.at(cells.s_m, np.zeros_like(cells.s_m), 1.0)
    ground_m = np.minimum(ground.look_up(foot[:, :2]).astype(np.float64), wall.height_m[0])
    energy = _energy(cells)
    tops_m = wall.height_m[0] + cell * np.arange(energy.shape[1]) - ground_m[:, None]
    z_score = np.log(np.maximum(tops_m, cell) / height_m) / log_std
    energy += cell / _BUILDING_M * 0.5 * z_score**2
    top = best_profile(energy, _STEP, _STEP_PER_M * cell)
    reach = max(round(_SEEN_WITHIN_M / cell), 1)
    levels = np.arange(cells.sky.shape[1])
    is_just_above = (levels >= top[:, None]) & (levels < top[:, None] + reach)
    return Roofline(cells, ground_m, top, (is_just_above & (cells.sky > 0)).any(axis=1))


def _energy(cells: WallCells) -> Float64[np.ndarray, "s t"]:
    """Nats against each top, for every column: wrongly filled cells below, wrongly free above."""

    def capped(count: np.ndarray, nats: tuple[float, float]) -> np.ndarray:
        return np.minimum(count * nats[0], nats[1])

    against_filled = capped(cells.sky, _SKY) + capped(cells.passes, _PASS)
    against_filled += capped(cells.silent, _SILENT)
    # Panes mirror the sky and let beams through: what a measured part surrounds is wall.
    levels = np.arange(cells.sky.shape[1])
    against_filled[levels <= cells.measured_top[:, None]] = 0.0
    against_free = np.where(cells.is_covered, _COVERED, capped(cells.matter, _MATTER))
    return energy_of_filling(against_filled, against_free)
