"""Parts of a model file as its reader returns them, before they become one mesh.

The readers of glTF and OBJ both return these; `primitive_mesh.mesh_of` joins them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from lightsim.core.mesh import Material

Y_UP_FROM_Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]], dtype=np.float64
)
"""Axes of files from ours: x stays, our z becomes the file's y (up), our y becomes its -z."""
_MAX_MATERIALS = 256
"""`TriMesh.face_material` is an 8-bit number."""
_STEPS = 15
"""Steps of roughness and metallic factor, whose combinations are as many as materials may be."""


class Wrap(StrEnum):
    """Meaning of texture coordinates outside of [0, 1]."""

    REPEAT = "repeat"
    CLAMP = "clamp"
    MIRROR = "mirror"


class AlphaMode(StrEnum):
    """Meaning of alpha, as in glTF 2.0, section 3.9.4."""

    OPAQUE = "opaque"
    """Alpha is ignored."""
    MASK = "mask"
    """The surface is there where alpha is at least the cutoff, and a hole elsewhere."""
    BLEND = "blend"
    """The surface is transparent by 1 - alpha."""


@dataclass(frozen=True, eq=False)
class ImageTexture:
    """A picture on a surface.

    Args:
        pixels: 8-bit sRGB, and alpha (linear) as the fourth channel where the picture has one.
            Primitives that show the same picture share this array.
        wrap: for u and for v.
        is_nearest: colours are those of the nearest pixel instead of interpolated between pixels.
    """

    pixels: UInt8[np.ndarray, "h w _"]
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    is_nearest: bool = False


@dataclass(frozen=True, eq=False)
class Primitive:
    """Triangles of one material, placed in the scene, in the axes and units of the file.

    Args:
        vertices: positions in the scene.
        faces: vertex indices, counter-clockwise seen from outside.
        colour: linear base colour of each vertex without the texture.
        uv: texture coordinates, (0, 0) at the picture's top left, v downwards; None without
            texture.
        texture: base colour and alpha that multiply `colour` and `alpha`; None without texture.
        material: roughness, metallic factor and name.
        own: attributes whose name starts with "_", which are not part of the glTF standard.
        alpha_mode: the meaning of alpha.
        alpha: alpha of each vertex without the texture; None: 1 everywhere.
        alpha_cutoff: least alpha of the surface in mode `MASK`.
        transmission: fraction of light that passes through as through clear glass.
    """

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    colour: Float32[np.ndarray, "n 3"]
    uv: Float64[np.ndarray, "n 2"] | None
    texture: ImageTexture | None
    material: Material
    own: Mapping[str, Float32[np.ndarray, "n _"]] = field(default_factory=dict)
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    alpha: Float32[np.ndarray, " n"] | None = None
    alpha_cutoff: float = 0.5
    transmission: float = 0.0


@dataclass(frozen=True, eq=False)
class ModelFile:
    """Result of reading a model file.

    Args:
        path: the file, for messages.
        primitives: all triangles of the file; at least one primitive, each with a face or more.
        notes: what of the file was not read or read in another way, and what that changes: one
            sentence each, without the file's name; empty if every feature is honoured.
    """

    path: Path
    primitives: tuple[Primitive, ...]
    notes: tuple[str, ...] = ()


def group_materials(
    of_part: Sequence[Material], counts: Sequence[int]
) -> tuple[tuple[Material, ...], UInt8[np.ndarray, " m"] | None]:
    """Return the distinct materials and the material of each face.

    More than 256 materials lose their names and are rounded to 16 levels of roughness and of
    metallic factor, of which there are 256.

    Args:
        of_part, counts: material and number of faces of each part.
    """
    materials = tuple(dict.fromkeys(of_part))
    if len(materials) > _MAX_MATERIALS:
        of_part = [
            Material(round(m.roughness * _STEPS) / _STEPS, round(m.metallic * _STEPS) / _STEPS)
            for m in of_part
        ]
        materials = tuple(dict.fromkeys(of_part))
    if len(materials) == 1:
        return materials, None
    index = {material: i for i, material in enumerate(materials)}
    numbers = np.array([index[m] for m in of_part], dtype=np.uint8)
    return materials, np.repeat(numbers, counts)
