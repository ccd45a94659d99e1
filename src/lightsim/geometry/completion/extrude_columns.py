"""Facades in a mesh, how high they reach, and the footprint behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.extrude_grid import VoxelEvidence, VoxelGrid

_SAMPLE_AREA_M2 = 0.04
_MAX_SAMPLES_A_FACE = 200_000
_FRONT_M = 0.15
_MAX_GAP = 3
"""Cells in a row that are filled between columns."""


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Faces with a larger vertical part of the normal belong to no facade.
_MAX_NORMAL_Z = 0.4
# A facade reaches at least this far above the ground; parked cars do not.
_MIN_FACADE_HEIGHT_M = 2.5
# Poles, trunks and lamps are narrower.
_MIN_WIDTH_M = 2.0
# Mean resultant length of the normals nearby: walls agree, foliage does not.
_MIN_COHERENCE = 0.75
# Fraction of the voxels between the observed and the inferred top that views support.
_MIN_SUPPORT = 0.5
# Tops are medians over facade cells within this radius.
_SMOOTHING_RADIUS_M = 1.6
# A facade cell whose top no view saw takes the top of a cell this near on its facade.
_LEVEL_REACH_M = 15.0
# Lower structures are walls and fences: they get no footprint behind them.
_MIN_BUILDING_HEIGHT_M = 4.0
# Depth of the footprint behind a facade, where nothing observed contradicts.
_DEPTH_M = 8.0


@dataclass(frozen=True, eq=False)
class Facades:
    """Ground cells that hold a facade.

    Args:
        cells: (x, y) index.
        top: highest observed voxel.
        ground: voxel of the ground.
        inward: horizontal unit vector into the building.
        colour: mean linear base colour of what was observed.
    """

    cells: Int[np.ndarray, "n 2"]
    top: Int[np.ndarray, " n"]
    ground: Int[np.ndarray, " n"]
    inward: Float[np.ndarray, "n 2"]
    colour: Float[np.ndarray, "n 3"]
    component: Int[np.ndarray, " n"]
    is_ground_seen: Bool[np.ndarray, "x y"]


@dataclass(frozen=True)
class Column:
    """Filled voxels low..high (both included) above one ground cell."""

    x: int
    y: int
    low: int
    high: int
    colour: tuple[float, float, float]


def find_facades(mesh: TriMesh, grid: VoxelGrid) -> Facades:
    """Cells with near-vertical surface, tall, wide and flat enough to be a wall."""
    from skimage.measure import label

    points, normals, colours = _sample_walls(mesh, _MAX_NORMAL_Z)
    ground = _ground_level(mesh, grid, points)
    # A voxel inwards: cells then lie behind the surface. A guess that stuck out in front of a
    # measured wall would wrongly shade it.
    cells = grid.cells(points - grid.voxel_m * normals)
    inside = grid.contains(cells)
    cells, normals, colours = cells[inside], normals[inside], colours[inside]
    is_wall = np.zeros(grid.shape, bool)
    is_wall[tuple(cells.T)] = True
    plane = grid.shape[:2]
    flat = cells[:, 0] * plane[1] + cells[:, 1]
    count = _sum_nearby(np.bincount(flat, minlength=plane[0] * plane[1]), plane)
    normal = np.stack([_sum_cells(flat, normals[:, k], plane) for k in range(2)], axis=-1)
    colour = np.stack([_sum_cells(flat, colours[:, k], plane) for k in range(3)], axis=-1)
    length = np.linalg.norm(normal, axis=-1)
    levels = np.arange(grid.shape[2])
    top = np.where(is_wall, levels, -1).max(axis=2)
    filled = is_wall.sum(axis=2)
    needed = _MIN_FACADE_HEIGHT_M / grid.voxel_m
    is_facade = (top + 1 - ground >= needed) & (filled >= 0.5 * needed)
    is_facade &= length >= _MIN_COHERENCE * np.maximum(count, 1)
    components = np.asarray(label(is_facade, connectivity=2))
    is_facade &= _is_wide(components, _MIN_WIDTH_M / grid.voxel_m)[components]
    x, y = np.nonzero(is_facade)
    return Facades(
        np.stack([x, y], axis=1),
        top[x, y],
        ground[x, y],
        -normal[x, y] / length[x, y, None],
        colour[x, y] / count[x, y, None],
        components[x, y],
        _is_ground_seen(mesh, grid, ground),
    )


def columns_from_facades(facades: Facades, evidence: VoxelEvidence, min_votes: int) -> list[Column]:
    """Facades raised to the height the images support, with a footprint behind them."""
    if len(facades.cells) == 0:
        return []
    limit = _highest_uncarved(facades, evidence)
    top = _supported_top(facades, evidence, limit, min_votes, _MIN_SUPPORT)
    top = _level_roofs(facades, top, limit, evidence.grid.voxel_m)
    columns: dict[tuple[int, int], Column] = {}
    for n in np.nonzero(top > facades.top)[0]:
        key = (int(facades.cells[n, 0]), int(facades.cells[n, 1]))
        low, high = int(facades.top[n]) + 1, int(top[n])
        columns[key] = Column(*key, low, high, _rgb(facades.colour[n]))
    _add_footprints(columns, facades, top, evidence)
    _close_gaps(columns, evidence)
    return [columns[key] for key in sorted(columns)]


def free_in_front_of_walls(mesh: TriMesh, evidence: VoxelEvidence) -> None:
    """Mark the voxels that measured walls face as free: a guess there would shade the wall."""
    points, normals, _ = _sample_walls(mesh, _MAX_NORMAL_Z)
    cells = evidence.grid.cells(points + _FRONT_M * normals)
    cells = cells[evidence.grid.contains(cells)]
    evidence.is_free[tuple(cells.T)] = 1


def _ground_level(
    mesh: TriMesh, grid: VoxelGrid, wall_points: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "x y"]:
    """Lowest observed voxel within 5 m of each cell, or of the nearest cell that has one."""
    from scipy.ndimage import distance_transform_edt, minimum_filter

    cells = grid.cells(np.concatenate([mesh.vertices.astype(np.float64), wall_points]))
    cells = cells[grid.contains(cells)]
    lowest = np.full(grid.shape[:2], grid.shape[2])
    np.minimum.at(lowest, (cells[:, 0], cells[:, 1]), cells[:, 2])
    lowest = np.asarray(minimum_filter(lowest, 2 * round(5.0 / grid.voxel_m) + 1))
    nearest = distance_transform_edt(
        lowest == grid.shape[2], return_distances=False, return_indices=True
    )
    return lowest[tuple(np.asarray(nearest))]


def _is_ground_seen(
    mesh: TriMesh, grid: VoxelGrid, ground: Int[np.ndarray, "x y"]
) -> Bool[np.ndarray, "x y"]:
    """Cells with observed level surface within 1 m of the ground."""
    is_level = mesh.face_normals()[:, 2] > 0.8
    centres = mesh.vertices[mesh.faces[is_level]].mean(axis=1).astype(np.float64)
    cells = grid.cells(centres)
    cells = cells[grid.contains(cells)]
    cells = cells[cells[:, 2] <= ground[cells[:, 0], cells[:, 1]] + 1.0 / grid.voxel_m]
    seen = np.zeros(grid.shape[:2], bool)
    seen[cells[:, 0], cells[:, 1]] = True
    return seen


def _sample_walls(
    mesh: TriMesh, max_normal_z: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points spread evenly over near-vertical faces, their horizontal unit normals and colours."""
    normals = mesh.face_normals()
    is_wall = (np.abs(normals[:, 2]) <= max_normal_z) & (np.abs(normals).sum(axis=1) > 0)
    corners = mesh.vertices[mesh.faces[is_wall]].astype(np.float64)
    area = mesh.face_areas_m2()[is_wall]
    counts = np.clip(np.ceil(area / _SAMPLE_AREA_M2), 1, _MAX_SAMPLES_A_FACE).astype(np.int64)
    face = np.repeat(np.arange(len(corners)), counts)
    # The R2 sequence (Roberts 2018) covers each face evenly without a random generator.
    order = np.arange(len(face)) + 1.0
    u, v = np.mod(order * 0.7548776662466927, 1.0), np.mod(order * 0.5698402909980532, 1.0)
    is_over = u + v > 1
    u, v = np.where(is_over, 1 - u, u)[:, None], np.where(is_over, 1 - v, v)[:, None]
    c = corners[face]
    points = c[:, 0] + u * (c[:, 1] - c[:, 0]) + v * (c[:, 2] - c[:, 0])
    horizontal = normals[is_wall][face] * np.array([1.0, 1.0, 0.0])
    horizontal /= np.linalg.norm(horizontal, axis=1, keepdims=True)
    colours = mesh.base_colour[mesh.faces[is_wall]].mean(axis=1).astype(np.float64)[face]
    return points, horizontal, colours


