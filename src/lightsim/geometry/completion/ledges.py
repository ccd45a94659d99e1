"""Ledges of facades as beams draw them: cornices, bands, sills, canopies, slabs of balconies.

A field of coarse samples rounds off what stands a hand's breadth out of a wall, and such things
cast most of a facade's small shadows. Returns lie on them to within centimetres, however: where
beams that reach a place of the wall all end before it, something solid stands there. What is level
and long along the wall is drawn as a box; foliage, signs and rails, past which beams find the wall,
are not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.core.buildings import Wall, WallPart
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.walls import returns_near
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import parallelogram

# Chosen while looking at the benchmark's streets 1 and 58; benchmarks/target_shadows.py says what
# they bring.

# Cells in which a wall is looked at: along it, and upward.
_CELL_M = (0.25, 0.05)
# How far the fronts of sills and bands, of cornices, and of canopies and slabs stand before the
# wall. Nearer returns are the wall's: beams and planes are noisy.
_LAYERS_M = ((0.07, 0.25), (0.2, 0.6), (0.5, 1.3))
# Returns this far behind a wall's plane may lie on the wall.
_BEHIND_M = 0.5
# Columns this near tell how far out a house stands, in steps of so much.
_HOUSE_M, _LEVEL_STEP_M = 1.0, 0.02
# Returns on a ledge for each that lies behind it, in each cell and in all: beams pass rails.
_LEAST_RATIO = 2.5
# Along a ledge, cells without any return up to this wide belong to it.
_GAP_M = 1.0
# Least length and returns of a ledge, and its least and greatest height.
_LENGTH_M, _RETURNS, _HEIGHTS_M = 0.8, 8, (0.05, 0.6)
# Above the ground: people, bins and parked vehicles stand before a wall below.
_FOOT_M = 0.4
# Most between the tenths of a ledge's returns that lie farthest in and out.
_FLAT_M = 0.1
# Ends of a ledge lie no farther than this beyond its returns.
_END_M = 0.3
# Ledges reach behind the wall's level, so that no light passes between.
_OVERLAP_M = 0.05
# Edges of their faces: each has its own patch of texture.
_EDGE_M = 0.25
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Ledge(WallPart):
    """A level box before a wall.

    Args:
        out_m: of the wall around and of the ledge's front before the wall's plane.
    """

    out_m: tuple[float, float]


def find_ledges(
    walls: Sequence[Wall], returns_world: Float32[np.ndarray, "n 3"], ground: GroundMap
) -> list[Ledge]:
    """Ledges of all walls.

    Args:
        walls: planes, frame world.
        returns_world: of LiDAR beams, from what stands still.
        ground: what stands on it is no ledge.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2])
    above = returns_world[height > _FOOT_M]
    ledges: list[Ledge] = []
    for wall in walls:
        # One by one: layers of a wall overlap, too.
        for ledge in _ledges_of(wall, above):
            if not _is_among(ledge, ledges):
                ledges.append(ledge)
    return ledges


def with_ledges(mesh: TriMesh, ledges: Sequence[Ledge]) -> TriMesh:
    """The surface and its ledges, frame world, black."""
    return concatenate_meshes([mesh, *map(_box, ledges)]) if ledges else mesh


@dataclass(frozen=True, eq=False)
class _Returns:
    """Returns before a wall: place along it, height, and how far before the wall around."""

    s: Float64[np.ndarray, " n"]
    z: Float64[np.ndarray, " n"]
    out: Float64[np.ndarray, " n"]

    def at(self, rows: Bool[np.ndarray, " n"]) -> _Returns:
        return _Returns(self.s[rows], self.z[rows], self.out[rows])


def _ledges_of(wall: Wall, returns_world: Float32[np.ndarray, "n 3"]) -> Iterator[Ledge]:
    """Layer by layer: what stands before a layer hides it, what lies behind denies it."""
    from scipy.ndimage import find_objects
    from skimage.measure import label

    near, level_m = _before(wall, returns_world)
    i, j = (
        (x / size).astype(np.int64)
        for x, size in zip(
            (near.s - wall.span_m[0], near.z - wall.height_m[0]), _CELL_M, strict=True
        )
    )
    shape = len(level_m), int(j.max(initial=0)) + 1
    for nearest, farthest in _LAYERS_M:
        is_on, is_behind = (near.out > nearest) & (near.out < farthest), near.out < nearest
        on, behind = (_counted(i[rows], j[rows], shape) for rows in (is_on, is_behind))
        pieces = np.asarray(label(_closed(on > _LEAST_RATIO * behind, behind > 0), connectivity=1))
        number_at = np.where(is_on, pieces[i, j], 0)
        for number, box in enumerate(find_objects(pieces), start=1):
            own = near.at(number_at == number)
            columns = box[0]
            beside = near.at(is_behind & (i >= columns.start) & (i < columns.stop))
            ledge = _ledge(wall, own, beside, float(np.median(level_m[columns])))
            if ledge is not None:
                yield ledge


