"""Remove measured surface where images show sky.

Far from the path the field's samples are coarse, so the extracted mesh has false surface between a
mast and its wires, or around a traffic light on its arm. It casts a shadow, and occludes the sky in
novel views. No surface can lie where several views show sky (silhouette carving, Laurentini 1994,
doi:10.1109/34.273735).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from trimesh.remesh import subdivide_to_size

from lightsim.core.casting import MakeCaster
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.view_evidence import (
    WALL_VIEW_M,
    ViewEvidence,
    log_odds_of_views,
)
from lightsim.geometry.surface import drop_floaters

# The values below were chosen on log 002; their joint effect was measured there, sensitivity was
# not.

# Height above the ground below which no surface is tested, in metres: cameras see it from above,
# against other surfaces.
_MIN_HEIGHT_M = 2.0
# Greatest edge of the triangles that are retained or removed, in metres.
_EDGE_M = 0.3
# Least number of views that must show sky.
_MIN_VIEWS = 2
# Iterations of carving: false surface has several layers, and each iteration exposes the next one.
_MAX_ROUNDS = 4
# Remaining connected pieces smaller than this area are removed too, in square metres.
_MIN_PIECE_M2 = 0.25


def remove_before_sky(
    mesh: TriMesh,
    evidence: ViewEvidence,
    ground: GroundMap,
    make_caster: MakeCaster,
) -> TriMesh:
    """Remove the parts of a measured surface where views show sky; partly removed faces are split.

    Args:
        mesh: static surface, frame world.
        evidence: the views of the log.
        ground: reference of heights.
        make_caster: builds the ray caster.

    Returns:
        The remaining mesh, frame world.

    Raises:
        InputError: a matte does not fit its camera.
    """
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    is_high = centres[:, 2] - ground.look_up(centres[:, :2]) > _MIN_HEIGHT_M
    triangles, face = _subdivided(mesh, np.flatnonzero(is_high))
    is_sky = np.zeros(len(triangles), dtype=bool)
    kept = mesh
    for _ in range(_MAX_ROUNDS):
        rows = np.flatnonzero(~is_sky)
        middle = triangles[rows].mean(axis=1)
        surface_views, sky = evidence.count(middle, make_caster([kept]), WALL_VIEW_M)
        new = rows[(sky >= _MIN_VIEWS) & (log_odds_of_views(surface_views, sky) < 0)]
        if not len(new):
            break
        is_sky[new] = True
        kept = _without_sky(mesh, triangles, face, is_sky)
    return kept


def _subdivided(
    mesh: TriMesh, rows: Int64[np.ndarray, " k"]
) -> tuple[Float64[np.ndarray, "n 3 3"], Int64[np.ndarray, " n"]]:
    """Split faces into small triangles; return these and the row of the face of each."""
    vertices, faces, *index = subdivide_to_size(
        mesh.vertices.astype(np.float64), mesh.faces[rows], _EDGE_M, return_index=True
    )
    return vertices[faces], rows[index[0]]


def _without_sky(
    mesh: TriMesh,
    triangles: Float64[np.ndarray, "n 3 3"],
    face: Int64[np.ndarray, " n"],
    is_sky: Bool[np.ndarray, " n"],
) -> TriMesh:
    """Return the mesh without the triangles at which views show sky."""
    is_cut = np.zeros(len(mesh.faces), dtype=bool)
    is_cut[face[is_sky]] = True
    rest = np.flatnonzero(is_cut[face] & ~is_sky)
    # Original corners retain their vertices: duplicate vertices mark sharp edges.
    corners = triangles[rest].astype(np.float32)
    old = mesh.faces[face[rest]]
    is_old = (corners[:, :, None] == mesh.vertices[old][:, None]).all(axis=3)
    new, number = np.unique(corners[~is_old.any(axis=2)], axis=0, return_inverse=True)
    faces = np.take_along_axis(old, is_old.argmax(axis=2), axis=1)
    faces[~is_old.any(axis=2)] = len(mesh.vertices) + number.reshape(-1)
    from_face = np.concatenate([np.flatnonzero(~is_cut), face[rest]])
    cut = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, new]),
        faces=np.concatenate([mesh.faces[~is_cut], faces]),
        base_colour=np.concatenate([mesh.base_colour, np.zeros_like(new)]),
        face_material=None if mesh.face_material is None else mesh.face_material[from_face],
        face_provenance=None if mesh.face_provenance is None else mesh.face_provenance[from_face],
    )
    # Small remaining components are mostly fragments of false surface at wires.
    return drop_floaters(cut, _MIN_PIECE_M2, is_cut[from_face])
