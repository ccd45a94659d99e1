"""Texture atlases: a right-angled patch of texels for each face, two patches in one block.

A patch of resolution n has texels (i, j), i to the right and j down; (0, 0), (n, 0) and (0, n) lie
on the face's corners, the right angle at the corner opposite the longest edge. Texels with
i + j <= n + 1 belong to the patch: those that bilinear interpolation inside the face reads.
Resolution 0 is one texel for the whole face.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from lightsim.appearance.bake_kernels import fill_texels
from lightsim.core.mesh import Texture

# Length of a face's longer leg, in metres, above which each corner has at least one texel, even
# without an observation, so that the texture contains the colours interpolated at the vertices. Not
# measured.
_COARSEST_UNSEEN_M = 0.1


@dataclass(frozen=True, eq=False)
class Patches:
    """Layout of the faces' patches in an image of `height_px` x `width_px`.

    Args:
        resolution: texels per edge; 0 is a single texel.
        right_corner: index (0, 1, 2) of the corner with the patch's right angle.
        origin_px: (column, row) of texel (0, 0).
        is_turned: columns and rows count backwards from the origin.
    """

    height_px: int
    width_px: int
    resolution: Int32[np.ndarray, " m"]
    right_corner: Int32[np.ndarray, " m"]
    origin_px: Int32[np.ndarray, "m 2"]
    is_turned: Bool[np.ndarray, " m"]

    @property
    def first_texel(self) -> Int64[np.ndarray, " m_plus_1"]:
        """Row of each face's first texel in a table of all texels; the last is the total."""
        return first_texels(self.resolution)

    def corner_uv(self) -> Float32[np.ndarray, "m 3 2"]:
        """Return (u, v) of each face's corners, in pixels (core.mesh.Texture)."""
        uv = np.repeat(self.origin_px[:, None].astype(np.float32) + np.float32(0.5), 3, axis=1)
        step = np.where(self.is_turned, -self.resolution, self.resolution).astype(np.float32)
        face = np.arange(len(step))
        uv[face, (self.right_corner + 1) % 3, 0] += step
        uv[face, (self.right_corner + 2) % 3, 1] += step
        return uv


@dataclass(frozen=True, eq=False)
class Texels:
    """All texels of a texture, face after face; row by row within a patch.

    Args:
        pixel: index into the image's pixels, row after row.
        face: index of the face of each texel.
        barycentric: position on the face; a texel beyond the long edge has a negative weight.
    """

    pixel: Int64[np.ndarray, " t"]
    face: Int32[np.ndarray, " t"]
    barycentric: Float32[np.ndarray, "t 3"]


