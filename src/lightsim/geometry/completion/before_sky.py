"""Measured surface that pictures show to be sky.

Beams lie far apart in the distance, and a field's samples, too: between a mast and its wires, or
around a traffic light on its arm, a web of surface is spanned, which throws a shadow and, seen from
beside the path or under another sun, shines before the sky. Nothing stands where several views show
sky (silhouette carving, Laurentini 1994, doi:10.1109/34.273735).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from trimesh.remesh import subdivide_to_size

from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views
from lightsim.geometry.surface import drop_floaters

# Lower surface is before the sky in no camera's picture.
_LEAST_HEIGHT_M = 2.0
# Edges of what is kept or dropped.
_EDGE_M = 0.3
# Views from further away do not count.
_MAX_VIEW_M = 90.0
# A view shows a place if nothing is this far before it.
_BEFORE_M = 0.3
# Views that must show sky, and of these how many that show matter outweigh one: what they show may
# stand behind.
_LEAST_VIEWS, _MATTER = 2, 0.5
# What a round uncovers, the next one looks at: a web has two sides.
_MOST_ROUNDS = 4
# Connected pieces of what is left that are smaller than this go, too.
_MIN_PIECE_M2 = 0.25


def without_sky(
    mesh: TriMesh,
    silhouettes: Iterable[View],
    ground: GroundMap,
    make_caster: MakeCaster,
) -> TriMesh:
    """A measured surface without what views show to be sky; faces that lose a part are split.

    Args:
        mesh: static, frame world.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
        ground: heights count from it.

    Raises:
        InputError: a matte does not fit its camera.
    """
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    is_high = centres[:, 2] - ground.look_up(centres[:, :2]) > _LEAST_HEIGHT_M
    views = list(classified_views(silhouettes))
    places, face = _places(mesh, np.flatnonzero(is_high))
    is_sky = np.zeros(len(places), dtype=bool)
    kept = mesh
    for _ in range(_MOST_ROUNDS):
        rows = np.flatnonzero(~is_sky)
        new = rows[_is_denied(places[rows].mean(axis=1), views, make_caster([kept]))]
        if not len(new):
            break
        is_sky[new] = True
        kept = _dropped(mesh, places, face, is_sky)
    return kept


def _places(
    mesh: TriMesh, rows: Int64[np.ndarray, " k"]
) -> tuple[Float64[np.ndarray, "n 3 3"], Int64[np.ndarray, " n"]]:
    """Small triangles that faces consist of, and which faces these are."""
    vertices, faces, *index = subdivide_to_size(
        mesh.vertices.astype(np.float64), mesh.faces[rows], _EDGE_M, return_index=True
    )
    return vertices[faces], rows[index[0]]


def _is_denied(
    points: Float64[np.ndarray, "n 3"], views: Sequence[ClassifiedView], caster: RayCaster
) -> Bool[np.ndarray, " n"]:
    """Whether so many views show sky where a point is."""
    sky, matter = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        sky[_shown(points, view, caster, 1)] += 1
    rows = np.flatnonzero(sky >= _LEAST_VIEWS)
    for view in views:
        matter[rows[_shown(points[rows], view, caster, -1)]] += 1
    return (sky >= _LEAST_VIEWS) & (sky > _MATTER * matter)


def _shown(
    points: Float64[np.ndarray, "n 3"], view: ClassifiedView, caster: RayCaster, kind: int
) -> Int64[np.ndarray, " k"]:
    """Points where a view shows such a pixel, and which nothing hides from it."""
    frame, camera, kinds = view
    eye = frame.world_from_camera.translation_m
    rows = np.flatnonzero(np.linalg.norm(points - eye, axis=1) < _MAX_VIEW_M)
    uv, is_inside = frame.project(camera, points[rows])
    rows, uv = rows[is_inside], uv[is_inside]
    rows = rows[kinds[uv[:, 1].astype(np.int64), uv[:, 0].astype(np.int64)] == kind]
    way = points[rows] - eye
    distance = np.linalg.norm(way, axis=1)
    hits = caster.intersect(np.broadcast_to(eye, way.shape).copy(), way / distance[:, None])
    return rows[hits.distance_m > distance - _BEFORE_M]


def _dropped(
    mesh: TriMesh,
    places: Float64[np.ndarray, "n 3 3"],
    face: Int64[np.ndarray, " n"],
    is_sky: Bool[np.ndarray, " n"],
) -> TriMesh:
    """The mesh with what is left of the faces that have lost places."""
    is_cut = np.zeros(len(mesh.faces), dtype=bool)
    is_cut[face[is_sky]] = True
    rest = np.flatnonzero(is_cut[face] & ~is_sky)
    # Corners of the faces stay the vertices that they were: doubled ones are sharp edges.
    corners = places[rest].astype(np.float32)
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
    # What is left of wires, mostly.
    return drop_floaters(cut, _MIN_PIECE_M2, is_cut[from_face])
