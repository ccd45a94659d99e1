"""Geometric primitives of the synthetic street, with texture coordinates in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int32

from lightsim.core.frames import RigidTransform


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material.

    Args:
        material: name in the street's table of finishes.
        vertices: positions in metres, in the frame of the street or actor.
        faces: vertex indices, counter-clockwise when viewed from outside.
        uv_m: texture coordinates, in metres on the surface.
    """

    material: str
    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    uv_m: Float32[np.ndarray, "n 2"]

    def transformed(self, transform: RigidTransform) -> Part:
        """Return the part in the frame `transform.dst`, with unchanged texture coordinates."""
        vertices = transform.apply(self.vertices.astype(np.float64)).astype(np.float32)
        return replace(self, vertices=vertices)


def joined(
    parts: Sequence[Part],
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"]]:
    """Concatenate vertices and faces of parts, with the vertex indices of one common list."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + np.int32(o) for part, o in zip(parts, offsets, strict=True)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def merge_parts(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Merge parts to one per material, in the order of first appearance."""
    merged = []
    for material in dict.fromkeys(part.material for part in parts):
        same = [part for part in parts if part.material == material]
        uv_m = np.concatenate([part.uv_m for part in same])
        merged.append(Part(material, *joined(same), uv_m))
    return tuple(merged)


def quads(
    material: str, corners: Float[np.ndarray, "n 4 3"], uv_m: Float[np.ndarray, "n 4 2"]
) -> Part:
    """Build quadrilaterals, each split along its first diagonal."""
    first = 4 * np.arange(len(corners), dtype=np.int32)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return Part(
        material,
        corners.reshape(-1, 3).astype(np.float32),
        faces.astype(np.int32),
        uv_m.reshape(-1, 2).astype(np.float32),
    )


def rectangle(
    material: str,
    origin: Sequence[float | int],
    along_u: Sequence[float | int],
    along_v: Sequence[float | int],
    uv_origin_m: tuple[float, float] = (0.0, 0.0),
) -> Part:
    """Build a parallelogram whose front faces `along_u x along_v`."""
    o, u, v = (np.asarray(a, dtype=np.float64) for a in (origin, along_u, along_v))
    w, h = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    corners = np.array([[o, o + u, o + u + v, o + v]])
    uv = np.array([[[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]]) + np.asarray(uv_origin_m)
    return quads(material, corners, uv)


def box(material: str, low: Sequence[float | int], high: Sequence[float | int]) -> Part:
    """Build an axis-aligned box with all six sides."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    x, y, z = (b - a) * np.eye(3)
    origin = np.stack([a, a + x, a + x + y, a + y, a + z, a])
    u, v = np.stack([x, y, -x, -y, x, y]), np.stack([z, z, z, z, y, x])
    corners = np.stack([origin, origin + u, origin + u + v, origin + v], axis=1)
    w, h = np.abs(u).sum(axis=1), np.abs(v).sum(axis=1)
    zero = np.zeros(6)
    # The offsets in the last line vary the texture between boxes.
    uv = np.stack(
        [np.stack([zero, w, w, zero], axis=1), np.stack([zero, zero, h, h], axis=1)], axis=-1
    )
    return quads(material, corners, uv + np.array([a[0] + 0.37 * a[1], a[2] + 0.61 * a[1]]))


def tube(
    material: str,
    start: Sequence[float | int],
    end: Sequence[float | int],
    radii_m: tuple[float, float],
    sides: int = 12,
) -> Part:
    """Build a closed, possibly tapering cylinder from `start` to `end`."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    # Any vector that is not parallel to the axis defines the ring's orientation.
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    angle = np.linspace(0.0, 2 * np.pi, sides + 1)
    ring = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
    low, high = a + radii_m[0] * ring, b + radii_m[1] * ring
    # Texture coordinates: arc length of the thicker end, and height.
    around = angle * max(radii_m)
    corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    uv = np.stack(
        [
            np.stack([around[:-1], around[1:], around[1:], around[:-1]], axis=1),
            np.broadcast_to([0.0, 0.0, length, length], (sides, 4)),
        ],
        axis=-1,
    )
    caps = []
    for centre, edge in ((a, low[::-1]), (b, high)):
        fan = np.stack([np.broadcast_to(centre, (sides, 3))] * 2 + [edge[:-1], edge[1:]], axis=1)
        caps.append(quads(material, fan, fan[..., :2]))
    return merge_parts([quads(material, corners, uv), *caps])[0]


def loft(material: str, sections: Float[np.ndarray, "n k 3"]) -> Part:
    """Build a capped surface over closed cross-sections of k points each."""
    closed = np.concatenate([sections, sections[:, :1]], axis=1)
    corners = np.stack([closed[:-1, :-1], closed[:-1, 1:], closed[1:, 1:], closed[1:, :-1]], axis=2)
    corners = corners.reshape(-1, 4, 3)
    caps = []
    for section, order in ((closed[0], 1), (closed[-1], -1)):
        edge = section[::-order]
        centre = np.broadcast_to(section[:-1].mean(axis=0), (len(edge) - 1, 3))
        caps.append(np.stack([centre, centre, edge[:-1], edge[1:]], axis=1))
    everything = np.concatenate([corners, *caps])
    uv = everything[..., [0, 2]] + 0.5 * everything[..., [1, 1]]
    return quads(material, everything, uv)


def ellipsoid(
    material: str, centre: Sequence[float | int], radii_m: Sequence[float | int], rings: int = 8
) -> Part:
    """Build an ellipsoid of `rings` x `2 rings` quadrilaterals."""
    polar = np.linspace(np.pi, 0.0, rings + 1)
    around = np.linspace(0.0, 2 * np.pi, 2 * rings + 1)
    t, p = np.meshgrid(polar, around, indexing="ij")
    unit = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    grid = np.asarray(centre) + unit * np.asarray(radii_m)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
    corners = corners.reshape(-1, 4, 3)
    return quads(material, corners, corners[..., [0, 2]])
