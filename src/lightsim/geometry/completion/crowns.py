"""Crowns of trees and bushes: volumes in which some beams end and others pass.

A signed distance grid turns leaves into fragments. Beams measure the extinction of a crown instead:
returns for each metre of free path, voxel by voxel. Leaves are then drawn as cards of that density
(`leaf_cards`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy import ndimage
from scipy.spatial import KDTree

from lightsim.core.buildings import Wall
from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.free_space_kernels import walk_beams
from lightsim.geometry.surface import path_distance_m

# The values below were chosen on street 0; only their joint effect was measured.


class _Foliage:
    """Voxels of foliage, and limits of a crown."""

    voxel_m = 0.4  # Edge of a voxel: 30 m away, a tree has some returns in each.
    reach_m = 60.0  # Greatest distance from the path; beams are too sparse beyond.
    heights_m = (0.8, 25.0)  # Least and greatest height above the ground.
    min_scattered = 0.5  # Least fraction of scattered returns in a voxel and its neighbours.
    min_passed = 0.25  # Least fraction of beams that pass; closed surfaces stop nearly all.
    min_returns = 20  # Least number of returns of a crown.
    min_extent_m = 1.2  # Least extent of a crown along each axis.
    wall_m = 0.5  # Distance from a wall within which returns lie on its ledges.
    # Free path of equivalent observations at the crown's mean extinction, the prior of a voxel.
    prior_path_m = 2.0


class _Scattered:
    """Test of whether the neighbours of a return fill a volume."""

    neighbours = 24  # Number of nearest returns that are used.
    reach_m = 0.7  # Greatest distance of these returns.
    least = 8  # Least number of returns within that distance.
    min_std_m = 0.05  # Least standard deviation about their plane: twice the noise of a return.
    min_fraction = 0.04  # Least variance about it as a fraction of the total variance.
    chunk = 1 << 16  # Returns tested at once, to limit memory.


@dataclass(frozen=True, eq=False)
class Crowns:
    """Voxels of foliage, frame world.

    Args:
        low_m: lowest corner of voxel (0, 0, 0).
        voxel_m: edge of a voxel.
        cells: index of each voxel along the axes, unique.
        crown: number of the crown that each voxel belongs to, from 0.
        extinction: extinction of beams by leaves, in 1 / m.
        returns_m: LiDAR returns within the voxels, grouped by voxel.
        first_return: row of each voxel's first return; the last entry is the number of returns.
        path_m: positions of the recording vehicle, from which crowns were observed.
    """

    low_m: Float64[np.ndarray, "3"]
    voxel_m: float
    cells: Int64[np.ndarray, "n 3"]
    crown: Int64[np.ndarray, " n"]
    extinction: Float64[np.ndarray, " n"]
    returns_m: Float64[np.ndarray, "r 3"]
    first_return: Int64[np.ndarray, " n_plus_1"]
    path_m: Float64[np.ndarray, "k 3"]

    @staticmethod
    def none(path_m: Float64[np.ndarray, "k 3"]) -> Crowns:
        """Return the crowns of a street without trees."""
        whole, nothing = np.zeros(0, np.int64), np.zeros((0, 3))
        voxels = whole.reshape(0, 3), whole, nothing[:, 0]
        return Crowns(
            np.zeros(3), _Foliage.voxel_m, *voxels, nothing, np.zeros(1, np.int64), path_m
        )

    def __len__(self) -> int:
        """Number of crowns."""
        return int(self.crown.max(initial=-1)) + 1

    @property
    def middle_m(self) -> Float64[np.ndarray, "n 3"]:
        """Centres of the voxels, frame world."""
        return self.low_m + (self.cells + 0.5) * self.voxel_m

    @property
    def median_extinction(self) -> Float64[np.ndarray, " k"]:
        """Median extinction of each crown's voxels, in 1 / m."""
        own = (self.extinction[self.crown == k] for k in range(len(self)))
        return np.array([np.median(values) for values in own], np.float64)

    def nearest_path_points(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Return the path position nearest to each point."""
        return self.path_m[KDTree(self.path_m[:, :2]).query(points[:, :2])[1]]

    def select(self, is_kept: Bool[np.ndarray, " k"]) -> Crowns:
        """Return the selected crowns."""
        is_own = is_kept[self.crown]
        count = np.diff(self.first_return)
        return replace(
            self,
            cells=self.cells[is_own],
            crown=(np.cumsum(is_kept) - 1)[self.crown[is_own]],
            extinction=self.extinction[is_own],
            returns_m=self.returns_m[np.repeat(is_own, count)],
            first_return=np.r_[0, np.cumsum(count[is_own])],
        )

    def contain(self, points: Float64[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
        """Return whether each point lies in a voxel or in a neighbour of one."""
        if not len(self.cells):
            return np.zeros(len(points), dtype=bool)
        low = self.cells.min(axis=0) - 1
        shape = self.cells.max(axis=0) - low + 2
        is_in = np.zeros(tuple(shape.tolist()), dtype=bool)
        is_in[tuple((self.cells - low).T)] = True
        is_in = ndimage.binary_dilation(is_in, np.ones((3, 3, 3)))
        cell = np.floor((points - self.low_m) / self.voxel_m).astype(np.int64) - low
        is_near = ((cell >= 0) & (cell < shape)).all(axis=1)
        found = np.zeros(len(points), dtype=bool)
        found[is_near] = is_in[tuple(cell[is_near].T)]
        return found


@dataclass(frozen=True, eq=False)
class Beams:
    """LiDAR beams as straight segments, frame world, metres.

    Args:
        origins: positions of the sensor.
        ends: positions of the returns.
    """

    origins: Float32[np.ndarray, "b 3"]
    ends: Float32[np.ndarray, "b 3"]

    def select(self, rows: Bool[np.ndarray, " b"] | Int64[np.ndarray, " n"]) -> Beams:
        """Return the selected beams."""
        return Beams(self.origins[rows], self.ends[rows])


def find_crowns(
    beams: Beams,
    walls: Sequence[Wall],
    ground: GroundMap,
    path_m: Float64[np.ndarray, "k 3"],
) -> Crowns:
    """Find volumes in which beams both end and pass, and estimate their extinction.

    Extinction is the number of returns divided by the free path of all beams within a voxel, the
    maximum likelihood estimate under Beer and Lambert's law (Pimont et al. 2019,
    doi:10.3390/rs11131580).

    Args:
        beams: beams that ended on static surfaces.
        walls: upright planes of the measured background, on which no crown is searched.
        ground: reference of heights.
        path_m: positions of the recording vehicle.
    """
    is_used = _may_be_leaves(beams.ends, walls, ground, path_m)
    points = beams.ends[is_used].astype(np.float64)
    low = points.min(axis=0, initial=np.inf) - 2 * _Foliage.voxel_m
    if len(points) < _Foliage.min_returns:
        return Crowns.none(path_m)
    shape = np.ceil((points.max(axis=0) - low) / _Foliage.voxel_m).astype(np.int64) + 2
    cell = np.floor((points - low) / _Foliage.voxel_m).astype(np.int64)
    is_scattered = _is_scattered(points, beams.ends)
    count, scattered = (np.zeros(tuple(shape.tolist()), np.float32) for _ in range(2))
    np.add.at(count, tuple(cell.T), 1)
    np.add.at(scattered, tuple(cell.T), is_scattered)
    stops, entries, way = count_beams(beams, low, _Foliage.voxel_m, count.shape)
    passed = 1 - _around(stops) / np.maximum(_around(entries), 1)
    is_crown = (count > 0) & (_around(scattered) > _Foliage.min_scattered * _around(stops))
    is_crown &= passed > _Foliage.min_passed
    label = _pieces(is_crown, cell)
    return _measured(label, (stops, way * _Foliage.voxel_m), (low, cell), points, path_m)


def count_beams(
    beams: Beams, low_m: Float64[np.ndarray, "3"], voxel_m: float, shape: tuple[int, ...]
) -> tuple[Int32[np.ndarray, "x y z"], Int32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Count the beams that end in each voxel and that enter it, and sum their length in voxels."""
    stops, entries = (np.zeros(shape, np.int32) for _ in range(2))
    way = np.zeros(shape, np.float32)
    origins, ends = ((p.astype(np.float64) - low_m) / voxel_m for p in (beams.origins, beams.ends))
    walk_beams(origins, ends, stops, entries, way)
    return stops, entries, way


