"""Reconstructed fields: sparse signed-distance grids and the height of the ground."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Shaped

from lightsim.errors import ArtefactError

BLOCK = 8
"""Samples along each edge of a block."""
# Layout of `SceneFields.to_arrays`; raised when an array changes its meaning.
_VERSION = 1


@dataclass(frozen=True, eq=False)
class TsdfGrid:
    """Truncated signed distances in blocks of 8x8x8 samples; absent blocks are unknown.

    Sample (i, j, k) of block b lies at `origin_m + voxel_m * (8 * block_coords[b] + (i, j, k))`.

    Args:
        frame: "world" or "actor".
        origin_m: position of sample 0 of block (0, 0, 0).
        voxel_m: distance between samples.
        truncation_m: distances are clipped to this.
        block_coords: integer position of each block, in lexicographic order.
        sdf_m: positive outside.
        weight: confidence of each sample; 0 = never observed.
    """

    frame: str
    origin_m: Float[np.ndarray, "3"]
    voxel_m: float
    truncation_m: float
    block_coords: Int32[np.ndarray, "b 3"]
    sdf_m: Float32[np.ndarray, "b 8 8 8"]
    weight: Float32[np.ndarray, "b 8 8 8"]

    def positions(self, block: int) -> Float[np.ndarray, "8 8 8 3"]:
        """Return the positions of the samples of one block, in metres."""
        steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
        return self.origin_m + self.voxel_m * (BLOCK * self.block_coords[block] + steps)


@dataclass(frozen=True, eq=False)
class GroundMap:
    """Height of the ground on a regular grid in frame `world`.

    Args:
        origin_m: (x, y) of the centre of cell (0, 0).
        cell_m: distance between cell centres.
        height_m: z of each cell, [x, y]; cells without returns are interpolated.
        is_observed: whether returns of the ground fell into the cell.
    """

    origin_m: Float[np.ndarray, "2"]
    cell_m: float
    height_m: Float32[np.ndarray, "nx ny"]
    is_observed: Bool[np.ndarray, "nx ny"]

    def look_up(self, xy_world: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the bilinear height at points; outside of the map, that of the nearest border."""
        nx, ny = self.height_m.shape
        grid = (xy_world - self.origin_m) / self.cell_m
        # Clipped before the conversion: a float far beyond the map overflows an integer.
        i = np.clip(np.floor(grid[:, 0]), 0, max(nx - 2, 0)).astype(np.int64)
        j = np.clip(np.floor(grid[:, 1]), 0, max(ny - 2, 0)).astype(np.int64)
        u, v = np.clip(grid[:, 0] - i, 0, 1), np.clip(grid[:, 1] - j, 0, 1)
        i1, j1 = np.minimum(i + 1, nx - 1), np.minimum(j + 1, ny - 1)
        height = self.height_m
        low = (1 - v) * height[i, j] + v * height[i, j1]
        high = (1 - v) * height[i1, j] + v * height[i1, j1]
        return (1 - u) * low + u * high

    def observes(self, xy_world: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Return whether the cell of each point has ground returns; False outside the map."""
        # Cells are centred on grid points, so that the nearest point is the cell.
        nearest = np.rint((xy_world - self.origin_m) / self.cell_m)
        is_in = np.all((nearest >= 0) & (nearest < self.height_m.shape), axis=1)
        cell = np.where(is_in[:, None], nearest, 0.0).astype(np.int64)
        return is_in & self.is_observed[cell[:, 0], cell[:, 1]]


@dataclass(frozen=True, eq=False)
class SceneFields:
    """Geometry of one log before meshing.

    Args:
        background: static scene in frame `world`, finest level first.
        background_radius_m: horizontal distance from the path up to which each level is valid.
        actors: one grid in frame `actor` by actor id; actors with too few returns are absent.
        ground: height of the ground.
        path_m: positions of the ego vehicle, frame `world`, from which the radii are measured.
        notes: what was substituted or left out.
    """

    background: tuple[TsdfGrid, ...]
    background_radius_m: tuple[float, ...]
    actors: Mapping[str, TsdfGrid]
    ground: GroundMap
    path_m: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...] = ()

    def to_arrays(self) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Return plain arrays for an .npz file; `from_arrays` is the exact inverse."""
        meta = {
            "version": _VERSION,
            "radius_m": list(self.background_radius_m),
            "actors": list(self.actors),
            "notes": list(self.notes),
        }
        arrays: dict[str, Shaped[np.ndarray, "..."]] = {
            # Text as bytes: an array of objects would require pickle on reading.
            "meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8),
            "path_m": self.path_m,
            "ground/origin_m": self.ground.origin_m,
            "ground/cell_m": np.array(self.ground.cell_m),
            "ground/height_m": self.ground.height_m,
            "ground/is_observed": self.ground.is_observed,
        }
        for i, grid in enumerate(self.background):
            arrays |= _grid_arrays(f"background/{i}", grid)
        # Numbers instead of ids, which may contain characters that no file name may have.
        for i, grid in enumerate(self.actors.values()):
            arrays |= _grid_arrays(f"actor/{i}", grid)
        return arrays

    @staticmethod
    def from_arrays(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> SceneFields:
        """Inverse of `to_arrays`.

        Raises:
            ArtefactError: an array is missing, or the version is another.
        """
        try:
            meta = json.loads(arrays["meta"].tobytes().decode())
            if meta["version"] != _VERSION:
                raise ArtefactError("other version", got=meta["version"], expected=_VERSION)
            ground = GroundMap(
                arrays["ground/origin_m"],
                float(arrays["ground/cell_m"]),
                arrays["ground/height_m"],
                arrays["ground/is_observed"],
            )
            radii = tuple(float(r) for r in meta["radius_m"])
            levels = tuple(_grid(f"background/{i}", "world", arrays) for i in range(len(radii)))
            actors = {
                str(a): _grid(f"actor/{i}", "actor", arrays) for i, a in enumerate(meta["actors"])
            }
            path = arrays["path_m"]
        except (KeyError, ValueError) as error:
            raise ArtefactError(
                "the reconstructed fields are incomplete",
                where=str(error),
                remedy="Delete the artefact and run the build again.",
            ) from error
        return SceneFields(levels, radii, actors, ground, path, tuple(meta["notes"]))


def _grid_arrays(prefix: str, grid: TsdfGrid) -> dict[str, Shaped[np.ndarray, "..."]]:
    return {
        f"{prefix}/geometry": np.array([*grid.origin_m, grid.voxel_m, grid.truncation_m]),
        f"{prefix}/block_coords": grid.block_coords,
        f"{prefix}/sdf_m": grid.sdf_m,
        f"{prefix}/weight": grid.weight,
    }


def _grid(prefix: str, frame: str, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> TsdfGrid:
    geometry = arrays[f"{prefix}/geometry"]
    return TsdfGrid(
        frame,
        geometry[:3],
        float(geometry[3]),
        float(geometry[4]),
        arrays[f"{prefix}/block_coords"],
        arrays[f"{prefix}/sdf_m"],
        arrays[f"{prefix}/weight"],
    )
