"""Mesh simplification by edge collapse, and denoising of normals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int32

from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.denoise_kernels import filter_normals, fit_vertices, neighbour_faces
from lightsim.geometry.simplify_kernels import (
    collapse_round,
    edge_costs,
    faces_by_vertex,
    list_edges,
    vertex_quadrics,
)

# Fraction of the vertices that a round must remove for another one to follow.
_MIN_PROGRESS = 1e-2


def simplify(
    mesh: TriMesh,
    max_error_m: Float[np.ndarray, " n"],
    max_edge_m: Float[np.ndarray, " n"],
) -> TriMesh:
    """Collapse edges while the surface remains within an error bound (Garland & Heckbert 1997,
    doi:10.1145/258734.258849).

    The error is the area-weighted RMS distance of a vertex from the planes of the original faces
    that it replaces. The topology does not change: every collapse meets the link condition, and
    none rotates a face by more than 60 degrees. Borders, and lines between materials or
    provenances, also keep this error bound. Colours, texture and confidence are discarded:
    simplify before colouring.

    Args:
        mesh: any triangles; vertices at edges of more than two faces do not move.
        max_error_m: error bound at each vertex.
        max_edge_m: longest edge that a collapse may make, at each vertex.

    Returns:
        A black mesh with the same materials and provenances.
    """
    points = mesh.vertices.astype(np.float64)
    faces = mesh.faces.astype(np.int64)
    groups = _groups(mesh)
    start, members = faces_by_vertex(faces, len(points))
    quadrics, weight = vertex_quadrics(points, faces, groups, start, members)
    error, edge = max_error_m.astype(np.float64), max_edge_m.astype(np.float64)
    remaining = len(points)
    for _ in range(40):  # usually ends earlier, by lack of progress
        start, members = faces_by_vertex(faces, len(points))
        edges, uses, kind = list_edges(faces, groups, start, members)
        cost, place = edge_costs(points, edges, uses, kind, quadrics, weight, error, edge)
        order = np.flatnonzero(np.isfinite(cost))
        order = order[np.argsort(cost[order], kind="stable")]
        done = collapse_round(
            points, faces, groups, start, members, edges, uses, cost, place, order,
            quadrics, weight, error, edge,
        )  # fmt: skip
        alive = faces[:, 0] >= 0
        faces, groups = faces[alive], groups[alive]
        remaining -= done
        if done < _MIN_PROGRESS * remaining:
            break
    used, index = np.unique(faces, return_inverse=True)
    return TriMesh(
        mesh.frame,
        points[used].astype(np.float32),
        index.reshape(-1, 3).astype(np.int32),
        np.zeros((len(used), 3), dtype=np.float32),
        mesh.materials,
        None if mesh.face_material is None else (groups // len(Provenance)).astype(np.uint8),
        face_provenance=None
        if mesh.face_provenance is None
        else (groups % len(Provenance)).astype(np.uint8),
    )


def simplify_planar(mesh: TriMesh, edge_m: float | Float[np.ndarray, " n"] = 0.75) -> TriMesh:
    """Simplify a surface of planar cells, with an error bound of 1 cm."""
    if len(mesh.faces) == 0:
        return mesh
    count = len(mesh.vertices)
    return simplify(mesh, np.full(count, 0.01), np.full(count, edge_m, dtype=np.float64))


def _groups(mesh: TriMesh) -> Int32[np.ndarray, " m"]:
    """Return one number for each pair of material and provenance."""
    groups = np.zeros(len(mesh.faces), dtype=np.int32)
    if mesh.face_material is not None:
        groups += len(Provenance) * mesh.face_material.astype(np.int32)
    if mesh.face_provenance is not None:
        groups += mesh.face_provenance
    return groups


def denoise(mesh: TriMesh, max_move_m: float) -> TriMesh:
    """Smooth the normals of flat or gently curved surfaces and preserve edges.

    Face normals are filtered bilaterally (Zheng et al. 2011, doi:10.1109/TVCG.2010.264), then
    vertices move until the faces have those normals (Sun et al. 2007, doi:10.1109/TVCG.2007.1065).

    Args:
        mesh: faces of roughly equal size (marching cubes).
        max_move_m: largest motion of a vertex.
    """
    if len(mesh.faces) == 0:
        return mesh
    points = mesh.vertices.astype(np.float64)
    faces = mesh.faces.astype(np.int64)
    start, members = faces_by_vertex(faces, len(points))
    near = neighbour_faces(faces, start, members)
    # The weight of a neighbour falls to 1/sqrt(e) at a difference of unit normals of 0.4 (23
    # degrees). The sensitivity to this value and to the rounds (4 and 12) is not measured.
    normals = filter_normals(points, faces, *near, 4, 0.4)
    moved = fit_vertices(points, faces, start, members, normals, 12)
    way = moved - points
    length = np.linalg.norm(way, axis=1, keepdims=True)
    way *= np.minimum(1.0, max_move_m / np.maximum(length, 1e-9))
    return replace(mesh, vertices=(points + way).astype(np.float32))
