"""Ledges of facades from LiDAR returns: cornices, bands, sills, canopies, slabs of balconies.

The field's coarse samples round off structure of decimetre size, which casts most of a facade's
small shadows. Returns locate it to within centimetres: where all beams towards a part of the wall
end in front of it, there is a solid body. A horizontal, elongated body is modelled as a box.
Foliage, signs and rails are excluded, because some beams pass them and reach the wall.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.core.buildings import Wall, WallPart
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.walls import UP, WALL_CELL_M, returns_near
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import parallelogram

# The values below were chosen on streets 1 and 58; their joint effect on shadows is measured by
# benchmarks/target_shadows.py.


class _Limits:
    """Cells of a wall, and limits of the ledges in front of it."""

    cell_m = (0.25, 0.05)  # Size of a cell, along the wall and upward.
    # Distances of fronts before the wall: sills and bands; cornices; canopies and slabs. Nearer
    # returns are noise of the wall.
    layers_m = ((0.07, 0.25), (0.2, 0.6), (0.5, 1.3))
    behind_m = 0.5  # Greatest distance of the wall's returns behind its plane.
    house_m = 1.0  # Distance along the wall within which returns determine its offset.
    level_step_m = 0.02  # Resolution of that offset.
    # Least ratio of returns on a ledge to returns behind it, in each cell and in total; rails have
    # a lower ratio.
    min_ratio = 2.5
    gap_m = 1.0  # Widest gap without returns along a ledge.
    length_m = 0.8  # Least length.
    returns = 8  # Least number of returns.
    heights_m = (0.05, 0.6)  # Least and greatest height.
    foot_m = 0.4  # Least height above the ground: people, bins and parked vehicles are lower.
    flat_m = 0.1  # Greatest distance between 10th and 90th percentile of offsets.
    end_m = 0.3  # Greatest extension beyond the last return.
    overlap_m = 0.05  # Depth of ledges behind the wall's level: no light passes between.


@dataclass(frozen=True)
class Ledge(WallPart):
    """A level box in front of a wall.

    Args:
        out_m: offsets of the surrounding wall and of the ledge's front from the wall's plane, in
            metres.
    """

    out_m: tuple[float, float]


def find_ledges(
    walls: Sequence[Wall], returns_world: Float32[np.ndarray, "n 3"], ground: GroundMap
) -> list[Ledge]:
    """Return the ledges of all walls.

    Args:
        walls: planes, frame world.
        returns_world: LiDAR returns from static surfaces, frame world.
        ground: reference of heights.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2])
    above = returns_world[height > _Limits.foot_m]
    ledges: list[Ledge] = []
    for wall in walls:
        # Each ledge is compared with all before it: the layers of one wall overlap too.
        for ledge in _ledges_of(wall, above):
            if not _is_among(ledge, ledges):
                ledges.append(ledge)
    return ledges


def with_ledges(mesh: TriMesh, ledges: Sequence[Ledge]) -> TriMesh:
    """Return the surface with its ledges added, frame world, black."""
    return concatenate_meshes([mesh, *map(_box, ledges)]) if ledges else mesh


def _ledges_of(wall: Wall, returns_world: Float32[np.ndarray, "n 3"]) -> Iterator[Ledge]:
    """Yield ledges layer by layer: returns behind a layer are evidence against its ledges."""
    from scipy.ndimage import find_objects
    from skimage.measure import label

    near, level_m = _before(wall, returns_world)
    low = np.array([wall.span_m[0], wall.height_m[0]])
    i, j = ((near[:, :2] - low) / _Limits.cell_m).astype(np.int64).T
    shape = len(level_m), int(j.max(initial=0)) + 1
    for nearest, farthest in _Limits.layers_m:
        is_on, is_behind = (near[:, 2] > nearest) & (near[:, 2] < farthest), near[:, 2] < nearest
        on, behind = (_counted(i[rows], j[rows], shape) for rows in (is_on, is_behind))
        pieces = np.asarray(
            label(_closed(on > _Limits.min_ratio * behind, behind > 0), connectivity=1)
        )
        number_at = np.where(is_on, pieces[i, j], 0)
        for number, (columns, _) in enumerate(find_objects(pieces), start=1):
            beside = near[is_behind & (i >= columns.start) & (i < columns.stop)]
            level = float(np.median(level_m[columns]))
            ledge = _ledge(wall, near[number_at == number], beside, level)
            if ledge is not None:
                yield ledge


