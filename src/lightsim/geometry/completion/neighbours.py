"""What houses say about each other: which stands behind, and which explains what views show.

Houses of a row share one plane. Above a low one the views see the side of its tall neighbour:
matter, but not of the low house's wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int16

from lightsim.core.buildings import Roofline
from lightsim.geometry.completion.prism_kernels import most_filled
from lightsim.geometry.completion.wall_cells import WallCells

HOUSE_DEPTH_M = 12.0
"""Houses are this deep unless free space tells otherwise."""
INSET_M = 0.35
"""Their depth counts from this far behind the wall."""
_PLAN_M = 0.5
# Behind a point of a wall's plane a ray is in its own house first, and leaves a street's houses.
_BEHIND_M = (2.0, 60.0)
# Views show matter where no house stands, too: trees, masts, faults of the mattes.
_UNKNOWN_MATTER = 0.1
# Where a house that stands behind a wall is looked for.
_STANDS_BEHIND_M = (0.75, 1.5)


@dataclass(frozen=True, eq=False)
class PrismPlan:
    """Where the prisms behind walls stand.

    Args:
        low_m: lowest corner, frame world.
        column: of each wall, the column whose prism stands on a cell; -1 for none.
    """

    low_m: Float64[np.ndarray, "2"]
    column: Int16[np.ndarray, "wall x y"]

    @classmethod
    def of(cls, rooflines: Sequence[Roofline]) -> PrismPlan:
        """All prisms as deep as houses are."""
        inward = np.arange(INSET_M, INSET_M + HOUSE_DEPTH_M, _PLAN_M / 2)
        places = [_behind(roofline, inward) for roofline in rooflines]
        corners = np.concatenate([place.reshape(-1, 2) for place in places])
        low = corners.min(axis=0)
        shape = np.floor((corners.max(axis=0) - low) / _PLAN_M).astype(np.int64) + 1
        column = np.full((len(places), *shape), -1, dtype=np.int16)
        for k, place in enumerate(places):
            i, j = np.floor((place - low) / _PLAN_M).astype(np.int64).transpose(2, 0, 1)
            column[k, i, j] = np.arange(len(place))[:, None]
        return cls(low, column)

    def at(self, places: Float64[np.ndarray, "*n 2"]) -> Int16[np.ndarray, "wall *n"]:
        """Columns that stand at places inside the plan."""
        cells = np.floor((places - self.low_m) / _PLAN_M).astype(np.int64)
        return self.column[:, cells[..., 0], cells[..., 1]]


def _behind(
    roofline: Roofline, inward_m: Float64[np.ndarray, " d"]
) -> Float64[np.ndarray, "s d 2"]:
    """Places this far behind each column's foot."""
    foot = roofline.wall.at(roofline.s_m, np.zeros_like(roofline.s_m))
    return foot[:, None, :2] - inward_m[:, None] * roofline.wall.normal[:2]


def unexplained(
    cells: Sequence[WallCells], rooflines: Sequence[Roofline]
) -> list[Float64[np.ndarray, "s z"]]:
    """Of what views show as matter at each cell, how much speaks for the cell's own column.

    The likelihood ratio of a wall against none there, given how probably each ray meets what stands
    behind other columns of the wall further on, over that of a ray that meets none; mean over the
    views, and one without a view. Other walls do not count: of two in a row, each would explain
    what the views show of the other, and the front one could vanish.
    """
    plan = PrismPlan.of(rooflines)
    corner = np.append(plan.low_m, 0.0)
    found = []
    for wall_cells, roofline, column in zip(cells, rooflines, plan.column, strict=True):
        points = wall_cells.centres().reshape(-1, 3) - corner
        prism = (column, roofline.filled(), roofline.wall.height_m[0])
        sizes = (_PLAN_M, wall_cells.cell_m)
        total = np.zeros(len(points))
        for sight in wall_cells.sights:
            met = np.zeros(len(sight.rows))
            eye = sight.eye_m - corner
            most_filled(eye, points[sight.rows], *prism, sizes, _BEHIND_M, met)
            by_others = _UNKNOWN_MATTER + (1.0 - _UNKNOWN_MATTER) * met
            total[sight.rows] += np.log(by_others) / np.log(_UNKNOWN_MATTER)
        shape = wall_cells.matter.shape
        share = np.where(
            wall_cells.matter > 0, total.reshape(shape) / np.maximum(wall_cells.matter, 1), 1.0
        )
        found.append(share)
    return found


def raised_to_neighbours(rooflines: Sequence[Roofline]) -> list[Roofline]:
    """Walls as high as the highest house that stands right behind them: two walls of one house may
    know its height unequally well."""
    plan = PrismPlan.of(rooflines)
    tops = np.full((len(rooflines), max(len(r.top) for r in rooflines) + 1), -np.inf)
    for k, roofline in enumerate(rooflines):
        tops[k, : len(roofline.top)] = np.where(roofline.depth_m > 0, roofline.top_m, -np.inf)
    raised = []
    for roofline in rooflines:
        column = plan.at(_behind(roofline, np.array(_STANDS_BEHIND_M)))
        # Column -1 is the last one, which has no height.
        behind_m = tops[np.arange(len(rooflines))[:, None, None], column].max(axis=(0, 2))
        above = (np.maximum(behind_m, roofline.top_m) - roofline.top_m) / roofline.cell_m
        limit = roofline.energy.shape[1] - 1
        top = np.minimum(roofline.top + np.round(above).astype(np.int64), limit)
        raised.append(replace(roofline, top=top))
    return raised
