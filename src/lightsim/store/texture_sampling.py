"""Sampling of textures at points of surfaces, and evenly distributed sample points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64

from lightsim.core.colour import linear_from_srgb8
from lightsim.store.primitives import ImageTexture, Wrap

# Number of points over which a texture is averaged. The mean of a half black, half white picture
# has an error of some 0.5 %, and a part takes about a millisecond.
_N_SAMPLES = 1 << 12
# Powers of the inverse plastic number; their multiples, modulo 1, fill a square evenly (Roberts
# 2018, "The unreasonable effectiveness of quasirandom sequences").
_PLASTIC = (0.7548776662466927, 0.5698402909980532)


def sample_colour(
    texture: ImageTexture, uv: Float[np.ndarray, "n 2"], *, is_by_alpha: bool = False
) -> Float32[np.ndarray, "n 3"]:
    """Return linear colour at texture coordinates, interpolated in linear light.

    Args:
        is_by_alpha: weight pixels by their alpha, so that the colour of invisible pixels does not
            affect visible ones.
    """
    pixels = texture.pixels
    colour = np.zeros((len(uv), 3))
    total = np.zeros(len(uv))
    for i, j, weight in _corners(texture, uv):
        texel = pixels[i, j]
        if is_by_alpha and pixels.shape[2] == 4:
            # Invisible pixels have a small weight, so that the sum of weights is not 0.
            weight = weight * np.maximum(texel[:, 3] / 255.0, 1e-6)
        colour += weight[:, None] * linear_from_srgb8(texel[:, :3])
        total += weight
    return (colour / total[:, None]).astype(np.float32)


def sample_channel(
    texture: ImageTexture, uv: Float[np.ndarray, "n 2"], channel: int
) -> Float64[np.ndarray, " n"]:
    """Return one channel at texture coordinates, in [0, 1], without the sRGB curve."""
    if channel >= texture.pixels.shape[2]:
        return np.ones(len(uv))
    values = np.zeros(len(uv))
    for i, j, weight in _corners(texture, uv):
        values += weight * (texture.pixels[i, j, channel] / 255.0)
    return values


def surface_samples(
    vertices: Float64[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"]]:
    """Return faces and barycentric coordinates of evenly distributed points on a surface.

    The points are deterministic. If no face has an area, all faces have equal weight.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not area.sum() > 0:
        area = np.ones(len(faces))
    ends = np.cumsum(area)
    number = np.arange(_N_SAMPLES)
    face = np.searchsorted(ends, (number + 0.5) / _N_SAMPLES * ends[-1])
    u, v = ((number + 1) * step % 1.0 for step in _PLASTIC)
    # Reflect the half of the unit square outside the triangle.
    is_outside = u + v > 1
    u, v = np.where(is_outside, 1 - u, u), np.where(is_outside, 1 - v, v)
    return np.minimum(face, len(faces) - 1), np.stack([1 - u - v, u, v], axis=1)


def interpolated(
    values: Float[np.ndarray, "n *c"],
    faces: Int32[np.ndarray, "m 3"],
    samples: tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"]],
) -> Float64[np.ndarray, "k *c"]:
    """Interpolate values of vertices at the points of `surface_samples`."""
    face, barycentric = samples
    corners = values[faces[face]].astype(np.float64)
    return np.einsum("kc,kc...->k...", barycentric, corners)


def _corners(
    texture: ImageTexture, uv: Float[np.ndarray, "n 2"]
) -> list[tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]]:
    """Return rows, columns and bilinear weights of the pixels around each point."""
    height, width = texture.pixels.shape[:2]
    wrap_u, wrap_v = texture.wrap
    if texture.is_nearest:
        column = np.floor(_folded(uv[:, 0], wrap_u) * width).astype(np.int64)
        row = np.floor(_folded(uv[:, 1], wrap_v) * height).astype(np.int64)
        return [(_wrapped(row, height, wrap_v), _wrapped(column, width, wrap_u), np.ones(len(uv)))]
    x = _folded(uv[:, 0], wrap_u) * width - 0.5
    y = _folded(uv[:, 1], wrap_v) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - x0, y - y0
    rows = [(_wrapped(y0 + k, height, wrap_v), np.abs(1 - k - fy)) for k in (0, 1)]
    columns = [(_wrapped(x0 + k, width, wrap_u), np.abs(1 - k - fx)) for k in (0, 1)]
    return [(i, j, wy * wx) for i, wy in rows for j, wx in columns]


def _folded(u: Float[np.ndarray, " n"], wrap: Wrap) -> Float64[np.ndarray, " n"]:
    """Reduce coordinates to [0, 1] (mirrored: [0, 2]), so that pixel indices fit into integers."""
    u = u.astype(np.float64)
    if wrap is Wrap.CLAMP:
        return np.clip(u, 0.0, 1.0)
    return u % (2.0 if wrap is Wrap.MIRROR else 1.0)


def _wrapped(index: Int64[np.ndarray, " n"], size: int, wrap: Wrap) -> Int64[np.ndarray, " n"]:
    if wrap is Wrap.CLAMP:
        return np.clip(index, 0, size - 1)
    if wrap is Wrap.REPEAT:
        return index % size
    index = index % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index)
