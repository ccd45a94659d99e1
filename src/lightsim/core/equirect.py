"""The equirectangular mapping of sky domes (CONVENTIONS: Sky domes): row 0 is up, the centre
column looks along world +x, columns grow clockwise from above."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Domes with fewer rows are subdivided before cosines are clipped at the horizon. Chosen;
# sensitivity not measured.
_FINE_ROWS = 128


def directions_from_uv(uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    """Return unit world directions of (u, v), given as fractions of width and height."""
    azimuth = (0.5 - uv[..., 0]) * 2 * np.pi
    polar = uv[..., 1] * np.pi
    sine = np.sin(polar)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)], axis=-1)


def uv_from_directions(directions_world: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Return (u, v) in [0, 1) x [0, 1], as fractions of width and height, of unit directions."""
    x, y, z = np.moveaxis(directions_world, -1, 0)
    u = (0.5 - np.arctan2(y, x) / (2 * np.pi)) % 1.0
    v = np.arccos(np.clip(z, -1.0, 1.0)) / np.pi
    return np.stack([u, v], axis=-1)


def pixel_directions(height_px: int) -> Float[np.ndarray, "h w 3"]:
    """Return unit world directions of the pixel centres of an (h, 2h) dome."""
    u = (np.arange(2 * height_px) + 0.5) / (2 * height_px)
    v = (np.arange(height_px) + 0.5) / height_px
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    return directions_from_uv(uv)


def solid_angles_sr(height_px: int) -> Float[np.ndarray, "h 1"]:
    """Return the exact solid angle of a pixel of each row; times 2h, the sum is 4 pi."""
    # The area of a zone of the unit sphere is 2 pi times its height along z.
    edges = np.cos(np.linspace(0.0, np.pi, height_px + 1))
    return ((edges[:-1] - edges[1:]) * 2 * np.pi / (2 * height_px))[:, None]


def pixel_vectors_sr(height_px: int) -> Float[np.ndarray, "h w 3"]:
    """Return the exact integral of the direction over each pixel. Its dot product with a normal is
    the cosine-weighted solid angle of a pixel in front of the surface."""
    polar = np.linspace(0.0, np.pi, height_px + 1)
    # Azimuth falls from pi to -pi with the columns: integrals over it are differences with the
    # opposite sign.
    azimuth = np.linspace(np.pi, -np.pi, 2 * height_px + 1)
    level = np.diff(polar / 2 - np.sin(2 * polar) / 4)[:, None]
    up = np.diff(np.sin(polar) ** 2 / 2)[:, None] * (np.pi / height_px)
    x = level * -np.diff(np.sin(azimuth))
    y = level * np.diff(np.cos(azimuth))
    return np.stack([x, y, np.broadcast_to(up, x.shape)], axis=-1)


def cosine_weights_sr(
    height_px: int, normal_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w"]:
    """Return the cosine-weighted solid angle of each pixel in front of a surface; for the normal up
    their sum is pi."""
    # Coarse pixels are subdivided, so that a pixel across the horizon counts by its visible part.
    parts = max(1, -(-_FINE_ROWS // height_px))
    fine = np.clip(pixel_vectors_sr(parts * height_px) @ normal_world, 0.0, None)
    return fine.reshape(height_px, parts, 2 * height_px, parts).sum(axis=(1, 3))


def sample_bilinear(
    image: Float[np.ndarray, "h w c"], directions_world: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n c"]:
    """Look an image up by direction: bilinear, periodic in azimuth, clamped at the poles."""
    height, width = image.shape[:2]
    uv = uv_from_directions(directions_world)
    # Values lie at pixel centres, half a pixel from the corner at which u and v start.
    x = uv[..., 0] * width - 0.5
    y = np.clip(uv[..., 1] * height - 0.5, 0.0, height - 1.0)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    y1 = np.minimum(y0 + 1, height - 1)
    left, right = x0 % width, (x0 + 1) % width
    top = image[y0, left] * (1 - fx) + image[y0, right] * fx
    bottom = image[y1, left] * (1 - fx) + image[y1, right] * fx
    return (top * (1 - fy) + bottom * fy).astype(image.dtype)
