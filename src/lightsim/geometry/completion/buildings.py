"""Buildings behind measured walls: panes closed, walls raised to their roofs, roofs and rear walls.

Beams pass through glass and end at the LiDAR's highest channel. What is missing of a building is
closed on the planes of its measured walls; each wall is the front of an upright prism. What some
view shows of it belongs to the visible mesh and gets its texture from the images; what no view
shows (roofs, rear walls, the tops of houses near the road) casts shadows and is kept apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.casting import MakeCaster, check_world
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.free_space import FreeSpace, find_free_space
from lightsim.geometry.completion.panes import find_panes
from lightsim.geometry.completion.profiles import best_profile, energy_of_filling
from lightsim.geometry.completion.rooflines import Roofline, find_rooflines
from lightsim.geometry.completion.silhouettes import View
from lightsim.geometry.completion.wall_cells import MAX_HEIGHT_M, WallCells, gather_cells
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.materials import FACADE

WINDOW = Material(0.1, 0.0, "window")
_OFFSET_LIMIT_M = 0.3
_OVERLAP_M = 0.03
"""Fillings reach one cell behind the measured wall around them, this deep."""
_RETREAT_M = 0.15
"""Hidden parts of a wall stand this far behind: they must not shade what was measured of it."""
_INSET_M = 0.35
"""Walls that only cast shadows start this far behind the front: they must not stick out of it."""

# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md).

# Lower walls are fences without a building behind them.
_MIN_BUILDING_M = 4.0
# Buildings are this deep unless free space tells otherwise.
_DEPTH_M, _DEPTH_STEP_M = 12.0, 0.5
# Nats of a slice of the prism that is wholly free, and of leaving away one that is not.
_FREE, _SLICE = 3.0, 0.15
# A step of the rear wall, and each slice of it.
_STEP, _STEP_PER_SLICE = 2.0, 0.1


def complete_buildings(
    background: TriMesh,
    silhouettes: Callable[[], Iterable[View]],
    sweeps: Iterable[LidarSweep],
    ground: GroundMap,
    *,
    make_caster: MakeCaster,
) -> tuple[TriMesh, TriMesh]:
    """What views show of it (panes interpolated, raised walls inferred), and what only casts
    shadows; frame world, black.

    Args:
        background: measured static surfaces, frame world, outward faces counter-clockwise.
        silhouettes: gives frames with their camera (of the matte's size) and sky matte, twice.
        sweeps: beams that went over a wall tell that it ends there.
        ground: heights count from it.
        make_caster: builds the ray caster.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    check_world([background])
    walls = find_walls(background)
    if not walls:
        return _empty(), _empty()
    caster = make_caster([background])
    cells = gather_cells(walls, caster, silhouettes(), sweeps)
    space = find_free_space(background, silhouettes(), caster, MAX_HEIGHT_M)
    rooflines = find_rooflines(cells, ground)
    visible = [part for roofline in rooflines for part in _visible_parts(roofline)]
    casting = [part for roofline in rooflines for part in _casting_parts(roofline, space)]
    return _joined(visible), _joined(casting)


def _joined(parts: list[TriMesh]) -> TriMesh:
    return concatenate_meshes(parts) if parts else _empty()


def _empty() -> TriMesh:
    nothing = np.zeros((0, 3), dtype=np.float32)
    return TriMesh("world", nothing, np.zeros((0, 3), dtype=np.int32), nothing, (FACADE,))


def _visible_parts(roofline: Roofline) -> Iterator[TriMesh]:
    """Panes, and the wall above the highest beam as far as a view shows it."""
    cells = roofline.cells
    offset = _spread_offset(cells)
    is_pane, is_upper = find_panes(cells), _raised(roofline) & _is_shown(cells)
    if is_pane.any():
        pane = _mesh_cells(cells, is_pane, offset, WINDOW)
        yield pane.with_provenance(Provenance.INTERPOLATED)
    if is_upper.any():
        upper = _mesh_cells(cells, is_upper, offset, FACADE)
        yield upper.with_provenance(Provenance.INFERRED)


def _raised(roofline: Roofline) -> Bool[np.ndarray, "s z"]:
    """Cells between the measured part of the wall and its roof."""
    cells = roofline.cells
    measured = cells.measured_top
    is_known = measured >= 0
    columns = np.arange(len(measured))
    start = np.interp(columns, columns[is_known], measured[is_known])
    levels = np.arange(cells.sky.shape[1])
    return (levels > start[:, None]) & (levels < roofline.top[:, None])


def _is_shown(cells: WallCells) -> Bool[np.ndarray, "s z"]:
    """Cells that some view shows as matter, and all below them."""
    is_matter = cells.matter > 0
    return np.logical_or.accumulate(is_matter[:, ::-1], axis=1)[:, ::-1]


def _casting_parts(roofline: Roofline, space: FreeSpace) -> Iterator[TriMesh]:
    """The wall that no view shows, and roof, rear and side walls of the prisms behind it."""
    cells = roofline.cells
    offset = _spread_offset(cells)
    is_hidden = _raised(roofline) & ~_is_shown(cells)
    if is_hidden.any():
        hidden = _mesh_cells(cells, is_hidden, offset - _RETREAT_M, FACADE)
        yield hidden.with_provenance(Provenance.INFERRED)
    depth = _depth(roofline, space)
    depth[roofline.height_m < _MIN_BUILDING_M] = 0
    runs = _runs(roofline.top, depth)
    quads = [quad for run in runs for quad in _prism(roofline, depth, run)]
    if quads:
        yield _mesh_quads(np.array(quads))


def _depth(roofline: Roofline, space: FreeSpace) -> Int64[np.ndarray, " s"]:
    """Slices of the prism behind each column, until views looked through where it would be."""
    cells = roofline.cells
    inward_m = _INSET_M + (np.arange(int(_DEPTH_M / _DEPTH_STEP_M)) + 0.5) * _DEPTH_STEP_M
    heights = np.linspace(0.1, 0.95, 12)
    z = roofline.ground_m[:, None] + heights * roofline.height_m[:, None]
    s = np.broadcast_to(cells.s_m[:, None], z.shape)
    places = cells.wall.at(s, z)[:, None] - inward_m[:, None, None] * cells.wall.normal
    free = space.at(places).mean(axis=2)
    energy = energy_of_filling(_FREE * free, np.full(free.shape, _SLICE))
    return best_profile(energy, _STEP, _STEP_PER_SLICE)


def _runs(*profiles: Int64[np.ndarray, " s"]) -> list[tuple[int, int]]:
    """First and one past the last column of each stretch where no profile changes."""
    changes = np.any([np.diff(profile) != 0 for profile in profiles], axis=0)
    borders = [0, *(np.flatnonzero(changes) + 1).tolist(), len(profiles[0])]
    return list(pairwise(borders))


def _prism(
    roofline: Roofline, depth: Int64[np.ndarray, " s"], run: tuple[int, int]
) -> Iterator[Float64[np.ndarray, "4 3"]]:
    """Roof, rear and side walls of one stretch; corners counter-clockwise from outside."""
    first, end = run
    if depth[first] == 0:
        return
    cells = roofline.cells
    s0, s1 = cells.wall.span_m[0] + cells.cell_m * np.array([first, end])
    # Another measured wall may meet this one at its ends.
    s0 += _INSET_M if first == 0 else 0.0
    s1 -= _INSET_M if end == len(depth) else 0.0
    low = float(roofline.ground_m[first:end].min())
    high = float(roofline.top_m[first])
    front, inset = -_OVERLAP_M, -_INSET_M
    rear = inset - float(depth[first]) * _DEPTH_STEP_M

    def corner(s: float, z: float, out: float) -> Float64[np.ndarray, "3"]:
        return cells.wall.at(np.array(s), np.array(z), out)

    yield np.array([corner(s0, high, front), corner(s1, high, front),
                    corner(s1, high, rear), corner(s0, high, rear)])  # fmt: skip
    yield np.array([corner(s1, low, rear), corner(s0, low, rear),
                    corner(s0, high, rear), corner(s1, high, rear)])  # fmt: skip
    yield np.array([corner(s0, low, rear), corner(s0, low, inset),
                    corner(s0, high, inset), corner(s0, high, rear)])  # fmt: skip
    yield np.array([corner(s1, low, inset), corner(s1, low, rear),
                    corner(s1, high, rear), corner(s1, high, inset)])  # fmt: skip


def _mesh_quads(corners: Float64[np.ndarray, "n 4 3"]) -> TriMesh:
    start = 4 * np.arange(len(corners), dtype=np.int32)[:, None]
    faces = np.concatenate([start + [[0, 1, 2]], start + [[0, 2, 3]]]).astype(np.int32)
    points = corners.reshape(-1, 3).astype(np.float32)
    mesh = TriMesh("world", points, faces, np.zeros_like(points), (FACADE,))
    return mesh.with_provenance(Provenance.INFERRED)


def _spread_offset(cells: WallCells) -> Float64[np.ndarray, "s z"]:
    """How far before the plane the measured wall around each cell lies: reveals and ledges."""
    from scipy.ndimage import gaussian_filter

    is_used = cells.is_covered & (np.abs(cells.offset_m) < _OFFSET_LIMIT_M)
    spread = 1.0 / cells.cell_m
    total = np.asarray(gaussian_filter(np.where(is_used, cells.offset_m, 0.0), spread))
    fraction = np.asarray(gaussian_filter(is_used.astype(np.float64), spread))
    return total / np.maximum(fraction, 0.02)


def _mesh_cells(
    cells: WallCells,
    is_filled: Bool[np.ndarray, "s z"],
    offset: Float64[np.ndarray, "s z"],
    material: Material,
) -> TriMesh:
    """Two triangles a cell, corners shared."""
    from scipy.ndimage import binary_dilation

    is_drawn = np.asarray(binary_dilation(is_filled, np.ones((3, 3), dtype=bool)))
    is_drawn = is_filled | (is_drawn & cells.is_covered)
    i, j = np.nonzero(is_drawn)
    across = is_filled.shape[1] + 1
    corner = i * across + j
    # `along` runs from left to right seen from outside.
    quads = np.stack([corner, corner + across, corner + across + 1, corner + 1], axis=1)
    used, index = np.unique(quads, return_inverse=True)
    index = index.reshape(-1, 4)
    padded = np.pad(offset, ((0, 1), (0, 1)), mode="edge") - _OVERLAP_M
    place = used // across, used % across
    s = cells.wall.span_m[0] + place[0] * cells.cell_m
    z = cells.wall.height_m[0] + place[1] * cells.cell_m
    points = cells.wall.at(s, z) + padded[place][:, None] * cells.wall.normal
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    return TriMesh(
        "world",
        points.astype(np.float32),
        faces.astype(np.int32),
        np.zeros((len(points), 3), dtype=np.float32),
        (material,),
    )