def _may_be_leaves(
    points: Float32[np.ndarray, "n 3"],
    walls: Sequence[Wall],
    ground: GroundMap,
    path_m: Float64[np.ndarray, "k 3"],
) -> Bool[np.ndarray, " n"]:
    """Return whether returns are near the path, above the ground and away from walls."""
    height = points[:, 2] - ground.look_up(points[:, :2].astype(np.float64))
    is_used = (height > _Foliage.heights_m[0]) & (height < _Foliage.heights_m[1])
    is_used &= path_distance_m(points, path_m) < _Foliage.reach_m
    for wall in walls:
        rows = np.flatnonzero(is_used)
        s, out = wall.place(points[rows].astype(np.float64))
        is_on = (np.abs(out) < _Foliage.wall_m) & (s > wall.span_m[0] - _Foliage.wall_m)
        is_on &= (s < wall.span_m[1] + _Foliage.wall_m) & (
            points[rows, 2] < wall.height_m[1] + _Foliage.wall_m
        )
        is_used[rows[is_on]] = False
    return is_used


def _is_scattered(
    points: Float64[np.ndarray, "n 3"], returns: Float32[np.ndarray, "r 3"]
) -> Bool[np.ndarray, " n"]:
    """Return whether the neighbours of each point fill a volume, not a surface or a line."""
    tree = KDTree(returns)
    found = np.zeros(len(points), dtype=bool)
    for start in range(0, len(points), _Scattered.chunk):
        part = slice(start, start + _Scattered.chunk)
        distance, index = tree.query(
            points[part], _Scattered.neighbours, distance_upper_bound=_Scattered.reach_m
        )
        is_near = np.isfinite(distance)
        near = returns[np.where(is_near, index, 0)].astype(np.float64)
        weight = is_near / np.maximum(is_near.sum(axis=1, keepdims=True), 1)
        offset = near - (weight[..., None] * near).sum(axis=1, keepdims=True)
        variance = np.linalg.eigvalsh(np.einsum("nk,nki,nkj->nij", weight, offset, offset))
        thin = np.maximum(variance[:, 0], 0.0)
        is_volume = (np.sqrt(thin) > _Scattered.min_std_m) & (
            thin > _Scattered.min_fraction * variance.sum(axis=1)
        )
        found[part] = is_volume & (is_near.sum(axis=1) >= _Scattered.least)
    return found


