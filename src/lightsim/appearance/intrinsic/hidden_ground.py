"""Base colour of ground that nobody saw, such as under parked cars and behind them.

A street goes on as it is: lanes, kerbs and pavements run along the path. A hole takes over what
lies further along, by the shifts for which its surroundings agree best (shift maps, Pritch et al.
2009, doi:10.1109/ICCV.2009.5459159; few shifts explain a picture, He and Sun 2012,
doi:10.1007/978-3-642-33709-3_2), at the level of those surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    distance_transform_edt,
    find_objects,
    gaussian_filter,
    generate_binary_structure,
    label,
)
from scipy.spatial import KDTree

from lightsim.appearance.atlas import texel_parts
from lightsim.appearance.config import HIDDEN_GROUND_REACH_M, LEVEL_NORMAL
from lightsim.appearance.intrinsic.divide import HIGHEST_BASE_COLOUR, LOWEST_BASE_COLOUR
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Texture, TriMesh

# Chosen while looking at street 1; what they do together: docs/benchmarks/leaderboard.md (edits).

# The path is smoothed over this length, and goes straight on at its ends.
_SMOOTH_M, _ONWARD_M, _STEP_M = 4.0, 60.0, 0.1
# Ground lies this near its level.
_LEVEL_M = 0.3
# Of the map; and how far a texel speaks for places without any.
_CELL_M, _SPREAD_M = 0.05, 0.3
# Places are known from the first trust on, and hidden below the second.
_KNOWN, _HIDDEN = 0.99, 0.5
# Least and greatest shift along the road, and their step in cells.
_SHIFT_M, _SHIFT_STEP = (1.0, 40.0), 2
# Width of a hole's surroundings; what must be known of them both here and there, cells of them that
# are looked at, and the most that one may differ in log colour.
_RING_M, _LEAST_RING, _RING_CELLS, _RING_LIMIT = 0.6, 0.25, 3000, 0.4
# In log colour: for surroundings that are not known there, and for each metre.
_UNKNOWN_COST, _COST_PER_M = 0.1, 0.001
# Shifts that are tried, and the least that one must add, as a fraction of the hole.
_TRIED, _LEAST_GAIN = 40, 0.03
# Smaller holes stay as they were filled.
_LEAST_HOLE_M2 = 0.1
# Levels differ by no more (log), and follow the surroundings this far.
_LEVEL_LIMIT, _LEVEL_REACH_M, _LEVEL_FADE = 0.5, 0.5, 0.03


@dataclass(frozen=True, eq=False)
class Road:
    """Where a recording drove.

    Args:
        path_m: its positions, in order, frame world.
        ground: height of the ground.
    """

    path_m: Float64[np.ndarray, "k 3"]
    ground: GroundMap

    @cached_property
    def _line(self) -> tuple[KDTree, Float64[np.ndarray, "n 2"]]:
        """Points of the smoothed path, evenly spaced, and its direction there."""
        kept = [self.path_m[0, :2].astype(np.float64)]
        for point in self.path_m[1:, :2]:
            if np.linalg.norm(point - kept[-1]) > _SMOOTH_M / 2:
                kept.append(point.astype(np.float64))
        if len(kept) == 1:
            kept.append(kept[0] + [_SMOOTH_M, 0.0])
        ends = [
            a + _ONWARD_M * (a - b) / np.linalg.norm(a - b) for a, b in (kept[:2], kept[:-3:-1])
        ]
        corners = np.array([ends[0], *kept, ends[1]])
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
        at = np.arange(0.0, length[-1], _STEP_M)
        points = np.stack([np.interp(at, length, corners[:, k]) for k in (0, 1)], axis=1)
        half = round(_SMOOTH_M / _STEP_M)
        window = np.hanning(2 * half + 1)
        padded = np.pad(points, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
        smooth = [np.convolve(padded[:, k], window / window.sum(), "valid") for k in (0, 1)]
        points = np.stack(smooth, axis=1)
        way = np.gradient(points, axis=0)
        return KDTree(points), way / np.linalg.norm(way, axis=1, keepdims=True)

    def place(self, xy: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Metres along the road and to the left of it."""
        tree, way = self._line
        nearest = np.asarray(tree.query(xy)[1])
        offset, way = xy - tree.data[nearest], way[nearest]
        along = _STEP_M * nearest + (offset * way).sum(axis=1)
        return np.stack([along, offset[:, 1] * way[:, 0] - offset[:, 0] * way[:, 1]], axis=1)

    def is_ground(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether points lie at the ground's height."""
        return np.abs(points[:, 2] - self.ground.look_up(points[:, :2])) < _LEVEL_M


def with_hidden_ground(mesh: TriMesh, trust: Float64[np.ndarray, " n"], road: Road) -> TriMesh:
    """The mesh with the base colour of its ground completed, at vertices and texels; as it is
    where the road tells nothing, or without a texture.

    Args:
        mesh: frame world; its texture was packed by `appearance.atlas`.
        trust: in the vertices' colours, 0 where nobody saw them.
        road: along which the street goes on.
    """
    texture = mesh.texture
    if texture is None:
        return mesh
    is_level = mesh.vertex_normals()[:, 2] > LEVEL_NORMAL
    texels = _GroundTexels.of(mesh, texture, (is_level, trust), road)
    if not texels.is_hidden.any() or not texels.is_known.any():
        return mesh
    completed = _RoadMap.of(texels).completed()
    image = texture.image.reshape(-1, 3).copy()
    hidden = texels.is_hidden
    colour, is_told = completed.at(texels.places[hidden])
    image[texels.pixel[hidden][is_told]] = colour[is_told]
    vertex = np.flatnonzero(is_level & (trust < _HIDDEN))
    vertex = vertex[road.is_ground(mesh.vertices[vertex])]
    colour, is_told = completed.at(road.place(mesh.vertices[vertex, :2]))
    base_colour = mesh.base_colour.copy()
    base_colour[vertex[is_told]] = colour[is_told]
    completed_texture = replace(texture, image=image.reshape(texture.image.shape))
    return replace(mesh, base_colour=base_colour, texture=completed_texture)


@dataclass(frozen=True, eq=False)
class _GroundTexels:
    """Texels of the ground beside the path.

    Args:
        pixel: of the texture.
        places: along the road and across it, metres.
        colours: linear RGB.
    """

    pixel: Int64[np.ndarray, " t"]
    places: Float64[np.ndarray, "t 2"]
    colours: Float32[np.ndarray, "t 3"]
    is_known: Bool[np.ndarray, " t"]
    is_hidden: Bool[np.ndarray, " t"]

    @classmethod
    def of(
        cls,
        mesh: TriMesh,
        texture: Texture,
        known: tuple[Bool[np.ndarray, " n"], Float64[np.ndarray, " n"]],
        road: Road,
    ) -> _GroundTexels:
        """Args: `known`: of the vertices, whether they face up, and how far they are trusted."""
        image, (faces_up, trust) = texture.image.reshape(-1, 3), known
        is_level = faces_up[mesh.faces].min(axis=1)
        found = []
        for texels in texel_parts(texture, 1 << 18):
            rows = np.flatnonzero(is_level[texels.face])
            corners, weight = mesh.faces[texels.face[rows]], texels.barycentric[rows]
            points = (weight[:, :, None] * mesh.vertices[corners]).sum(axis=1)
            places = road.place(points[:, :2])
            is_used = (np.abs(places[:, 1]) < HIDDEN_GROUND_REACH_M) & road.is_ground(points)
            trusted = (weight * trust[corners]).sum(axis=1)
            found.append((texels.pixel[rows], places, trusted, is_used))
        pixel, places, trusted, is_used = (
            np.concatenate(part) for part in zip(*found, strict=True)
        )
        pixel, places, trusted = pixel[is_used], places[is_used], trusted[is_used]
        return cls(pixel, places, image[pixel], trusted >= _KNOWN, trusted < _HIDDEN)


@dataclass(frozen=True, eq=False)
class _RoadMap:
    """The ground seen from above, its rows along the road.

    Args:
        low_m: its corner, along and across.
        colour: log of linear RGB.
    """

    low_m: Float64[np.ndarray, "2"]
    colour: Float32[np.ndarray, "t s 3"]
    is_known: Bool[np.ndarray, "t s"]
    is_hidden: Bool[np.ndarray, "t s"]

    @classmethod
    def of(cls, texels: _GroundTexels) -> _RoadMap:
        low = texels.places.min(axis=0)
        column, row = np.floor((texels.places - low) / _CELL_M).astype(np.int64).T
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        cell, size = row * shape[1] + column, shape[0] * shape[1]
        known, hidden = (
            np.bincount(cell[chosen], minlength=size).reshape(shape)
            for chosen in (texels.is_known, texels.is_hidden)
        )
        colour = np.zeros((*shape, 3), np.float32)
        codes = np.log(np.maximum(texels.colours[texels.is_known], 1e-3))
        for channel in range(3):
            total = np.bincount(cell[texels.is_known], codes[:, channel], minlength=size)
            colour[..., channel] = total.reshape(shape) / np.maximum(known, 1)
        is_empty = (known == 0) & (hidden == 0)
        index = np.zeros((2, *shape), np.int32)
        away = np.asarray(distance_transform_edt(is_empty, return_indices=True, indices=index))
        is_near, (i, j) = away * _CELL_M < _SPREAD_M, index
        is_hidden = is_near & (known[i, j] == 0)
        is_known = binary_opening(is_near & (hidden[i, j] == 0), iterations=2)
        return cls(low, colour[i, j], np.asarray(is_known), is_hidden)

    def at(
        self, places: Float64[np.ndarray, "n 2"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Colours of places, and whether the map tells them."""
        column, row = np.floor((places - self.low_m) / _CELL_M).astype(np.int64).T
        height, width = self.is_known.shape
        is_inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        row, column = np.where(is_inside, row, 0), np.where(is_inside, column, 0)
        colour = np.clip(np.exp(self.colour[row, column]), LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
        return colour.astype(np.float32), is_inside & self.is_known[row, column]

    def completed(self) -> _RoadMap:
        """With its holes filled as far as the road tells them."""
        colour, is_told = self.colour.copy(), self.is_known.copy()
        number = np.zeros(self.is_hidden.shape, np.int32)
        label(self.is_hidden, np.ones((3, 3)), output=number)
        margin = round(_RING_M / _CELL_M) + 1
        for hole, box in enumerate(find_objects(number), 1):
            window = tuple(
                slice(max(s.start - margin, 0), min(s.stop + margin, size))
                for s, size in zip(box, number.shape, strict=True)
            )
            self._fill(number[window] == hole, window, colour, is_told)
        return replace(self, colour=colour, is_known=is_told)

    def _fill(
        self,
        hole: Bool[np.ndarray, "h w"],
        window: tuple[slice, ...],
        colour: Float32[np.ndarray, "t s 3"],
        is_told: Bool[np.ndarray, "t s"],
    ) -> None:
        """Fill one hole, shift by shift, those of the best surroundings first."""
        if hole.sum() * _CELL_M**2 < _LEAST_HOLE_M2:
            return
        first = np.array([side.start for side in window])
        ring = binary_dilation(
            hole, generate_binary_structure(2, 1), iterations=round(_RING_M / _CELL_M)
        )
        ring_at = np.argwhere(ring & self.is_known[window]) + first
        left = np.argwhere(hole) + first
        least = max(_LEAST_GAIN * len(left), 1.0)
        for shift in self._best_shifts(ring_at):
            is_there, there = self._shifted(left, shift)
            if is_there.sum() < least:
                continue
            level = self._level(ring_at, shift, window)
            here = left[is_there]
            inside = tuple((here - first).T)
            colour[tuple(here.T)] = self.colour[tuple(there[is_there].T)] + level[inside]
            is_told[tuple(here.T)] = True
            left = left[~is_there]
            if len(left) == 0:
                break

    def _shifted(
        self, cells: Int64[np.ndarray, "n 2"], shift: int
    ) -> tuple[Bool[np.ndarray, " n"], Int64[np.ndarray, "n 2"]]:
        """Whether cells are known this far along the road, and those cells."""
        column = cells[:, 1] + shift
        is_inside = (column >= 0) & (column < self.is_known.shape[1])
        there = np.stack([cells[:, 0], np.where(is_inside, column, 0)], axis=1)
        return is_inside & self.is_known[tuple(there.T)], there

    def _gap(
        self, cells: Int64[np.ndarray, "n 2"], shift: int
    ) -> tuple[Int64[np.ndarray, "m 2"], Float32[np.ndarray, "m 3"]]:
        """Those of the cells that are known this far along the road, and how much their colours
        differ from those there."""
        is_there, there = self._shifted(cells, shift)
        here = cells[is_there]
        return here, self.colour[tuple(here.T)] - self.colour[tuple(there[is_there].T)]

    def _best_shifts(self, ring: Int64[np.ndarray, "n 2"]) -> list[int]:
        """Shifts along the road under which a hole's surroundings agree, best first."""
        ring = ring[:: max(1, len(ring) // _RING_CELLS)]
        low, high = (round(metres / _CELL_M) for metres in _SHIFT_M)
        steps = np.arange(low, high + 1, _SHIFT_STEP)
        costs = []
        for shift in np.concatenate([steps, -steps]).tolist():
            here, gap = self._gap(ring, shift)
            fraction = len(here) / max(len(ring), 1)
            if fraction < _LEAST_RING:
                continue
            gap = np.abs(gap - np.median(gap, axis=0)).mean(axis=1)
            cost = float(np.minimum(gap, _RING_LIMIT).mean()) + _UNKNOWN_COST * (1 - fraction)
            costs.append((cost + _COST_PER_M * _CELL_M * abs(shift), shift))
        return [shift for _, shift in sorted(costs)[:_TRIED]]

    def _level(
        self, ring: Int64[np.ndarray, "n 2"], shift: int, window: tuple[slice, ...]
    ) -> Float32[np.ndarray, "h w 3"]:
        """By how much (log) the surroundings here differ from those there: near them as they do,
        further in by their median."""
        here, gap = self._gap(ring, shift)
        gap = np.clip(gap, -_LEVEL_LIMIT, _LEVEL_LIMIT)
        middle = np.median(gap, axis=0)
        inside = tuple((here - [side.start for side in window]).T)
        image = np.zeros((*self.is_known[window].shape, 4), np.float32)
        image[inside] = np.concatenate([gap - middle, np.ones((len(gap), 1))], axis=1)
        reach = _LEVEL_REACH_M / _CELL_M
        smooth = np.asarray(gaussian_filter(image, (reach, reach, 0)))
        return middle + smooth[..., :3] / (smooth[..., 3:] + _LEVEL_FADE)
