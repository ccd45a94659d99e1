"""Height of each wall: the roof profile along the wall with the least energy.

A column of the wall is an upright prism: filled up to its roof and free above. Every cell
contributes evidence (measured surface, sky, observed surface, beams that passed). The height of a
building has a prior, which decides where no view reaches the roof, as with most houses near the
road; steps of the roof cost energy. Observed surface that another house of the row explains has
little weight (`neighbours`), so walls are solved iteratively.
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

# The energies below, in nats, were chosen on log 002 and street 0; only their joint effect was
# measured (docs/benchmarks/reconstruction.md).

# Prior of a building's height above the ground: median in metres, and standard deviation of its
# logarithm. It lies between compact low-rise (3 to 10 m) and compact mid-rise (10 to 25 m; Stewart
# and Oke 2012, doi:10.1175/BAMS-D-11-00019.1).
_PRIOR = (10.0, 0.5)
# Standard deviation of the logarithm of heights within one street; its observed roofs determine the
# median. Not measured alone.
_STREET_LOG_STD = 0.3
# Width of a building, in metres; the prior counts once for each.
_BUILDING_M = 10.0
# Height below which walls are fences, in metres: they do not affect the prior and have no building
# behind them.
_MIN_BUILDING_M = 4.0


class _Energy:
    """Energy of a cell's evidence in nats: per observation, and limit of the sum.

    The same pixels observe adjacent cells, so one observation counts far less than an independent
    one.
    """

    measured = 1.0  # Measured surface.
    open = (0.5, 2.0)  # Views of sky and beams that passed, against a filled cell.
    background = (0.1, 0.5)  # Views of surface behind the wall, against a filled cell.
    no_return = (0.2, 0.5)  # Sweeps without a return, against a filled cell.
    surface = (0.1, 0.4)  # Views of a surface, against a free cell.


# Distance above a roof within which a view of sky makes it an observed roof, in metres.
_SEEN_WITHIN_M = 1.0
# Iterations in which the occlusion between houses is updated.
_ROUNDS = 8
# Weight of the new result against that of the previous iteration, for convergence.
_DAMPING = 0.5


class _Depth:
    """Profile of the depth of a building, in slices of the prism."""

    step_m = 0.5  # Thickness of a slice.
    free = 3.0  # Energy of a slice that is wholly free.
    left_out = 0.15  # Energy of leaving out a slice.
    rear_step = (2.0, 0.1)  # Energy of a step of the rear wall, and of its slices.


def find_rooflines(walls: Sequence[WallCells], ground: GroundMap) -> list[Roofline]:
    """Return the most probable height of every column, with the prior of the log's observed roofs.

    Depths are 0 (`with_depths` estimates them).
    """
    if not walls:
        return []
    # In the first iteration views of surface have no weight: a neighbour could explain all of them.
    own = [np.zeros(cells.surface_views.shape) for cells in walls]
    prior = _PRIOR
    found = [_roofline(*pair, ground, prior) for pair in zip(walls, own, strict=True)]
    for _ in range(_ROUNDS):
        prior = height_prior(found)
        own = [
            (1.0 - _DAMPING) * before + _DAMPING * now
            for before, now in zip(own, unexplained(walls, found), strict=True)
        ]
        found = [_roofline(*pair, ground, prior) for pair in zip(walls, own, strict=True)]
    return found


def with_depths(
    walls: Sequence[WallCells], rooflines: Sequence[Roofline], space: FreeSpace
) -> list[Roofline]:
    """Estimate the depth of the building behind each column from free space.

    It is 0 below a known roof: the house is present already (`pitched_roofs`).
    """
    return [
        replace(roofline, depth_m=np.where(np.isinf(w.roof_m), _depth_m(roofline, space), 0.0))
        for w, roofline in zip(walls, rooflines, strict=True)
    ]


def tops_at(
    roofline: Roofline, prior: tuple[float, float], levels: Float64[np.ndarray, " l"]
) -> Int64[np.ndarray, "l s"]:
    """Return the tops below which the roof lies with the given probabilities.

    Observed roofs retain their top. Along a row of houses a new height begins with each house, so
    an unobserved roof has its neighbour's height for a few metres, and the street's distribution
    further on.

    Args:
        roofline: estimated roofline.
        prior: median in metres and log standard deviation of the street's heights (`height_prior`).
        levels: probabilities.
    """
    cell, count = roofline.cell_m, roofline.energy.shape[1]
    tops_m = roofline.wall.height_m[0] + cell * np.arange(count) - roofline.ground_m[:, None]
    pull = _prior_energy(tops_m, cell, prior)
    fresh = np.exp(-pull) / np.maximum(tops_m, cell)
    evidence = roofline.energy - cell / _BUILDING_M * pull
    chance = min(cell / _BUILDING_M, 1.0)
    fresh /= fresh.sum(axis=1, keepdims=True)
    below = np.cumsum(label_probabilities(evidence, fresh, chance), axis=1)
    tops = (below < levels[:, None, None]).sum(axis=2)
    return np.where(roofline.is_seen, roofline.top, tops)


def _prior_energy(
    tops_m: Float64[np.ndarray, "s t"], cell_m: float, prior: tuple[float, float]
) -> Float64[np.ndarray, "s t"]:
    """Return the energy of heights under the log-normal prior of one building, in nats."""
    height_m, log_std = prior
    return 0.5 * (np.log(np.maximum(tops_m, cell_m) / height_m) / log_std) ** 2


def height_prior(rooflines: Sequence[Roofline]) -> tuple[float, float]:
    """Return the median in metres and the log standard deviation of this street's building heights.

    Conjugate update of the prior, with every wall that has an observed roof as one draw.
    """
    draws = [
        float(np.median(np.log(r.height_m[seen])))
        for r in rooflines
        if (seen := r.is_seen & (r.height_m > _MIN_BUILDING_M)).any()
    ]
    weight = len(draws) / _STREET_LOG_STD**2
    prior = 1.0 / (_PRIOR[1] ** 2 - _STREET_LOG_STD**2)
    mean = prior * np.log(_PRIOR[0]) + weight * (np.mean(draws) if draws else 0.0)
    log_std = np.sqrt(_STREET_LOG_STD**2 + 1.0 / (prior + weight))
    return float(np.exp(mean / (prior + weight))), float(log_std)


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
    energy += cell / _BUILDING_M * _prior_energy(tops_m, cell, prior)
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
    is_seen = (is_just_above & (cells.sky > 0)).any(axis=1)
    return replace(found, is_seen=is_seen | np.isfinite(cells.roof_m))


def _shown(cells: WallCells) -> Int64[np.ndarray, " s"]:
    """Return the number of cells of each column up to the highest with surface."""
    highest_view = np.where(cells.surface_views > 0, np.arange(cells.sky.shape[1]), -1).max(axis=1)
    return np.maximum(np.ceil(cells.front_top), highest_view).astype(np.int64) + 1


def _energy(cells: WallCells, own: Float64[np.ndarray, "s z"]) -> Float64[np.ndarray, "s t"]:
    """Return the energy of each top: wrongly filled cells below, wrongly free cells above."""

    def capped(count: np.ndarray, nats: tuple[float, float]) -> np.ndarray:
        return np.minimum(count * nats[0], nats[1])

    against_filled = capped(cells.sky, _Energy.open) + capped(cells.passing_beams, _Energy.open)
    against_filled += capped(cells.sweeps_without_return, _Energy.no_return) + capped(
        cells.background_views, _Energy.background
    )
    # Panes reflect the sky and transmit beams, so cells below measured wall are always filled.
    levels = np.arange(cells.sky.shape[1])
    against_filled[levels <= cells.measured_top[:, None]] = 0.0
    low_m = cells.wall.height_m[0] + cells.cell_m * levels
    against_filled[low_m > cells.roof_m[:, None]] = _Energy.open[1]
    # Up to the measured height, observed surface belongs to the wall itself.
    weight = np.where(levels <= cells.front_top[:, None], 1.0, own)
    against_free = np.where(
        cells.is_measured, _Energy.measured, weight * capped(cells.surface_views, _Energy.surface)
    )
    return energy_of_filling(against_filled, against_free)


def _depth_m(roofline: Roofline, space: FreeSpace) -> Float64[np.ndarray, " s"]:
    """Return the depth of the prism behind each column, in metres, limited by free space."""
    inward_m = INSET_M + (np.arange(int(HOUSE_DEPTH_M / _Depth.step_m)) + 0.5) * _Depth.step_m
    # Test heights of a slice; its foot and its roof's edge are inaccurate and omitted.
    heights = np.linspace(0.1, 0.95, 12)
    z = roofline.ground_m[:, None] + heights * roofline.height_m[:, None]
    s = np.broadcast_to(roofline.s_m[:, None], z.shape)
    wall = roofline.wall
    places = wall.at(s, z)[:, None] - inward_m[:, None, None] * wall.normal
    free = space.at(places).mean(axis=2)
    energy = energy_of_filling(_Depth.free * free, np.full(free.shape, _Depth.left_out))
    slices = best_profile(energy, *_Depth.rear_step)
    return np.where(roofline.height_m < _MIN_BUILDING_M, 0.0, slices * _Depth.step_m)