def _around(values: np.ndarray) -> Float32[np.ndarray, "x y z"]:
    """Return the sum over each voxel and its 26 neighbours."""
    return 27 * ndimage.uniform_filter(values.astype(np.float32), 3, mode="constant")


def _pieces(
    is_crown: Bool[np.ndarray, "x y z"], cell: Int64[np.ndarray, "n 3"]
) -> Int64[np.ndarray, "x y z"]:
    """Label connected pieces of crown voxels from 1; 0 for other voxels and for small pieces.

    Args:
        is_crown: candidate voxels.
        cell: voxel of each return.
    """
    label = np.zeros(is_crown.shape, dtype=np.int64)
    number = int(np.asarray(ndimage.label(is_crown, np.ones((3, 3, 3)), output=label)))
    count = np.bincount(label[tuple(cell.T)], minlength=number + 1)
    boxes = ndimage.find_objects(label)
    is_large = np.array(
        [
            min(s.stop - s.start for s in box) * _Foliage.voxel_m > _Foliage.min_extent_m - 1e-6
            for box in boxes
        ],
        dtype=bool,
    )
    is_kept = np.r_[False, is_large & (count[1:] >= _Foliage.min_returns)]
    return np.where(is_kept, np.cumsum(is_kept), 0)[label]


def _measured(
    label: Int64[np.ndarray, "x y z"],
    counts: tuple[np.ndarray, np.ndarray],
    grid: tuple[Float64[np.ndarray, "3"], Int64[np.ndarray, "n 3"]],
    points: Float64[np.ndarray, "n 3"],
    path_m: Float64[np.ndarray, "k 3"],
) -> Crowns:
    """Estimate extinction of each voxel, with the crown's mean as prior.

    Args:
        label: number of the crown of each voxel, from 1.
        counts: returns of each voxel, and free path in metres.
        grid: lowest corner, and the voxel of each point.
        points: returns, frame world.
        path_m: positions of the recording vehicle.
    """
    low, cell = grid
    stops, way = (a[label > 0].astype(np.float64) for a in counts)
    crown = label[label > 0] - 1
    usual = np.bincount(crown, stops) / np.maximum(np.bincount(crown, way), 1e-6)
    extinction = (stops + _Foliage.prior_path_m * usual[crown]) / (way + _Foliage.prior_path_m)
    number = np.full(label.shape, -1, np.int64)
    number[label > 0] = np.arange(len(crown))
    own = number[tuple(cell.T)]
    order = np.argsort(own, kind="stable")
    order = order[own[order] >= 0]
    first = np.searchsorted(own[order], np.arange(len(crown) + 1))
    voxels = np.argwhere(label > 0), crown, extinction
    return Crowns(low, _Foliage.voxel_m, *voxels, points[order], first, path_m)
