"""Conversion of a model file's primitives to one mesh with vertex colours and opaque surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32

from lightsim.core.mesh import CAR_GLASS, Material, TriMesh
from lightsim.errors import InputError
from lightsim.store.alpha_shapes import (
    BLEND_CUTOFF,
    INVISIBLE_ALPHA,
    OPAQUE_ALPHA,
    Patch,
    areas,
    chosen,
    cut,
    glass_colour,
    near_contour,
    panes,
    shrink_unresolved,
)
from lightsim.store.notes import Notes
from lightsim.store.primitives import (
    Y_UP_FROM_Z_UP,
    AlphaMode,
    ModelFile,
    Primitive,
    group_materials,
)
from lightsim.store.rejoin import rejoin
from lightsim.store.subdivide import Choice, longer_than, split_edges
from lightsim.store.texture_sampling import sample_channel, sample_colour

# Largest number of faces of a model after its triangles are split.
_MAX_FACES = 1_000_000
# Factor by which edges across the contour of a mask are shorter than others: 1 cm at the default of
# 6 cm, since leaves of trees and letters of signs measure some centimetres. Chosen; sensitivity not
# measured.
_FINE_EDGES = 6
# Least transmission of a surface that is read as a pane of glass. Chosen; sensitivity not measured.
_CLEAR = 0.5
# Largest difference of alpha on a surface that is treated as constant: rounding of vertex colours.
_EVEN = 1e-3


class _Columns:
    """Columns of a patch's values."""

    POSITION = slice(0, 3)
    UV = slice(3, 5)
    COLOUR = slice(5, 8)
    ALPHA = 8


@dataclass(frozen=True, eq=False)
class _Part:
    vertices: Float64[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    colour: Float32[np.ndarray, "n 3"]
    material: Material


def mesh_of(
    model: ModelFile, frame: str = "actor", texture_edge_m: float = 0.06
) -> tuple[TriMesh, tuple[str, ...]]:
    """Join the primitives of a model file (y up) to one mesh in `frame` (z up, same x axis).

    A file that `meshes.write_glb` wrote retains its texture and vertices. In other files, a
    textured triangle is split until no edge is longer than `texture_edge_m` (at most a million
    faces); then the texture is sampled at the vertices, in linear light. Masked surfaces are cut
    along their contour, panes become dark glass.

    Args:
        model: result of `read_gltf` or `read_obj`.
        frame: name of the mesh's frame.
        texture_edge_m: longest edge of textured triangles, in units of the file (metres, if its
            unit is the metre).

    Returns:
        The mesh in units of the file; the notes of the file and of this conversion.

    Raises:
        InputError: a file that LightSim wrote is damaged, or the model has no visible surface.
    """
    try:
        mesh = rejoin(model.primitives, frame)
    except ValueError as error:
        raise InputError(
            "the mesh is damaged", where=model.path, got=error, remedy="Write or copy it again."
        ) from error
    if mesh is not None:
        return mesh, model.notes
    notes = Notes()
    budgets = _budgets(model.primitives)
    parts = [
        part
        for primitive, budget in zip(model.primitives, budgets, strict=True)
        for part in _parts(primitive, texture_edge_m, budget, notes)
        if len(part.faces)
    ]
    if not parts:
        raise InputError(
            "the model has no visible surface",
            where=model.path,
            got="an alpha below the cutoff or near 0 everywhere",
            expected="visible surfaces",
            remedy="Export it with opaque materials.",
        )
    return _joined(parts, frame), (*model.notes, *notes.sentences())


def _joined(parts: Sequence[_Part], frame: str) -> TriMesh:
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + np.int32(o) for part, o in zip(parts, offsets, strict=True)]
    # Points are rows, so this product applies the inverse rotation: y up becomes z up.
    vertices = np.concatenate([part.vertices for part in parts]) @ Y_UP_FROM_Z_UP[:3, :3]
    colour = np.clip(np.concatenate([part.colour for part in parts]), 0.0, 1.0)
    counts = [len(part.faces) for part in parts]
    materials, face_material = group_materials([part.material for part in parts], counts)
    return TriMesh(
        frame,
        vertices.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        colour.astype(np.float32),
        materials,
        face_material,
    )


def _budgets(primitives: Sequence[Primitive]) -> list[int]:
    """Return the largest number of faces of each primitive after splitting.

    It is the number of its own faces, and a part of the remaining budget in proportion to its area.
    """
    own = np.array([len(p.faces) for p in primitives])
    area = np.array([areas(_patch(p)).sum() if _is_split(p) else 0.0 for p in primitives])
    left = max(_MAX_FACES - int(own.sum()), 0)
    fraction = area / area.sum() if area.sum() > 0 else area
    return [int(n) for n in own + np.floor(left * np.nan_to_num(fraction))]


def _is_split(primitive: Primitive) -> bool:
    has_texture = primitive.texture is not None and primitive.uv is not None
    return has_texture or (primitive.alpha_mode is not AlphaMode.OPAQUE and not _is_even(primitive))


def _is_even(primitive: Primitive) -> bool:
    """Return whether alpha is the same on the whole surface."""
    texture = primitive.texture
    if texture is not None and primitive.uv is not None and texture.pixels.shape[2] == 4:
        return False
    return primitive.alpha is None or bool(np.ptp(primitive.alpha) < _EVEN)


