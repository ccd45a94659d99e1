"""Occlusion between the buildings of a row: which building explains the observed silhouette.

Houses of a row have a common front plane. Above a low house, views show the side of its tall
neighbour: a surface, but not the low house's wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int16

from lightsim.core.buildings import Roofline
from lightsim.geometry.completion.prism_kernels import raise_to_filled
from lightsim.geometry.completion.wall_cells import WallCells

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Depth of a building unless free space limits it, in metres.
HOUSE_DEPTH_M = 12.0
# Distance behind the wall from which the depth counts, in metres: panes and reveals lie before it.
INSET_M = 0.35
# Edge of the plan's cells, in metres.
_PLAN_M = 0.5
# Range of distances behind a point of a wall in which a ray is tested, in metres: nearer it is
# inside the same house, farther it has left the row of houses.
_BEHIND_M = (2.0, 60.0)
# Greatest distance between planes of one row, in metres: bays, recesses and panes divide one front
# into several planes.
_ROW_M = 1.5
# Least cosine between the normals of one row's walls.
_ROW_COSINE = 0.9
# Probability that a view shows a surface where no house is: trees, masts, errors of the mattes.
_UNMODELLED_SURFACE = 0.1
# Distances behind a wall at which a house behind it is searched, in metres.
_SEARCH_BEHIND_M = (0.75, 1.5)


@dataclass(frozen=True, eq=False)
class PrismPlan:
    """Plan of the prisms behind one wall.

    Args:
        low_m: lowest corner, frame world.
        column: column of the wall whose prism covers each cell; -1 for none.
    """

    low_m: Float64[np.ndarray, "2"]
    column: Int16[np.ndarray, "x y"]

    @classmethod
    def of(cls, roofline: Roofline, depth_m: Float64[np.ndarray, " s"] | None = None) -> PrismPlan:
        """Return a house's plan; `depth_m` is the depth per column (None: `HOUSE_DEPTH_M`)."""
        inward_m = np.arange(0.0, HOUSE_DEPTH_M, _PLAN_M / 2)
        places = _behind(roofline, INSET_M + inward_m)
        low = places.reshape(-1, 2).min(axis=0)
        cells = np.floor((places - low) / _PLAN_M).astype(np.int64)
        owner = np.broadcast_to(np.arange(len(places))[:, None], cells.shape[:2])
        is_building = inward_m < (HOUSE_DEPTH_M if depth_m is None else depth_m[:, None])
        is_building = np.broadcast_to(is_building, owner.shape)
        column = np.full(cells.reshape(-1, 2).max(axis=0) + 1, -1, dtype=np.int16)
        column[cells[is_building, 0], cells[is_building, 1]] = owner[is_building]
        return cls(low, column)

    def at(self, places: Float64[np.ndarray, "*n 2"]) -> Int16[np.ndarray, "*n"]:
        """Return the column whose prism covers each place; -1 for none."""
        cells = np.floor((places - self.low_m) / _PLAN_M).astype(np.int64)
        is_inside = np.all((cells >= 0) & (cells < self.column.shape), axis=-1)
        i, j = np.moveaxis(np.where(is_inside[..., None], cells, 0), -1, 0)
        return np.where(is_inside, self.column[i, j], np.int16(-1))


@dataclass(frozen=True, eq=False)
class _Prisms:
    """Prisms behind one wall with the probability of their height.

    Args:
        plan: prisms in plan.
        filled: probability that each cell of the wall lies below the roof.
        low_m: lowest corner of plan and wall, frame world.
        cell_m: height of a cell.
    """

    plan: PrismPlan
    filled: Float64[np.ndarray, "s c"]
    low_m: Float64[np.ndarray, "3"]
    cell_m: float

    @classmethod
    def of(cls, roofline: Roofline) -> _Prisms:
        """Return the prisms of depth `HOUSE_DEPTH_M`."""
        plan = PrismPlan.of(roofline)
        low = np.append(plan.low_m, roofline.wall.height_m[0])
        return cls(plan, roofline.filled(), low, roofline.cell_m)


def _is_of_row(roofline: Roofline, other: Roofline) -> bool:
    wall, foot = other.wall, other.wall.at(other.s_m, np.zeros_like(other.s_m))
    away_m = np.abs((foot - roofline.wall.origin_m)[:, :2] @ roofline.wall.normal[:2])
    return bool(wall.normal @ roofline.wall.normal > _ROW_COSINE and away_m.min() < _ROW_M)


def _behind(
    roofline: Roofline, inward_m: Float64[np.ndarray, " d"]
) -> Float64[np.ndarray, "s d 2"]:
    """Return the positions (x, y) at these distances behind each column's foot."""
    foot = roofline.wall.at(roofline.s_m, np.zeros_like(roofline.s_m))
    return foot[:, None, :2] - inward_m[:, None] * roofline.wall.normal[:2]


def unexplained(
    cells: Sequence[WallCells], rooflines: Sequence[Roofline]
) -> list[Float64[np.ndarray, "s z"]]:
    """Return the weight in [0, 1] of observed surface at each cell as evidence for its column.

    The weight is the mean over the views of the log-likelihood ratio of surface at the cell, given
    the probability that the ray meets another building of the row behind it. It is relative to a
    ray without such a building, and 1 without a view. Walls of other rows are excluded: two walls,
    one behind the other, would explain each other's views, and the front wall could vanish.
    """
    prisms = [_Prisms.of(roofline) for roofline in rooflines]
    found = []
    for wall_cells, roofline in zip(cells, rooflines, strict=True):
        row = [
            prism
            for prism, other in zip(prisms, rooflines, strict=True)
            if other is roofline or _is_of_row(roofline, other)
        ]
        points = wall_cells.centres().reshape(-1, 3)
        total = np.zeros(len(points))
        for sighting in wall_cells.sightings:
            rays, met = (sighting.eye_m, points[sighting.rows]), np.zeros(len(sighting.rows))
            for prism in row:
                sizes = (_PLAN_M, prism.cell_m)
                house = (prism.plan.column, prism.filled, prism.low_m, sizes)
                raise_to_filled(*rays, *house, _BEHIND_M, met)
            by_others = _UNMODELLED_SURFACE + (1.0 - _UNMODELLED_SURFACE) * met
            total[sighting.rows] += np.log(by_others) / np.log(_UNMODELLED_SURFACE)
        shape = wall_cells.surface_views.shape
        weight = np.where(
            wall_cells.surface_views > 0,
            total.reshape(shape) / np.maximum(wall_cells.surface_views, 1),
            1.0,
        )
        found.append(weight)
    return found


def raised_to_neighbours(rooflines: Sequence[Roofline]) -> list[Roofline]:
    """Raise walls to the highest house directly behind them.

    Two walls of one house may have different evidence of its height. Gaps between houses have no
    wall, so nothing is raised there.
    """
    houses = [(PrismPlan.of(r, r.depth_m), r.top_m) for r in rooflines]
    raised = []
    for roofline in rooflines:
        places = _behind(roofline, np.array(_SEARCH_BEHIND_M))
        highest = roofline.top_m
        for plan, top_m in houses:
            column = plan.at(places)
            behind_m = np.where(column >= 0, top_m[column], -np.inf).max(axis=1)
            highest = np.maximum(highest, behind_m)
        above = np.round((highest - roofline.top_m) / roofline.cell_m).astype(np.int64)
        above[roofline.top == 0] = 0
        limit = roofline.energy.shape[1] - 1
        raised.append(replace(roofline, top=np.minimum(roofline.top + above, limit)))
    return raised
