"""Fewer triangles for the same surface, and surfaces without the noise of their normals."""

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

_MAX_ROUNDS = 40
_NORMAL_ROUNDS, _VERTEX_ROUNDS = 4, 12
_NORMAL_SPREAD = 0.4
"""Difference of unit normals at which a neighbour's weight falls to 1/sqrt(e)."""
_PLANAR_ERROR_M = 0.01
_WORTHWHILE = 1e-2
"""A round that removes a smaller part of the vertices is the last."""


def simplify(
    mesh: TriMesh,
    max_error_m: Float[np.ndarray, " n"],
    max_edge_m: Float[np.ndarray, " n"],
) -> TriMesh:
    """Collapse edges while the surface stays within an error (Garland & Heckbert 1997,
    doi:10.1145/258734.258849).

    The error is the area-weighted RMS distance of a vertex from the planes it stands for. Holes
    do not open: every collapse meets the link condition, none turns a face by more than 60
    degrees. Borders, and lines where materials or provenances meet, keep their course within the
    error.
    Colours, texture and confidence are not carried over: simplify before colouring.

    Args:
        mesh: any triangles; vertices where more than two faces share an edge stay.
        max_error_m: bound at each vertex.
        max_edge_m: no edge is made longer than this.

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
    for _ in range(_MAX_ROUNDS):
        start, members = faces_by_vertex(faces, len(points))
        edges, fractions, kind = list_edges(faces, groups, start, members)
        cost, place = edge_costs(points, edges, fractions, kind, quadrics, weight, error, edge)
        order = np.flatnonzero(np.isfinite(cost))
        order = order[np.argsort(cost[order], kind="stable")]
        done = collapse_round(
            points, faces, groups, start, members, edges, fractions, cost, place, order,
            quadrics, weight, error, edge,
        )  # fmt: skip
        alive = faces[:, 0] >= 0
        faces, groups = faces[alive], groups[alive]
        remaining -= done
        if done < _WORTHWHILE * remaining:
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
    """`simplify` with one bound on the error: for surfaces that were drawn cell by cell."""
    if len(mesh.faces) == 0:
        return mesh
    count = len(mesh.vertices)
    return simplify(mesh, np.full(count, _PLANAR_ERROR_M), np.full(count, edge_m, dtype=np.float64))


def _groups(mesh: TriMesh) -> Int32[np.ndarray, " m"]:
    """One number for each pair of material and provenance."""
    groups = np.zeros(len(mesh.faces), dtype=np.int32)
    if mesh.face_material is not None:
        groups += len(Provenance) * mesh.face_material.astype(np.int32)
    if mesh.face_provenance is not None:
        groups += mesh.face_provenance
    return groups


def denoise(mesh: TriMesh, max_move_m: float) -> TriMesh:
    """Smooth normals on what is flat or gently curved, keep edges.

    Face normals are filtered bilaterally (Zheng et al. 2011, doi:10.1109/TVCG.2010.264), then
    vertices move until the faces have those normals (Sun et al. 2007,
    doi:10.1109/TVCG.2007.1065), none further than a bound.

    Args:
        mesh: of roughly equal faces (marching cubes).
        max_move_m: bound on each vertex's way.
    """
    if len(mesh.faces) == 0:
        return mesh
    points = mesh.vertices.astype(np.float64)
    faces = mesh.faces.astype(np.int64)
    start, members = faces_by_vertex(faces, len(points))
    near = neighbour_faces(faces, start, members)
    normals = filter_normals(points, faces, *near, _NORMAL_ROUNDS, _NORMAL_SPREAD)
    moved = fit_vertices(points, faces, start, members, normals, _VERTEX_ROUNDS)
    way = moved - points
    length = np.linalg.norm(way, axis=1, keepdims=True)
    way *= np.minimum(1.0, max_move_m / np.maximum(length, 1e-9))
    return replace(mesh, vertices=(points + way).astype(np.float32))
