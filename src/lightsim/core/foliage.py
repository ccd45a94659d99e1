"""Foliage in pictures: excess green, and leaves beyond the crowns of the twin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy import ndimage

from lightsim.core.casting import RayHits
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import TriMesh
from lightsim.core.outline import nearest_of

# Name of the material class.
_FOLIAGE = "vegetation"
GREENER = 0.15
"""Least excess green of leaves, in octaves. Chosen by eye on PandaSet log 002, where it separates
trees from other surfaces; sensitivity not measured."""
# Added to linear light before the logarithm, so that noise of dark pixels is not green: the light
# of 8-bit code 3. Chosen; sensitivity not measured.
_DARKEST = np.float32(1e-3)
# Distance between the pixels, in rows and columns, from which the median of a picture is computed:
# a 49th of the work for nearly the same median.
_USUAL_STEP_PX = 7
# Distance by which crowns in pictures extend beyond those of the twin: no beam meets the outermost
# twigs. Chosen; sensitivity not measured, as for the next three.
_REACH_M = 1.5
# Side length over which the colour of leaves is averaged, in metres: single pixels show leaves,
# gaps and shadows between them.
_AROUND_M = 0.15
# Least excess green of leaves, as a fraction of the median over the crowns of the picture.
_LIKE_CROWN = 0.35
# Relative distance behind a crown up to which a surface may belong to the crown.
_BEHIND = 0.05


def excess_green(
    srgb8: UInt8[np.ndarray, "h w 3"], around_px: int = 1
) -> Float32[np.ndarray, "h w"]:
    """Return the excess green of each pixel over the median of its picture, in octaves.

    log2(green / sqrt(red blue)): the excess green of Woebbecke et al. 1995
    (doi:10.13031/2013.27838) in a form that does not depend on exposure.

    Args:
        around_px: side of the square over which the light is averaged.
    """
    light = linear_from_srgb8(srgb8)
    if around_px > 1:
        light = ndimage.uniform_filter(light, around_px, axes=(0, 1))
    octaves = np.log2(light + _DARKEST)
    green = octaves[..., 1] - 0.5 * (octaves[..., 0] + octaves[..., 2])
    usual = np.median(green[::_USUAL_STEP_PX, ::_USUAL_STEP_PX])
    return np.asarray(green - usual, dtype=np.float32)


def foliage_faces(mesh: TriMesh) -> Bool[np.ndarray, " m"]:
    """Return the faces whose material is foliage."""
    is_foliage = np.array([material.name == _FOLIAGE for material in mesh.materials], dtype=bool)
    if mesh.face_material is None:
        return np.full(len(mesh.faces), is_foliage[0])
    return is_foliage[mesh.face_material]


def shows_foliage(meshes: Sequence[TriMesh], hits: RayHits) -> Bool[np.ndarray, " n"]:
    """Return the rays that meet a face of foliage."""
    is_leaf = np.zeros(len(hits.face_index), dtype=bool)
    for number, mesh in enumerate(meshes):
        rows = np.flatnonzero(hits.is_hit & (hits.mesh_index == number))
        is_leaf[rows] = foliage_faces(mesh)[hits.face_index[rows]]
    return is_leaf


def crown_beside(
    is_leaf: Bool[np.ndarray, "h w"], distance_m: Float32[np.ndarray, "h w"], focal_px: float
) -> Float32[np.ndarray, "h w"]:
    """Return the distance of the adjacent crown for pixels that show a farther surface, else inf.

    Leaves may hide that surface, since crowns in pictures extend beyond those of the twin.

    Args:
        is_leaf: pixels that show a crown of the twin.
        distance_m: of the twin's surface, inf where there is none.
    """
    if not is_leaf.any():
        return np.full(is_leaf.shape, np.inf, dtype=np.float32)
    away_px, nearest = nearest_of(is_leaf)
    crown_m = distance_m[nearest]
    # Pixels per metre at the distance of the crown, not of the surface behind it.
    is_beside = ~is_leaf & (away_px < focal_px * _REACH_M / crown_m)
    is_beside &= distance_m > crown_m * (1 + _BEHIND)
    return np.where(is_beside, crown_m, np.float32(np.inf)).astype(np.float32)


def leaves_before(
    srgb8: UInt8[np.ndarray, "h w 3"],
    is_leaf: Bool[np.ndarray, "h w"],
    crown_m: Float32[np.ndarray, "h w"],
    focal_px: float,
    *,
    has_twigs: bool = False,
) -> Float32[np.ndarray, "h w"]:
    """Return the distance of leaves that hide the twin's surface in a picture, else inf.

    Such leaves are about as green as the crowns of the twin and are connected to one.

    Args:
        crown_m: distance of the crown (`crown_beside`).
        has_twigs: add the pale edge, where leaves and background mix.
    """
    is_near = np.isfinite(crown_m)
    if not is_near.any():
        return crown_m
    # Odd, so that the filter is centred on its pixel.
    around_px = max(1, round(focal_px * _AROUND_M / float(np.median(crown_m[is_near])))) | 1
    green = excess_green(srgb8, around_px)
    least = max(GREENER, _LIKE_CROWN * float(np.median(green[is_leaf])))
    is_rim = ndimage.binary_propagation(is_leaf, mask=is_leaf | is_near & (green > least))
    is_rim &= ~is_leaf
    if has_twigs:
        is_rim = ndimage.maximum_filter(is_rim, 2 * around_px + 1) & is_near
    return np.where(is_rim, crown_m, np.float32(np.inf)).astype(np.float32)
