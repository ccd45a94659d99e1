"""Meshes of signed-distance grids by marching cubes, and basic operations on meshes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64
from scipy.sparse.csgraph import connected_components

from lightsim.core.adjacency import adjacency
from lightsim.core.fields import BLOCK, SceneFields, TsdfGrid
from lightsim.core.mesh import Material, Texture, TriMesh

MATTE = Material()
# Edge of the cubes that are meshed at once, in blocks: dense copies of 64 samples a side.
_REGION_BLOCKS = 8
# Distance within which vertices are merged, in samples: regions compute common vertices twice.
_WELD_FRACTION = 1e-3


def extract_surface(grid: TsdfGrid, min_weight: float = 0.0) -> TriMesh:
    """Return the zero level set as a black mesh, normals towards positive distance (Lorensen &
    Cline 1987, doi:10.1145/37402.37422).

    Cells with a corner of weight <= `min_weight` are unobserved and have no surface.
    """
    from skimage.measure import marching_cubes

    vertices, faces, count = [], [], 0
    for start, sdf, weight in _regions(grid):
        is_known = weight > min_weight
        cells = _complete_cells(is_known)
        signs = np.where(is_known, np.sign(sdf), 0)
        if not cells.any() or (signs >= 0).all() or (signs <= 0).all():
            continue
        # The mask of scikit-image refers to a cell by its last corner.
        mask = np.zeros(sdf.shape, dtype=bool)
        mask[1:, 1:, 1:] = cells
        try:
            points, triangles, _, _ = marching_cubes(sdf, 0.0, mask=mask)
        except RuntimeError:  # raised when no cell under the mask holds a surface
            continue
        vertices.append(points.astype(np.float64) + start)
        faces.append(triangles.astype(np.int64) + count)
        count += len(points)
    if not vertices:
        return make_mesh(grid.frame, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    points, triangles = weld(np.concatenate(vertices), np.concatenate(faces))
    return make_mesh(grid.frame, grid.origin_m + grid.voxel_m * points, triangles)


def make_mesh(
    frame: str, vertices: Float[np.ndarray, "n 3"], faces: Int64[np.ndarray, "m 3"]
) -> TriMesh:
    """Return a black mesh without materials."""
    black = np.zeros((len(vertices), 3), dtype=np.float32)
    return TriMesh(frame, vertices.astype(np.float32), faces.astype(np.int32), black)


def quad_mesh(
    corners: Float64[np.ndarray, "n 3"],
    quads: Int64[np.ndarray, "m 4"],
    material: Material = MATTE,
) -> TriMesh:
    """Return a black mesh in frame `world` of two triangles per quad, without unused corners.

    Args:
        corners: positions in metres.
        quads: indices of the corners, counter-clockwise when viewed from outside.
        material: material of all faces.
    """
    used, index = np.unique(quads, return_inverse=True)
    index = index.reshape(-1, 4).astype(np.int64)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    return replace(make_mesh("world", corners[used], faces), materials=(material,))


def parallelogram(
    corner: Float64[np.ndarray, "3"],
    first: Float64[np.ndarray, "3"],
    second: Float64[np.ndarray, "3"],
    edge_m: float,
    material: Material,
) -> TriMesh:
    """Return a black parallelogram in frame `world`, of cells with edges of at most `edge_m`.

    Its normal is along the cross product of `first` and `second`.
    """
    count = [max(1, int(np.ceil(np.linalg.norm(edge) / edge_m))) for edge in (first, second)]
    i, j = (k.reshape(-1, 1) for k in np.indices((count[0] + 1, count[1] + 1)))
    points = corner + i / count[0] * first + j / count[1] * second
    return grid_mesh(points.reshape(count[0] + 1, count[1] + 1, 3), material)


def grid_mesh(corners: Float64[np.ndarray, "a b 3"], material: Material) -> TriMesh:
    """Return a black mesh in frame `world` of the quads between rows and columns of corners.

    Normals are along the cross product of the steps along the first and the second axis.
    """
    rows, across = corners.shape[:2]
    start = (np.arange(rows - 1)[:, None] * across + np.arange(across - 1)).reshape(-1, 1)
    return quad_mesh(corners.reshape(-1, 3), start + [0, across, across + 1, 1], material)


def _complete_cells(is_known: Bool[np.ndarray, "a b c"]) -> Bool[np.ndarray, "_d _e _f"]:
    cells = is_known[1:] & is_known[:-1]
    cells = cells[:, 1:] & cells[:, :-1]
    return cells[:, :, 1:] & cells[:, :, :-1]


def _regions(
    grid: TsdfGrid,
) -> Iterator[
    tuple[Int64[np.ndarray, "3"], Float32[np.ndarray, "s s s"], Float32[np.ndarray, "s s s"]]
]:
    """Yield start, distances and weights of cubes of 65 samples a side.

    Adjacent cubes have one layer of samples in common, so that their surfaces meet.
    """
    if len(grid.block_coords) == 0:
        return
    low = grid.block_coords.min(axis=0)
    local = (grid.block_coords - low).astype(np.int64)
    table = np.full(tuple((local.max(axis=0) + _REGION_BLOCKS + 2).tolist()), -1, dtype=np.int64)
    table[tuple(local.T)] = np.arange(len(local))
    size = _REGION_BLOCKS * BLOCK + 1
    side = _REGION_BLOCKS + 1
    for region in np.unique(local // _REGION_BLOCKS, axis=0):
        first = region * _REGION_BLOCKS
        part = table[tuple(slice(f, f + side) for f in first.tolist())]
        sdf = np.full((side * BLOCK,) * 3, grid.truncation_m, dtype=np.float32)
        weight = np.zeros_like(sdf)
        for i, j, k in np.argwhere(part >= 0).tolist():
            where = tuple(slice(BLOCK * a, BLOCK * (a + 1)) for a in (i, j, k))
            sdf[where] = grid.sdf_m[part[i, j, k]]
            weight[where] = grid.weight[part[i, j, k]]
        yield (
            (BLOCK * (first + low)).astype(np.int64),
            sdf[:size, :size, :size],
            weight[:size, :size, :size],
        )


def weld(
    vertices: Float64[np.ndarray, "n 3"], faces: Int64[np.ndarray, "m 3"]
) -> tuple[Float64[np.ndarray, "p 3"], Int64[np.ndarray, "q 3"]]:
    """Merge vertices closer than a thousandth of a sample, and remove degenerate faces."""
    key = np.rint(vertices / _WELD_FRACTION).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    is_proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    is_proper &= faces[:, 0] != faces[:, 2]
    return vertices[first], faces[is_proper]


def keep_faces(mesh: TriMesh, is_kept: Bool[np.ndarray, " m"]) -> TriMesh:
    """Return a mesh of the selected faces, without unused vertices."""
    faces = mesh.faces[is_kept]
    used, inverse = np.unique(faces, return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=inverse.reshape(-1, 3).astype(np.int32),
        base_colour=mesh.base_colour[used],
        face_material=None if mesh.face_material is None else mesh.face_material[is_kept],
        texture=None
        if mesh.texture is None
        else Texture(mesh.texture.image, mesh.texture.corner_uv[is_kept]),
        confidence=None if mesh.confidence is None else mesh.confidence[used],
        face_provenance=None if mesh.face_provenance is None else mesh.face_provenance[is_kept],
    )


def drop_floaters(
    mesh: TriMesh, min_area_m2: float, is_suspect: Bool[np.ndarray, " m"] | None = None
) -> TriMesh:
    """Remove connected pieces smaller than an area: noise that would cast random shadows.

    Args:
        mesh: any mesh.
        min_area_m2: least area of a piece.
        is_suspect: faces that may be noise; pieces without one are not removed. None: all faces.
    """
    if len(mesh.faces) == 0:
        return mesh
    count, piece = connected_components(adjacency(mesh.faces, len(mesh.vertices)), directed=False)
    face_piece = piece[mesh.faces[:, 0]]
    area = np.bincount(face_piece, weights=mesh.face_areas_m2(), minlength=int(count))
    is_kept = area >= min_area_m2
    if is_suspect is not None:
        is_kept |= np.bincount(face_piece, weights=is_suspect, minlength=int(count)) == 0
    return keep_faces(mesh, is_kept[face_piece])


def border_vertices(faces: Int32[np.ndarray, "m 3"]) -> Int64[np.ndarray, " b"]:
    """Return the vertices at edges that belong to one face only."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    # One number for each edge: rows sort ten times slower.
    edges, count = np.unique(ends[:, 0] << 32 | ends[:, 1], return_counts=True)
    alone = edges[count == 1]
    return np.unique([alone >> 32, alone & 0xFFFFFFFF])


def background_levels(fields: SceneFields, min_weight: float) -> list[TriMesh]:
    """Return one mesh per background level, each within its own ring around the path."""
    meshes, inner = [], 0.0
    for grid, outer in zip(fields.background, fields.background_radius_m, strict=True):
        mesh = extract_surface(grid, min_weight)
        distance = path_distance_m(mesh.vertices[mesh.faces].mean(axis=1), fields.path_m)
        # Rings overlap by one sample of the coarser level, so that no gap opens between them.
        is_own = (distance <= outer) & (distance >= inner - grid.voxel_m)
        meshes.append(keep_faces(mesh, is_own))
        inner = outer
    return meshes


def path_distance_m(
    points_world: Float32[np.ndarray, "n 3"], path_m: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, " n"]:
    """Return the horizontal distance of points from the nearest point of the path, in metres."""
    from scipy.spatial import KDTree

    if len(points_world) == 0:
        return np.zeros(0)
    distance, _ = KDTree(path_m[:, :2]).query(points_world[:, :2])
    return np.asarray(distance)