def _sum_cells(
    flat: Int[np.ndarray, " n"], values: Float[np.ndarray, " n"], plane: tuple[int, int]
) -> Float[np.ndarray, "x y"]:
    """Sums over each cell and its eight neighbours."""
    return _sum_nearby(np.bincount(flat, values, minlength=plane[0] * plane[1]), plane)


def _sum_nearby(values: np.ndarray, plane: tuple[int, int]) -> Float[np.ndarray, "x y"]:
    from scipy.ndimage import uniform_filter

    return uniform_filter(values.reshape(plane).astype(np.float64), 3, mode="constant") * 9


def _is_wide(components: Int[np.ndarray, "x y"], min_cells: float) -> Bool[np.ndarray, " n"]:
    """By component index: it extends over at least `min_cells` along x or y."""
    from scipy.ndimage import find_objects

    boxes = find_objects(components)
    extents = [max(box[0].stop - box[0].start, box[1].stop - box[1].start) for box in boxes]
    return np.array([False, *(extent >= min_cells for extent in extents)])


def _highest_uncarved(facades: Facades, evidence: VoxelEvidence) -> Int[np.ndarray, " n"]:
    """Highest voxel above the observed top that no free voxel lies below."""
    levels = np.arange(evidence.grid.shape[2])
    is_free = evidence.is_free[facades.cells[:, 0], facades.cells[:, 1]] > 0
    is_blocking = is_free & (levels[None] > facades.top[:, None])
    first = np.where(is_blocking.any(axis=1), is_blocking.argmax(axis=1), len(levels))
    return first - 1