def texel_count(resolution: Int32[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Return the number of texels of each patch."""
    n = resolution.astype(np.int64)
    return np.where(n == 0, 1, n + (n + 1) * (n + 2) // 2)


def first_texels(resolution: Int32[np.ndarray, " m"]) -> Int64[np.ndarray, " m_plus_1"]:
    """Return the row of each face's first texel in a table of all texels; the last is the total."""
    return np.concatenate([[0], np.cumsum(texel_count(resolution))]).astype(np.int64)


def edge_lengths_m(
    vertices: Float32[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]
) -> Float32[np.ndarray, "m 3"]:
    """Return the length of the edge opposite each corner."""
    corner = [vertices[faces[:, i]] for i in range(3)]
    edges = [np.linalg.norm(corner[(i + 1) % 3] - corner[(i + 2) % 3], axis=1) for i in range(3)]
    return np.stack(edges, axis=1).astype(np.float32)


def choose_resolution(
    edges_m: Float32[np.ndarray, "m 3"],
    footprint_m: Float32[np.ndarray, " m"],
    texel_m: float,
    max_resolution: int,
    max_texels: int,
) -> Int32[np.ndarray, " m"]:
    """Return the number of texels per edge: a texel is as large as the finest pixel on the face.

    If more than `max_texels` result, all texels grow by one factor.

    Args:
        edges_m: see `edge_lengths_m`; the second longest (the longer leg) sets the resolution.
        footprint_m: size of the finest pixel on the surface; inf if no camera observes the face.
        texel_m: least size of a texel.
        max_resolution: most texels an edge.
        max_texels: most texels of all faces together.
    """
    leg = np.sort(edges_m, axis=1)[:, 1]
    size = np.maximum(footprint_m, np.float32(texel_m))
    least = (leg > _COARSEST_UNSEEN_M).astype(np.int32)

    def at(scale: float) -> Int32[np.ndarray, " m"]:
        wanted = np.rint(leg / (np.float32(scale) * size)).astype(np.int32)
        return np.clip(wanted, least, max_resolution).astype(np.int32)

    low, high = 1.0, 1e4
    chosen = at(low)
    if texel_count(chosen).sum() <= max_texels:
        return chosen
    # Bisection of the log; `high` always satisfies the limit.
    while high / low >= 1.005:
        middle = float(np.sqrt(low * high))
        is_too_many = texel_count(at(middle)).sum() > max_texels
        low, high = (middle, high) if is_too_many else (low, middle)
    return at(high)


def pack(resolution: Int32[np.ndarray, " m"], edges_m: Float32[np.ndarray, "m 3"]) -> Patches:
    """Place all patches in one nearly square image: blocks in shelves, highest blocks first."""
    # Equal resolutions become adjacent, so that two patches fill one rectangular block.
    order = np.argsort(-resolution, kind="stable")
    block, is_second = _pair(resolution[order])
    count = int(block[-1]) + 1 if len(block) else 0
    n = np.zeros(count, dtype=np.int64)
    n[block] = resolution[order]
    width, height = np.where(n == 0, 1, n + 4), n + 1
    least = max(int(np.ceil(np.sqrt((width * height).sum()))), int(width.max(initial=1)))
    # Twelve candidate widths; the smallest area leaves the fewest empty texels.
    widths = np.unique(np.linspace(least, 1.2 * least, 12).astype(np.int64)).tolist()
    image_width = min(widths, key=lambda w: w * _shelves(width, height, w)[2])
    column, row, image_height = _shelves(width, height, image_width)
    origin = np.zeros((len(resolution), 2), dtype=np.int32)
    is_turned = np.zeros(len(resolution), dtype=bool)
    is_turned[order] = is_second
    origin[order, 0] = column[block] + np.where(is_second, width[block] - 1, 0)
    origin[order, 1] = row[block] + np.where(is_second, height[block] - 1, 0)
    right_corner = edges_m.argmax(axis=1).astype(np.int32)
    return Patches(image_height, image_width, resolution, right_corner, origin, is_turned)


def _pair(
    sorted_resolution: Int32[np.ndarray, " m"],
) -> tuple[Int64[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Block of each face, and whether it is the second in its block; single texels are unpaired."""
    count = len(sorted_resolution)
    if count == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
    is_start = np.ones(count, dtype=bool)
    is_start[1:] = sorted_resolution[1:] != sorted_resolution[:-1]
    start = np.maximum.accumulate(np.where(is_start, np.arange(count), 0))
    is_second = ((np.arange(count) - start) % 2 == 1) & (sorted_resolution > 0)
    return np.cumsum(~is_second).astype(np.int64) - 1, is_second


def _shelves(
    width: Int64[np.ndarray, " b"], height: Int64[np.ndarray, " b"], image_width: int
) -> tuple[Int64[np.ndarray, " b"], Int64[np.ndarray, " b"], int]:
    """Column and row of blocks in order of decreasing height, and the image's height."""
    end = np.cumsum(width)
    column, row = np.zeros(len(width), np.int64), np.zeros(len(width), np.int64)
    first, used, y = 0, 0, 0
    while first < len(width):
        last = int(np.searchsorted(end, used + image_width, side="right"))
        column[first:last] = end[first:last] - width[first:last] - used
        row[first:last] = y
        y += int(height[first])
        first, used = last, int(end[last - 1])
    return column, row, max(y, 1)


def texel_parts(texture: Texture, count: int) -> Iterator[Texels]:
    """Yield the texels of a texture of this module in parts of whole faces, to limit memory.

    A part has at most `count` texels, or is one face.
    """
    patches = patches_of(texture)
    first = patches.first_texel
    start = 0
    while start < len(first) - 1:
        end = int(np.searchsorted(first, first[start] + count, side="right")) - 1
        end = max(end, start + 1)
        part = slice(start, end)
        texels = texels_of(
            replace(
                patches,
                resolution=patches.resolution[part],
                right_corner=patches.right_corner[part],
                origin_px=patches.origin_px[part],
                is_turned=patches.is_turned[part],
            )
        )
        yield replace(texels, face=texels.face + np.int32(start))
        start = end


def texels_of(patches: Patches) -> Texels:
    """Return all texels of the patches."""
    first = patches.first_texel
    count = int(first[-1])
    pixel, face = np.zeros(count, np.int64), np.zeros(count, np.int32)
    barycentric = np.zeros((count, 3), np.float32)
    fill_texels(
        (patches.resolution, patches.right_corner, first),
        patches.origin_px,
        patches.is_turned,
        patches.width_px,
        pixel,
        face,
        barycentric,
    )
    return Texels(pixel, face, barycentric)


def patches_of(texture: Texture) -> Patches:
    """Recover the patches of a texture of this module from its corner coordinates alone."""
    uv = texture.corner_uv
    along, down = np.roll(uv, -1, axis=1) - uv, np.roll(uv, -2, axis=1) - uv
    # At the right corner the two edges are parallel to the image's axes.
    bent = np.abs(along[:, :, 1]) + np.abs(down[:, :, 0])
    right_corner = bent.argmin(axis=1).astype(np.int32)
    face = np.arange(len(uv))
    step: Float[np.ndarray, " m"] = along[face, right_corner, 0]
    return Patches(
        texture.image.shape[0],
        texture.image.shape[1],
        np.rint(np.abs(step)).astype(np.int32),
        right_corner,
        np.floor(uv[face, right_corner]).astype(np.int32),
        step < 0,
    )
