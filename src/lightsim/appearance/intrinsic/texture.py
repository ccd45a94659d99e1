"""Division of a texture's radiance by the light at each texel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8
from scipy.spatial import KDTree

from lightsim.appearance.atlas import texel_parts
from lightsim.appearance.intrinsic.edges import LabelField, ShadedPoints, refine_visibility
from lightsim.appearance.intrinsic.light import SurfaceLight, diffuse_part
from lightsim.core.mesh import Texture, TriMesh

# Texels processed together: some 50 MB of intermediate results for any log.
_CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class VertexLight:
    """Light at a mesh's vertices, and the estimated sun visibility there."""

    light: SurfaceLight
    visibility: Float32[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class DeepShade:
    """Weights of the quotient of radiance and light, and its replacement where light is weak.

    Args:
        quotient_weight: weight of the quotient, in [0, 1].
        fill: replacement base colour, linear RGB.
    """

    quotient_weight: Float64[np.ndarray, " n"]
    fill: Float64[np.ndarray, "n 3"]

    def blended(self, colour: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return the weighted mean of the quotient `colour` and the fill, linear RGB."""
        quotient_weight = self.quotient_weight[:, None]
        return quotient_weight * colour + (1.0 - quotient_weight) * self.fill

    def where(
        self, chosen: Bool[np.ndarray, " n"], most: float, fill: Float64[np.ndarray, "n 3"]
    ) -> DeepShade:
        """Replace the fill, and limit the quotient's weight to `most`, at the chosen points."""
        quotient_weight = np.where(
            chosen, np.minimum(self.quotient_weight, most), self.quotient_weight
        )
        return DeepShade(quotient_weight, np.where(chosen[:, None], fill, self.fill))

    def between(
        self, corners: Int32[np.ndarray, "t 3"], barycentric: Float32[np.ndarray, "t 3"]
    ) -> DeepShade:
        """Interpolate at points inside triangles."""
        fill = (barycentric[:, :, None] * self.fill[corners]).sum(axis=1)
        return DeepShade((barycentric * self.quotient_weight[corners]).sum(axis=1), fill)


def texture_without_light(
    mesh: TriMesh,
    texture: Texture,
    found: VertexLight,
    field: LabelField | None,
    limits: tuple[float, float],
    shade: DeepShade | None = None,
) -> tuple[Texture, UInt8[np.ndarray, "h w"]]:
    """Divide a texture of radiance by the light at each texel; also return the sun visibility.

    Light is interpolated between the vertices. Visibility is estimated at each texel of faces near
    a shadow edge, and interpolated elsewhere or without `field`.

    Args:
        mesh: mesh of `texture`.
        limits: least and greatest base colour.
        shade: weights and fill at the vertices; None: weight 1 everywhere.

    Returns:
        The texture of base colour, and the sun visibility of each texel in 255ths.
    """
    vertices = ShadedPoints.vertices_of(mesh, found.light)
    is_edge = np.zeros(len(mesh.faces), dtype=bool)
    if field is not None:
        is_edge[field.faces] = edge_faces(mesh, field)
    image = texture.image.reshape(-1, 3).copy()
    found_visibility = np.zeros(len(image), dtype=np.uint8)
    for texels in texel_parts(texture, _CHUNK):
        face, pixel, barycentric = texels.face, texels.pixel, texels.barycentric
        corners = mesh.faces[face]
        seen = vertices.between(corners, barycentric, image[pixel])
        visibility = (barycentric * found.visibility[corners]).sum(axis=1)
        rows = np.flatnonzero(is_edge[face])
        if field is not None and len(rows):
            visibility[rows] = refine_visibility(field, seen.at(rows))
        found_visibility[pixel] = in_255ths(visibility)
        open_part = np.clip(visibility, 0.0, 1.0)[:, None]
        light = seen.diffuse + open_part * seen.direct
        diffuse = diffuse_part(seen.radiance, seen.reflected + open_part * seen.reflected_sun)
        colour = np.clip(diffuse / np.maximum(light, 1e-6), *limits)
        if shade is not None:
            colour = shade.between(corners, barycentric).blended(colour)
        image[pixel] = colour
    shape = texture.image.shape
    return Texture(image.reshape(shape), texture.corner_uv), found_visibility.reshape(shape[:2])


def in_255ths(visibility: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Return a fraction in [0, 1] times 255, rounded."""
    return np.rint(255 * np.clip(visibility, 0.0, 1.0)).astype(np.uint8)


def edge_faces(mesh: TriMesh, field: LabelField) -> Bool[np.ndarray, " k"]:
    """Return the mask of labelled faces near a surfel at a shadow edge."""
    mixed = field.tree.data[field.is_mixed]
    is_edge = np.zeros(len(field.faces), dtype=bool)
    if len(mixed) == 0:
        return is_edge
    tree = KDTree(mixed)
    for start in range(0, len(is_edge), _CHUNK):
        part = slice(start, start + _CHUNK)
        corners = mesh.vertices[mesh.faces[field.faces[part]]]
        centre = corners.mean(axis=1)
        radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
        is_edge[part] = np.asarray(tree.query(centre)[0]) < radius + 1.5 * field.surfel_m
    return is_edge