def _supported_top(
    facades: Facades,
    evidence: VoxelEvidence,
    limit: Int[np.ndarray, " n"],
    min_votes: int,
    min_support: float,
) -> Int[np.ndarray, " n"]:
    """Highest voxel up to `limit` with enough votes in it and below it."""
    levels = np.arange(evidence.grid.shape[2])[None]
    is_above = levels > facades.top[:, None]
    has_votes = evidence.votes[facades.cells[:, 0], facades.cells[:, 1]] >= min_votes
    supported = np.cumsum(has_votes & is_above, axis=1)
    height = np.maximum(levels - facades.top[:, None], 1)
    is_good = is_above & has_votes & (levels <= limit[:, None])
    is_good &= supported >= min_support * height
    return np.where(is_good, levels, facades.top[:, None]).max(axis=1)


def _level_roofs(
    facades: Facades,
    top: Int[np.ndarray, " n"],
    limit: Int[np.ndarray, " n"],
    voxel_m: float,
) -> Int[np.ndarray, " n"]:
    """Tops after a local median; where no view saw the top, that of the nearest cell of the
    same facade where one did: roofs are level."""
    from scipy.spatial import KDTree

    # Components apart in a third coordinate: no wall smooths another.
    apart = 1e4 * facades.component[:, None]
    places = np.concatenate([facades.cells, apart], axis=1).astype(np.float64)
    tree = KDTree(places)
    near = tree.query_ball_point(places, _SMOOTHING_RADIUS_M / voxel_m)
    smooth = np.array([round(float(np.median(top[i]))) for i in near], dtype=np.int64)
    has_seen_top = limit - top <= 2
    if not has_seen_top.any():
        return np.clip(smooth, facades.top, limit)
    known = KDTree(places[has_seen_top])
    distance, index = known.query(places)
    can_lend = ~has_seen_top & (distance * voxel_m <= _LEVEL_REACH_M)
    lent = np.maximum(smooth, smooth[has_seen_top][index])
    return np.clip(np.where(can_lend, lent, smooth), facades.top, limit)


def _close_gaps(columns: dict[tuple[int, int], Column], evidence: VoxelEvidence) -> None:
    """Fill empty cells between two columns on opposite sides (windows, missed cells) with what
    both have in common, where no view saw through."""
    shape = evidence.grid.shape
    filled: dict[tuple[int, int], Column] = {}
    for (x, y), first in columns.items():
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            steps = range(2, _MAX_GAP + 2)
            ends = ((k, columns.get((x + k * dx, y + k * dy))) for k in steps)
            width, second = next(((k, end) for k, end in ends if end is not None), (0, None))
            if second is None:
                continue
            low, high = max(first.low, second.low), min(first.high, second.high)
            for k in range(1, width):
                cell = (x + k * dx, y + k * dy)
                is_inside = 0 <= cell[0] < shape[0] and 0 <= cell[1] < shape[1]
                if not is_inside or cell in columns or high < low:
                    continue
                if not evidence.is_free[cell[0], cell[1], low : high + 1].any():
                    filled[cell] = Column(*cell, low, high, first.colour)
    columns.update(filled)


def _add_footprints(
    columns: dict[tuple[int, int], Column],
    facades: Facades,
    top: Int[np.ndarray, " n"],
    evidence: VoxelEvidence,
) -> None:
    """Fill columns from the ground to the facade's top, walking inward from each facade cell
    until the depth is reached, ground was observed, or views saw through."""
    grid = evidence.grid
    is_facade = np.zeros(grid.shape[:2], bool)
    is_facade[facades.cells[:, 0], facades.cells[:, 1]] = True
    tall = (top + 1 - facades.ground) * grid.voxel_m >= _MIN_BUILDING_HEIGHT_M
    for n in np.nonzero(tall)[0]:
        for k in range(2, 2 * int(_DEPTH_M / grid.voxel_m) + 1):
            x, y = np.floor(facades.cells[n] + 0.5 + 0.5 * k * facades.inward[n]).astype(int)
            if not (0 <= x < grid.shape[0] and 0 <= y < grid.shape[1]):
                break
            if is_facade[x, y]:
                continue
            low = int(facades.ground[n])
            free = np.nonzero(evidence.is_free[x, y, low : top[n] + 1])[0]
            high = int(low + free[0] - 1) if len(free) else int(top[n])
            if facades.is_ground_seen[x, y] or high - low < 0.5 * (top[n] - low):
                break
            key = (int(x), int(y))
            if key not in columns or columns[key].high < high:
                columns[key] = Column(*key, low, high, _rgb(facades.colour[n]))


def _rgb(colour: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(colour[0]), float(colour[1]), float(colour[2])