def _before(
    wall: Wall, returns_world: Float32[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " s"]]:
    """Return the returns near a wall (place along it, height, offset from the wall around), and the
    level of that wall before its plane in each column.

    The level is the mode of the offsets in the columns around.
    """
    from scipy.ndimage import uniform_filter1d

    points = returns_near(wall, returns_world, (_Limits.layers_m[-1][1], _Limits.behind_m))
    s, out = wall.place(points)
    is_used = (s > wall.span_m[0]) & (s < wall.span_m[1]) & (points[:, 2] > wall.height_m[0])
    s, z, out = s[is_used], points[is_used, 2], out[is_used]
    columns = max(int(np.ceil((wall.span_m[1] - wall.span_m[0]) / _Limits.cell_m[0])), 1)
    column = ((s - wall.span_m[0]) / _Limits.cell_m[0]).astype(np.int64)
    steps = round(2 * _Limits.behind_m / _Limits.level_step_m)
    step = ((out + _Limits.behind_m) / _Limits.level_step_m).astype(np.int64)
    is_near = step < steps
    counts = _counted(column[is_near], step[is_near], (columns, steps))
    around = uniform_filter1d(counts, 2 * round(_Limits.house_m / _Limits.cell_m[0]) + 1, axis=0)
    around = uniform_filter1d(around, 3, axis=1)
    level = (around.argmax(axis=1) + 0.5) * _Limits.level_step_m - _Limits.behind_m
    return np.stack([s, z, out - level[column]], axis=1), level


def _counted(i: np.ndarray, j: np.ndarray, shape: tuple[int, int]) -> Float64[np.ndarray, "_ _"]:
    flat = np.bincount(i * shape[1] + j, minlength=shape[0] * shape[1])
    return flat.reshape(shape).astype(np.float64)


def _closed(
    is_ledge: Bool[np.ndarray, "s z"], is_wall: Bool[np.ndarray, "s z"]
) -> Bool[np.ndarray, "s z"]:
    """Return the cells of ledges, and cells between them without returns on the wall."""
    from scipy.ndimage import binary_closing

    reach = round(_Limits.gap_m / _Limits.cell_m[0])
    padded = np.pad(is_ledge, reach)
    along = np.asarray(binary_closing(padded, np.ones((reach + 1, 1), dtype=bool)))
    both = np.asarray(binary_closing(along, np.ones((1, 3), dtype=bool)))
    return is_ledge | (both[reach:-reach, reach:-reach] & ~is_wall)


def _ledge(
    wall: Wall,
    own: Float64[np.ndarray, "n 3"],
    beside: Float64[np.ndarray, "m 3"],
    level_m: float,
) -> Ledge | None:
    """Return the box of a group of returns, or None if they do not form a ledge."""
    if len(own) < _Limits.returns:
        return None
    (s0, z0), (s1, z1) = low, high = np.percentile(own[:, :2], [1, 99], axis=0)
    inner, front, outer = np.percentile(own[:, 2], [10, 50, 90])
    is_level = z1 - z0 <= _Limits.heights_m[1] and outer - inner <= _Limits.flat_m
    is_within = (beside[:, :2] > low) & (beside[:, :2] < high)
    is_solid = len(own) >= _Limits.min_ratio * is_within.all(axis=1).sum()
    heights = _ends(own[:, 1], (z0, z1), beside[:, 1])
    is_level &= heights[1] - heights[0] >= _Limits.heights_m[0]
    if not is_level or not is_solid or s1 - s0 < _Limits.length_m:
        return None
    spans = _ends(own[:, 0], (s0, s1), beside[is_within[:, 1], 0])
    return Ledge(wall, spans, heights, (level_m, level_m + float(front)))


def _ends(
    own: Float64[np.ndarray, " n"],
    ends: tuple[float, float],
    others: Float64[np.ndarray, " m"],
) -> tuple[float, float]:
    """Extend a range by the mean spacing of its points, at most half way to other structure."""
    low, high = ends
    farther = min((high - low) / (len(own) - 1), _Limits.end_m)
    below = others[others < low].max(initial=low - 2 * farther)
    above = others[others > high].min(initial=high + 2 * farther)
    return max((low + below) / 2, low - farther), min((high + above) / 2, high + farther)


def _is_among(ledge: Ledge, others: Sequence[Ledge]) -> bool:
    """Return whether a ledge's centre lies in another ledge: two planes may lie close together."""
    middle = ledge.middle(float(np.mean(ledge.out_m)))
    return any(
        other.holds(middle, float(np.mean(other.out_m)), _Limits.behind_m) for other in others
    )


def _box(ledge: Ledge) -> TriMesh:
    """Return the front, top, bottom and both ends, with outward normals."""
    wall, (s0, s1), (z0, z1) = ledge.wall, ledge.span_m, ledge.height_m
    rear, front = ledge.out_m[0] - _Limits.overlap_m, ledge.out_m[1]
    width, height = (s1 - s0) * wall.along, (z1 - z0) * UP
    deep = (front - rear) * wall.normal

    def corner(s: float, z: float, out: float) -> Float64[np.ndarray, "3"]:
        return wall.at(np.array(s), np.array(z), out)

    sides = (
        (corner(s0, z0, front), width, height),
        (corner(s0, z1, rear), deep, width),
        (corner(s0, z0, rear), width, deep),
        (corner(s0, z0, rear), deep, height),
        (corner(s1, z0, rear), height, deep),
    )
    faces = [parallelogram(*side, WALL_CELL_M, FACADE) for side in sides]
    return concatenate_meshes(faces).with_provenance(Provenance.INTERPOLATED)
