"""Data types of the readers of glTF and OBJ; `primitive_mesh.mesh_of` converts them to one mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from lightsim.core.mesh import Material

# Transform from LightSim's axes to axes of glTF: x is common, z becomes y (up), and y becomes -z.
Y_UP_FROM_Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]], dtype=np.float64
)
# Largest coordinate of a vertex, in units of the file: its square is a float32 number, and products
# of four coordinates are float64 numbers.
FARTHEST = 1e12
# Largest number of vertices of a model with all its instances, or of corners of its faces; the
# largest reconstructed street has half of it.
MAX_VERTICES = 20_000_000
# Largest number of primitives of a model, each mesh counted at each of its nodes, or of materials;
# so many take some seconds.
MAX_PRIMITIVES = 20_000
# Largest number of pixels of all pictures of a model; as RGBA they take a gigabyte. A model of a
# car with four pictures of 8192 x 8192 px is just accepted.
MAX_TEXTURE_PIXELS = 1 << 28
# Largest number of materials of a mesh: `TriMesh.face_material` is an 8-bit number.
_MAX_MATERIALS = 256
# Number of steps of rounded roughness and metallic factor; 16 x 16 combinations are as many as the
# largest number of materials.
_STEPS = 15


class Wrap(StrEnum):
    """Meaning of texture coordinates outside [0, 1]."""

    REPEAT = "repeat"
    CLAMP = "clamp"
    MIRROR = "mirror"


class AlphaMode(StrEnum):
    """Meaning of alpha, as in glTF 2.0, section 3.9.4."""

    OPAQUE = "opaque"
    """Alpha is ignored."""
    MASK = "mask"
    """The surface is opaque where alpha is at least the cutoff, and has holes elsewhere."""
    BLEND = "blend"
    """The fraction 1 - alpha of the light passes through the surface."""


@dataclass(frozen=True, eq=False)
class ImageTexture:
    """A picture on a surface.

    Args:
        pixels: 8-bit sRGB, with linear alpha as the fourth channel if the picture has alpha.
            Primitives with the same picture refer to one array.
        wrap: modes for u and v.
        is_nearest: sample the nearest pixel instead of interpolating between pixels.
    """

    pixels: UInt8[np.ndarray, "h w _"]
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    is_nearest: bool = False


@dataclass(frozen=True, eq=False)
class Primitive:
    """Triangles of one material, placed in the scene, in the axes and units of the file.

    Args:
        vertices: positions in the scene.
        faces: vertex indices, counter-clockwise when viewed from outside.
        colour: linear base colour of each vertex without the texture.
        uv: texture coordinates, (0, 0) at the picture's top left, v downwards; None without a
            texture.
        texture: base colour and alpha that multiply `colour` and `alpha`; None without a texture.
        material: roughness, metallic factor and name.
        own: attributes whose name starts with "_", which are not part of the glTF standard.
        alpha_mode: the meaning of alpha.
        alpha: alpha of each vertex without the texture; None if it is 1 everywhere.
        alpha_cutoff: least alpha of the surface in mode `MASK`.
        transmission: fraction of light that passes without scattering, as through clear glass.
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
        notes: features of the file that were ignored or approximated, with the effect: one sentence
            each, without the file's name; empty if all features are supported.
    """

    path: Path
    primitives: tuple[Primitive, ...]
    notes: tuple[str, ...] = ()


def group_materials(
    of_part: Sequence[Material], counts: Sequence[int]
) -> tuple[tuple[Material, ...], UInt8[np.ndarray, " m"] | None]:
    """Return the distinct materials and the material of each face.

    If there are more than 256 materials, names are removed, and roughness and metallic factor are
    rounded to 16 levels each.

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
