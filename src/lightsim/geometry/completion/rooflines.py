"""How high each wall rises: one profile along the wall that explains all that was seen of it.

A column of the wall is matter up to its roof and free above: an upright prism. Every cell of it
says so for or against (measured surface, sky, matter, beams that passed); the height of a building
has a prior, which matters where no view reaches the roof, as with every house near the road; and a
roof steps rarely. Matter that another house of the row explains says little (`neighbours`), so
walls are solved round by round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.buildings import Roofline
from lightsim.core.fields import GroundMap
from lightsim.core.profiles import best_profile, energy_of_filling, label_probabilities
from lightsim.geometry.completion.free_space import FreeSpace
from lightsim.geometry.completion.neighbours import HOUSE_DEPTH_M, INSET_M, unexplained
from lightsim.geometry.completion.wall_cells import WallCells

# Height of a building above the ground before anything is seen: between compact low-rise (3 to
# 10 m) and compact mid-rise (10 to 25 m; Stewart and Oke 2012, doi:10.1175/BAMS-D-11-00019.1).
_HEIGHT_M, _LOG_STD = 10.0, 0.5
# Spread of the heights of one street; its own roofs tell their middle. Not measured alone.
_STREET_LOG_STD = 0.3
# Buildings are about this wide: so often is the prior asked.
_BUILDING_M = 10.0
# Lower walls are fences: they tell nothing about buildings and have none behind them.
_MIN_BUILDING_M = 4.0
# Evidence of one cell in nats: a measured surface; each view, beam or sweep, and all at most.
# Neighbouring cells see the same pixels, so this is far less than one view alone would tell.
# Not measured alone.
_COVERED = 1.0
_SKY, _MATTER, _PASS = (0.5, 2.0), (0.1, 0.4), (0.5, 2.0)
_THROUGH, _SILENT = (0.1, 0.5), (0.2, 0.5)
# The roof is seen where a view shows sky this near above it.
_SEEN_WITHIN_M = 1.0
# Rounds in which houses explain for each other what views show, and how far each follows the last.
_ROUNDS, _DAMPING = 8, 0.5
# Slices in which the depth of a building is looked for.
_DEPTH_STEP_M = 0.5
# Nats of a slice of the prism that is wholly free, and of leaving away one that is not.
_FREE, _SLICE = 3.0, 0.15
# A step of the rear wall, and each slice of it.
_REAR_STEP, _REAR_STEP_PER_SLICE = 2.0, 0.1


def find_rooflines(walls: Sequence[WallCells], ground: GroundMap) -> list[Roofline]:
    """The most probable height of every column, with the prior that the log's own roofs give;
    nothing behind it yet (`with_depths`)."""
    if not walls:
        return []
    # At first views show nothing that a neighbour could not explain.
    own = [np.zeros(cells.matter.shape) for cells in walls]
    prior = (_HEIGHT_M, _LOG_STD)
    found = [_roofline(*pair, ground, prior) for pair in zip(walls, own, strict=True)]
    for _ in range(_ROUNDS):
        prior = height_prior(found)
        own = [
            (1.0 - _DAMPING) * before + _DAMPING * now
            for before, now in zip(own, unexplained(walls, found), strict=True)
        ]
        found = [_roofline(*pair, ground, prior) for pair in zip(walls, own, strict=True)]
    return found


def with_depths(rooflines: Sequence[Roofline], space: FreeSpace) -> list[Roofline]:
    """With how deep the building behind each column is."""
    return [replace(roofline, depth_m=_depth_m(roofline, space)) for roofline in rooflines]


def tops_at(
    roofline: Roofline, prior: tuple[float, float], levels: Float64[np.ndarray, " l"]
) -> Int64[np.ndarray, "l s"]:
    """Tops that the roof lies below with these probabilities; a roof that some view shows keeps
    its own.

    Along a row of houses a new height begins with each house, so that a roof which nothing was
    seen of is as high as its neighbour for a few metres, and further on as high as any of the
    street.

    Args:
        prior: median and log spread of heights of the street (`height_prior`).
    """
    cell, count = roofline.cell_m, roofline.energy.shape[1]
    tops_m = roofline.wall.height_m[0] + cell * np.arange(count) - roofline.ground_m[:, None]
    pull = _pull(tops_m, cell, prior)
    fresh = np.exp(-pull) / np.maximum(tops_m, cell)
    evidence = roofline.energy - cell / _BUILDING_M * pull
    chance = min(cell / _BUILDING_M, 1.0)
    fresh /= fresh.sum(axis=1, keepdims=True)
    below = np.cumsum(label_probabilities(evidence, fresh, chance), axis=1)
    tops = (below < levels[:, None, None]).sum(axis=2)
    return np.where(roofline.is_seen, roofline.top, tops)


def _pull(
    tops_m: Float64[np.ndarray, "s t"], cell_m: float, prior: tuple[float, float]
) -> Float64[np.ndarray, "s t"]:
    """Nats against heights for one building: a log-normal's."""
    height_m, log_std = prior
    return 0.5 * (np.log(np.maximum(tops_m, cell_m) / height_m) / log_std) ** 2