def _patch(primitive: Primitive) -> Patch:
    n = len(primitive.vertices)
    uv = np.zeros((n, 2)) if primitive.uv is None else primitive.uv
    alpha = np.ones(n) if primitive.alpha is None else primitive.alpha
    columns = [primitive.vertices, uv, primitive.colour, alpha[:, None]]
    return Patch(np.concatenate(columns, axis=1), primitive.faces)


def _parts(primitive: Primitive, edge: float, most_faces: int, notes: Notes) -> list[_Part]:
    """Return the visible surfaces of a primitive."""
    name = primitive.material.name
    patch = _patch(primitive)
    if primitive.transmission >= _CLEAR:
        return [_glass(primitive, patch, 1.0 - primitive.transmission, notes)]
    if primitive.transmission > 0:
        notes.add("transmission below one half is read as opaque", name)
    if primitive.alpha_mode is AlphaMode.OPAQUE:
        return [_textured(primitive, patch, edge, most_faces, notes)]
    is_mask = primitive.alpha_mode is AlphaMode.MASK
    if not _is_even(primitive):
        return _uneven(primitive, patch, edge, most_faces, notes)
    alpha = float(patch.values[0, _Columns.ALPHA])
    if (is_mask and alpha < primitive.alpha_cutoff) or (not is_mask and alpha <= INVISIBLE_ALPHA):
        notes.add("invisible surfaces are left out", name)
        return []
    if is_mask or alpha >= OPAQUE_ALPHA:
        if alpha < 1 - INVISIBLE_ALPHA and not is_mask:
            notes.add(f"surfaces with an alpha of {OPAQUE_ALPHA} or more are read as opaque", name)
        return [_textured(primitive, patch, edge, most_faces, notes)]
    return [_glass(primitive, patch, alpha, notes)]


def _uneven(
    primitive: Primitive, patch: Patch, edge: float, most_faces: int, notes: Notes
) -> list[_Part]:
    """Convert a surface of varying alpha: panes become glass, the rest is cut along the contour."""

    def alpha(values: Float64[np.ndarray, "k c"]) -> Float64[np.ndarray, " k"]:
        if primitive.texture is None or primitive.uv is None:
            return values[:, _Columns.ALPHA]
        of_texture = sample_channel(primitive.texture, values[:, _Columns.UV], 3)
        return values[:, _Columns.ALPHA] * of_texture

    is_mask = primitive.alpha_mode is AlphaMode.MASK
    cutoff = primitive.alpha_cutoff if is_mask else BLEND_CUTOFF
    fine = edge / _FINE_EDGES
    patch, is_fine = _split(patch, near_contour(alpha, cutoff, edge, fine), most_faces, notes)
    parts: list[_Part] = []
    # The limit of faces was reached before the faces resolved the contour.
    if not is_fine:
        patch, shrunk = shrink_unresolved(patch, alpha, cutoff, fine)
        parts.append(_coloured(primitive, shrunk))
    at_vertex = alpha(patch.values)
    is_pane = np.zeros(len(patch.faces), bool) if is_mask else panes(patch, at_vertex)
    if is_pane.any():
        pane = chosen(patch, is_pane)
        parts.append(_glass(primitive, pane, float(alpha(pane.values).mean()), notes))
    rest = Patch(patch.values, patch.faces[~is_pane])
    is_cut = bool((at_vertex[rest.faces] < cutoff).any())
    if is_cut and not is_mask:
        notes.add(
            f"blended surfaces are cut where their alpha is {cutoff}", primitive.material.name
        )
    rest = cut(rest, at_vertex, cutoff) if is_cut else rest
    return [*parts, _coloured(primitive, rest)]


def _textured(
    primitive: Primitive, patch: Patch, edge: float, most_faces: int, notes: Notes
) -> _Part:
    if primitive.texture is not None and primitive.uv is not None:
        patch, _ = _split(patch, longer_than(edge), most_faces, notes)
    return _coloured(primitive, patch)


def _split(patch: Patch, choice: Choice, most_faces: int, notes: Notes) -> tuple[Patch, bool]:
    """Split the edges that `choice` selects; return whether the limit of faces sufficed."""
    values, faces, is_fine = split_edges(patch.values, patch.faces, choice, most_faces)
    if not is_fine:
        notes.add(f"textures and contours are coarser than requested, within {_MAX_FACES} faces")
    return Patch(values, faces), is_fine


def _coloured(primitive: Primitive, patch: Patch) -> _Part:
    """Sample the texture of a patch at its vertices."""
    vertices = patch.values[:, _Columns.POSITION]
    return _Part(vertices, patch.faces, _colour(primitive, patch), primitive.material)


def _glass(primitive: Primitive, patch: Patch, alpha: float, notes: Notes) -> _Part:
    notes.add("transparent surfaces are read as dark glass", primitive.material.name)
    colour = glass_colour(_colour(primitive, patch), alpha)
    return _Part(patch.values[:, _Columns.POSITION], patch.faces, colour, CAR_GLASS)


def _colour(primitive: Primitive, patch: Patch) -> Float32[np.ndarray, "n 3"]:
    colour = patch.values[:, _Columns.COLOUR].astype(np.float32)
    if primitive.texture is None or primitive.uv is None:
        return colour
    uv, is_by_alpha = patch.values[:, _Columns.UV], primitive.alpha_mode is not AlphaMode.OPAQUE
    return colour * sample_colour(primitive.texture, uv, is_by_alpha=is_by_alpha)
