"""Prior of the neural field: a stack of the grids of the fused LiDAR, with look-up of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int32

from lightsim.core.fields import SceneFields, TsdfGrid
from lightsim.reconstruct.field import prior_kernels as kernels

GridRange = tuple[int, int]


@dataclass(frozen=True, eq=False)
class TsdfPrior:
    """Signed-distance grids in one stack: the background's levels first, then one per actor.

    Args:
        grids: in that order.
        background_levels: number of the background's grids.
        actor_ids: actors of the other grids.
    """

    grids: tuple[TsdfGrid, ...]
    background_levels: int
    actor_ids: tuple[str, ...]

    @staticmethod
    def of(fields: SceneFields) -> TsdfPrior:
        """Stack the grids of fused fields, actors in the order of their mapping."""
        grids = (*fields.background, *fields.actors.values())
        return TsdfPrior(grids, len(fields.background), tuple(fields.actors))

    @property
    def background(self) -> GridRange:
        """Return the range of the background's grids."""
        return 0, self.background_levels

    def actor(self, actor_id: str) -> GridRange:
        """Return the range of one actor's grid; empty if the actor has none."""
        if actor_id not in self.actor_ids:
            return 0, 0
        first = self.background_levels + self.actor_ids.index(actor_id)
        return first, first + 1

    @cached_property
    def stack(self) -> tuple[np.ndarray, ...]:
        """Return the stack as arrays for the kernels.

        They are: block tables, their starts, lowest blocks and shapes; origin, sample distance and
        truncation of each grid; signed distances and weights of all blocks.
        """
        tables, starts, lows, shapes, first, count = [], [], [], [], 0, 0
        for grid in self.grids:
            low = grid.block_coords.min(axis=0) if len(grid.block_coords) else np.zeros(3, np.int32)
            local = grid.block_coords - low
            shape = local.max(axis=0) + 1 if len(local) else np.zeros(3, np.int32)
            table = np.full(tuple(shape.tolist()), -1, dtype=np.int32)
            table[tuple(local.T)] = count + np.arange(len(local), dtype=np.int32)
            tables.append(table.ravel())
            starts.append(first)
            lows.append(low)
            shapes.append(shape)
            first += table.size
            count += len(local)
        geometry = [[*g.origin_m.tolist(), g.voxel_m, g.truncation_m] for g in self.grids]
        return (
            np.concatenate([np.zeros(0, np.int32), *tables]),
            np.array(starts, dtype=np.int64),
            np.array(lows, dtype=np.int64).reshape(-1, 3),
            np.array(shapes, dtype=np.int64).reshape(-1, 3),
            np.array(geometry, dtype=np.float64).reshape(-1, 5),
            _joined([grid.sdf_m for grid in self.grids]),
            _joined([grid.weight for grid in self.grids]),
        )

    def look_up(
        self, points: Float[np.ndarray, "n 3"], ranges: Int32[np.ndarray, "n 2"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Return signed distance [m], weight (0 = unknown) and truncation [m] of points.

        A point is in the frame of its grids, ranges[:, 0] up to but excluding ranges[:, 1].
        """
        found = np.zeros((len(points), 3), dtype=np.float32)
        kernels.look_up(self.stack, points, ranges[:, 0], ranges[:, 1], found)
        return found


def _joined(parts: Sequence[Float32[np.ndarray, "_ 8 8 8"]]) -> Float32[np.ndarray, "b 512"]:
    empty = np.zeros((0, 512), dtype=np.float32)
    return np.concatenate([empty, *[part.reshape(-1, 512) for part in parts]])