def height_prior(rooflines: Sequence[Roofline]) -> tuple[float, float]:
    """Median and log spread of heights of this street's buildings: conjugate update of the prior,
    every wall with a seen roof as one draw."""
    draws = [
        float(np.median(np.log(r.height_m[seen])))
        for r in rooflines
        if (seen := r.is_seen & (r.height_m > _MIN_BUILDING_M)).any()
    ]
    weight = len(draws) / _STREET_LOG_STD**2
    prior = 1.0 / (_LOG_STD**2 - _STREET_LOG_STD**2)
    mean = prior * np.log(_HEIGHT_M) + weight * (np.mean(draws) if draws else 0.0)
    spread = np.sqrt(_STREET_LOG_STD**2 + 1.0 / (prior + weight))
    return float(np.exp(mean / (prior + weight))), float(spread)


def _roofline(
    cells: WallCells,
    own: Float64[np.ndarray, "s z"],
    ground: GroundMap,
    prior: tuple[float, float],
) -> Roofline:
    wall, cell = cells.wall, cells.cell_m
    foot = wall.at(cells.s_m, np.zeros_like(cells.s_m), 1.0)
    ground_m = np.minimum(ground.look_up(foot[:, :2]).astype(np.float64), wall.height_m[0])
    energy = _energy(cells, own)
    tops_m = wall.height_m[0] + cell * np.arange(energy.shape[1]) - ground_m[:, None]
    energy += cell / _BUILDING_M * _pull(tops_m, cell, prior)
    found = Roofline(
        wall,
        cell,
        ground_m,
        energy.astype(np.float32),
        _shown(cells),
        np.zeros(len(energy), dtype=np.int64),
        np.zeros(len(energy), dtype=bool),
        np.zeros(len(energy)),
        prior[1],
    ).solved()
    reach = max(round(_SEEN_WITHIN_M / cell), 1)
    levels = np.arange(cells.sky.shape[1])
    is_just_above = (levels >= found.top[:, None]) & (levels < found.top[:, None] + reach)
    return replace(found, is_seen=(is_just_above & (cells.sky > 0)).any(axis=1))


def _shown(cells: WallCells) -> Int64[np.ndarray, " s"]:
    """Cells of each column up to the highest that was measured or that a view shows as matter."""
    matter = np.where(cells.matter > 0, np.arange(cells.sky.shape[1]), -1).max(axis=1)
    return np.maximum(np.ceil(cells.front_top), matter).astype(np.int64) + 1


def _energy(cells: WallCells, own: Float64[np.ndarray, "s z"]) -> Float64[np.ndarray, "s t"]:
    """Nats against each top, for every column: wrongly filled cells below, wrongly free above."""

    def capped(count: np.ndarray, nats: tuple[float, float]) -> np.ndarray:
        return np.minimum(count * nats[0], nats[1])

    against_filled = capped(cells.sky, _SKY) + capped(cells.passes, _PASS)
    against_filled += capped(cells.silent, _SILENT) + capped(cells.through, _THROUGH)
    # Panes mirror the sky and let beams through: what a measured part surrounds is wall.
    levels = np.arange(cells.sky.shape[1])
    against_filled[levels <= cells.measured_top[:, None]] = 0.0
    # What the wall's measured part reaches is its own.
    weight = np.where(levels <= cells.front_top[:, None], 1.0, own)
    against_free = np.where(cells.is_met, _COVERED, weight * capped(cells.matter, _MATTER))
    return energy_of_filling(against_filled, against_free)


def _depth_m(roofline: Roofline, space: FreeSpace) -> Float64[np.ndarray, " s"]:
    """Of the prism behind each column, until views looked through where it would be."""
    inward_m = INSET_M + (np.arange(int(HOUSE_DEPTH_M / _DEPTH_STEP_M)) + 0.5) * _DEPTH_STEP_M
    heights = np.linspace(0.1, 0.95, 12)
    z = roofline.ground_m[:, None] + heights * roofline.height_m[:, None]
    s = np.broadcast_to(roofline.s_m[:, None], z.shape)
    wall = roofline.wall
    places = wall.at(s, z)[:, None] - inward_m[:, None, None] * wall.normal
    free = space.at(places).mean(axis=2)
    energy = energy_of_filling(_FREE * free, np.full(free.shape, _SLICE))
    slices = best_profile(energy, _REAR_STEP, _REAR_STEP_PER_SLICE)
    return np.where(roofline.height_m < _MIN_BUILDING_M, 0.0, slices * _DEPTH_STEP_M)
