"""Reader of Wavefront OBJ: polygons as triangles, vertex colours, materials and textures of MTL.

`obj_text` parses the text and `mtl` the materials; `obj_materials` loads the pictures.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.colour import linear_from_srgb
from lightsim.errors import InputError
from lightsim.store.notes import Notes
from lightsim.store.obj_materials import ObjLook, looks_of
from lightsim.store.obj_text import ObjText, parse_obj
from lightsim.store.polygons import triangulate
from lightsim.store.primitives import MAX_PRIMITIVES, MAX_VERTICES, ModelFile, Primitive
from lightsim.store.reading import read_bytes

# Largest size of an .obj file, in bytes: some five million faces, whose parsing takes about a
# minute and 4 GB.
_MAX_BYTES = 512 << 20
# Statements of free-form curves and surfaces.
_FREE_FORM = frozenset((
    "vp", "cstype", "deg", "bmat", "step", "curv", "curv2", "surf", "parm", "trim", "hole", "scrv",
    "sp", "end", "con", "bzp", "bsp", "cdc", "cdp", "res",
))  # fmt: skip


def read_obj(path: Path) -> ModelFile:
    """Return the triangles of an .obj file, with notes on ignored statements.

    Corners of faces become one vertex if position, texture coordinates, normal, smoothing group and
    material are equal. The normals themselves are not used.

    Raises:
        InputError: the file is missing, damaged or too large, or has no triangles.
    """
    notes = Notes()
    try:
        text = parse_obj(read_bytes(path, "model", _MAX_BYTES))
        _note_unread(text, notes)
        primitives = _primitives(path, text, notes)
    except ValueError as error:
        raise InputError(
            "the model cannot be read",
            where=path,
            got=error,
            expected="Wavefront OBJ text",
            remedy="Export it again as .obj or .glb.",
        ) from error
    return ModelFile(path, tuple(primitives), notes.sentences())


def _note_unread(text: ObjText, notes: Notes) -> None:
    for keyword, count in text.unread.items():
        if keyword in _FREE_FORM:
            notes.add(
                "free-form curves and surfaces are not read: convert them to polygons", keyword
            )
        elif keyword in ("l", "p"):
            notes.add("lines and points are not read", f"{count} x {keyword}")
        else:
            notes.add("statements that are not read", f"{count} x {keyword}")


def _primitives(path: Path, text: ObjText, notes: Notes) -> list[Primitive]:
    if text.corner_counts.sum() > MAX_VERTICES:
        raise ValueError(f"its faces have more than {MAX_VERTICES} corners")
    if (text.corner_counts < 3).any():
        notes.add(f"{int((text.corner_counts < 3).sum())} faces of one or two corners are left out")
    triangles, face, n_approximated = triangulate(
        text.positions[text.corners[:, 0]], text.corner_counts
    )
    if not len(triangles):
        raise InputError(
            "the model has no triangles",
            where=path,
            got=f"{len(text.positions)} vertices and {len(text.corner_counts)} faces",
            expected="faces (f) of three corners or more",
            remedy="A point cloud needs a surface first, such as MeshLab or Open3D reconstruct."
            if len(text.positions)
            else "Check that it is an OBJ file, or export it as .glb.",
        )
    if n_approximated:
        notes.add(f"{n_approximated} polygons cross themselves and may be filled wrongly")
    lines, names = [line for line, _ in text.materials], [name for _, name in text.materials]
    # A face before the first `usemtl` has statement -1, which indexes the last entry: no material.
    statement = np.searchsorted(np.array(lines, np.int64), text.face_lines) - 1
    distinct = list(dict.fromkeys(names))
    number = {name: n for n, name in enumerate(distinct)}
    of_statement = np.array([*(number[name] for name in names), -1], np.int64)
    of_face = of_statement[statement]
    numbers = np.unique(of_face)
    if len(numbers) > MAX_PRIMITIVES:
        raise ValueError(f"its faces have more than {MAX_PRIMITIVES} materials")
    used = [distinct[n] if n >= 0 else None for n in numbers.tolist()]
    colours = _vertex_colours(text.colours)
    looks = looks_of(path, text.libraries, used, notes, has_vertex_colours=colours is not None)
    corners = np.concatenate([text.corners, _smoothing(text)[:, None]], axis=1)
    of_triangle = of_face[face]
    # Stable, so that triangles of a material have the order of the file.
    order = np.argsort(of_triangle, kind="stable")
    groups = np.split(order, np.searchsorted(of_triangle[order], numbers)[1:])
    return [
        part
        for name, chosen in zip(used, groups, strict=True)
        if len(chosen)
        for part in _parts(text, corners[triangles[chosen]], looks[name], colours, notes)
    ]


def _smoothing(text: ObjText) -> Int64[np.ndarray, " c"]:
    """Return a key for each corner; corners with different keys become different vertices.

    The key depends on the smoothing group of corners without a normal; it is 0 in files without
    smoothing statements.
    """
    group_of_face = np.zeros(len(text.face_lines), np.int64)
    if text.smoothing:
        lines, groups = np.array(text.smoothing, np.int64).T
        statement = np.searchsorted(lines, text.face_lines) - 1
        # Each face without smoothing is a group of its own, with a key below 0.
        own = -2 - np.arange(len(text.face_lines))
        group_of_face = np.where(statement < 0, np.int64(0), groups[statement])
        group_of_face = np.where((statement >= 0) & (group_of_face == 0), own, group_of_face)
    group = np.repeat(group_of_face, text.corner_counts)
    return np.where(text.corners[:, 2] >= 0, 0, group)


def _vertex_colours(
    written: Float64[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n 3"] | None:
    """Return linear vertex colours, white for vertices without colour; None if all have none.

    MeshLab, ZBrush and Blender write sRGB, in [0, 1] or as bytes.
    """
    is_there: Bool[np.ndarray, " n"] = np.all(np.isfinite(written), axis=1)
    if not is_there.any():
        return None
    scale = 255.0 if np.nanmax(written) > 1.0 else 1.0
    srgb = np.where(np.expand_dims(is_there, 1), np.clip(written / scale, 0.0, 1.0), 1.0)
    return linear_from_srgb(srgb).astype(np.float32)


def _parts(
    text: ObjText,
    corners: Int64[np.ndarray, "m 3 4"],
    look: ObjLook,
    colours: Float32[np.ndarray, "n 3"] | None,
    notes: Notes,
) -> list[Primitive]:
    """Return the triangles of one material: with texture, and without texture coordinates."""
    if look.texture is None:
        corners = corners.copy()
        corners[..., 1] = -1
        return [_primitive(text, corners, look, colours)]
    has_uv = (corners[..., 1] >= 0).all(axis=1)
    found = [_primitive(text, corners[has_uv], look, colours)] if has_uv.any() else []
    if not has_uv.all():
        notes.add(
            "faces without texture coordinates show the texture's mean colour", look.material.name
        )
        found.append(_primitive(text, corners[~has_uv], look.without_texture(), colours))
    return found


def _primitive(
    text: ObjText,
    corners: Int64[np.ndarray, "m 3 4"],
    look: ObjLook,
    colours: Float32[np.ndarray, "n 3"] | None,
) -> Primitive:
    vertex, faces = _shared(corners.reshape(-1, 4))
    colour = np.tile(look.tint(has_vertex_colours=colours is not None), (len(vertex), 1))
    if colours is not None:
        colour *= colours[vertex[:, 0]]
    uv = None
    if look.texture is not None:
        uv = text.uv[vertex[:, 1]] * look.uv_scale + look.uv_offset
        # OBJ counts v from the bottom, `Primitive` from the top.
        uv[:, 1] = 1.0 - uv[:, 1]
    alpha = None if look.alpha == 1 else np.full(len(vertex), look.alpha, np.float32)
    return Primitive(
        text.positions[vertex[:, 0]], faces.reshape(-1, 3).astype(np.int32), colour, uv,
        look.texture, look.material, alpha_mode=look.alpha_mode, alpha=alpha,
    )  # fmt: skip


def _shared(
    corners: Int64[np.ndarray, "c 4"],
) -> tuple[Int64[np.ndarray, "v 4"], Int64[np.ndarray, " c"]]:
    """Return the distinct rows, and for each corner the index of its row."""
    key = np.zeros(len(corners), np.int64)
    for column in corners.T:
        # Combine two columns at a time: `np.unique` of rows takes ten times as long.
        values, number = np.unique(column, return_inverse=True)
        key = np.unique(key * len(values) + number, return_inverse=True)[1].reshape(-1)
    _, first = np.unique(key, return_index=True)
    return corners[first], key