def _before(
    wall: Wall, returns_world: Float32[np.ndarray, "n 3"]
) -> tuple[_Returns, Float64[np.ndarray, " s"]]:
    """Returns before a wall, and how far before its plane the wall lies in each column: where most
    of the returns of the columns around lie."""
    from scipy.ndimage import uniform_filter1d

    points = returns_near(wall, returns_world, (_LAYERS_M[-1][1], _BEHIND_M))
    s, out = wall.place(points)
    is_used = (s > wall.span_m[0]) & (s < wall.span_m[1]) & (points[:, 2] > wall.height_m[0])
    s, z, out = s[is_used], points[is_used, 2], out[is_used]
    columns = max(int(np.ceil((wall.span_m[1] - wall.span_m[0]) / _CELL_M[0])), 1)
    column = ((s - wall.span_m[0]) / _CELL_M[0]).astype(np.int64)
    steps = round(2 * _BEHIND_M / _LEVEL_STEP_M)
    step = ((out + _BEHIND_M) / _LEVEL_STEP_M).astype(np.int64)
    is_near = step < steps
    counts = _counted(column[is_near], step[is_near], (columns, steps))
    around = uniform_filter1d(counts, 2 * round(_HOUSE_M / _CELL_M[0]) + 1, axis=0)
    around = uniform_filter1d(around, 3, axis=1)
    level = (around.argmax(axis=1) + 0.5) * _LEVEL_STEP_M - _BEHIND_M
    return _Returns(s, z, out - level[column]), level


def _counted(i: np.ndarray, j: np.ndarray, shape: tuple[int, int]) -> Float64[np.ndarray, "_ _"]:
    flat = np.bincount(i * shape[1] + j, minlength=shape[0] * shape[1])
    return flat.reshape(shape).astype(np.float64)


def _closed(
    is_ledge: Bool[np.ndarray, "s z"], is_wall: Bool[np.ndarray, "s z"]
) -> Bool[np.ndarray, "s z"]:
    """Cells of ledges, and those between them, along the wall and to the next row, that no return
    tells to be wall."""
    from scipy.ndimage import binary_closing

    reach = round(_GAP_M / _CELL_M[0])
    padded = np.pad(is_ledge, reach)
    along = np.asarray(binary_closing(padded, np.ones((reach + 1, 1), dtype=bool)))
    both = np.asarray(binary_closing(along, np.ones((1, 3), dtype=bool)))
    return is_ledge | (both[reach:-reach, reach:-reach] & ~is_wall)


def _ledge(wall: Wall, own: _Returns, beside: _Returns, level_m: float) -> Ledge | None:
    """The box that returns draw; None where they draw none."""
    if len(own.s) < _RETURNS:
        return None
    (s0, s1), (z0, z1) = (np.percentile(x, [1, 99]) for x in (own.s, own.z))
    inner, front, outer = np.percentile(own.out, [10, 50, 90])
    if s1 - s0 < _LENGTH_M or z1 - z0 > _HEIGHTS_M[1] or outer - inner > _FLAT_M:
        return None
    is_through = (beside.z > z0) & (beside.z < z1) & (beside.s > s0) & (beside.s < s1)
    if len(own.s) < _LEAST_RATIO * is_through.sum():
        return None
    heights = _ends(own.z, (z0, z1), beside.z)
    if heights[1] - heights[0] < _HEIGHTS_M[0]:
        return None
    spans = _ends(own.s, (s0, s1), beside.s[(beside.z > z0) & (beside.z < z1)])
    return Ledge(wall, spans, heights, (level_m, level_m + float(front)))


def _ends(
    own: Float64[np.ndarray, " n"],
    ends: tuple[float, float],
    others: Float64[np.ndarray, " m"],
) -> tuple[float, float]:
    """A range that goes on as far as its places lie apart in the mean, but no farther than half way
    to what lies next to it."""
    low, high = ends
    farther = min((high - low) / (len(own) - 1), _END_M)
    below = others[others < low].max(initial=low - 2 * farther)
    above = others[others > high].min(initial=high + 2 * farther)
    return max((low + below) / 2, low - farther), min((high + above) / 2, high + farther)


def _is_among(ledge: Ledge, others: Sequence[Ledge]) -> bool:
    """Whether a ledge's middle lies in another: planes may lie close together."""
    middle = ledge.middle(float(np.mean(ledge.out_m)))
    return any(other.holds(middle, float(np.mean(other.out_m)), _BEHIND_M) for other in others)


def _box(ledge: Ledge) -> TriMesh:
    """Front, upper and lower side and both ends; seen from outside."""
    wall, (s0, s1), (z0, z1) = ledge.wall, ledge.span_m, ledge.height_m
    rear, front = ledge.out_m[0] - _OVERLAP_M, ledge.out_m[1]
    width, height = (s1 - s0) * wall.along, (z1 - z0) * _UP
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
    faces = [parallelogram(*side, _EDGE_M, FACADE) for side in sides]
    return concatenate_meshes(faces).with_provenance(Provenance.INTERPOLATED)
