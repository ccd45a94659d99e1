"""Fences: pickets, boards, steel bars and wire mesh, along either axis of the street."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.shapes import Part, quads, tube


@dataclass(frozen=True)
class FenceTable:
    """Dimensions of a fence, in metres.

    Args:
        slat_m: width and thickness of the upright slats or bars.
        pitch_m: distance between their middles.
        post_m: distance between posts; they are as thick as two slats.
        rails: heights of the horizontal rails as fractions of the height.
    """

    material: str
    height_m: float
    slat_m: tuple[float, float]
    pitch_m: float
    post_m: float = 2.5
    rails: tuple[float, ...] = (0.2, 0.8)


def fence(start_m: Sequence[float], end_m: Sequence[float], table: FenceTable) -> list[Part]:
    """Build a fence of slats between two points on level ground, parallel to an axis."""
    a, b = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    if length < table.pitch_m:
        return []
    along = (b - a) / length
    across = np.array([-along[1], along[0], 0.0])
    wide, thick = table.slat_m
    at = np.arange(table.pitch_m / 2, length, table.pitch_m)
    middles = a + at[:, None] * along + [0.0, 0.0, 0.04]
    half = 0.5 * np.abs(wide * along + thick * across)
    parts = [bars(table.material, middles - half, middles + half + [0, 0, table.height_m - 0.04])]
    posts = a + np.linspace(0, length, max(2, round(length / table.post_m) + 1))[:, None] * along
    size = max(0.05, 1.2 * thick) * np.array([1.0, 1.0, 0.0])
    parts.append(bars(table.material, posts - size, posts + size + [0, 0, 1.03 * table.height_m]))
    for fraction in table.rails:
        height = [0.0, 0.0, fraction * table.height_m]
        grow = 0.5 * thick * np.abs(across) + [0, 0, 0.025]
        ends = np.sort(np.stack([a + height, b + height]), axis=0)
        # Rails stand behind the slats by their thickness.
        back = thick * across
        parts.append(bars(table.material, (ends[:1] - grow + back), (ends[1:] + grow + back)))
    return parts


def mesh_fence(
    start_m: Sequence[float], end_m: Sequence[float], height_m: float, mesh_m: float
) -> list[Part]:
    """Build a chain-link fence: flat diagonal wires, posts every 3 m, and a tube on top.

    Wires are 8 mm wide and the mesh is coarser than a real one, so that it stays visible at the
    images' resolution and has few triangles.
    """
    a, b = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    along, up = (b - a) / length, np.array([0.0, 0.0, 1.0])
    parts = [
        tube("steel", (a + height_m * up).tolist(), (b + height_m * up).tolist(), (0.025, 0.025), 6)
    ]
    for s in np.linspace(0, length, round(length / 3.0) + 1).tolist():
        foot = a + s * along
        top = foot + (height_m + 0.05) * up
        parts.append(tube("steel", foot.tolist(), top.tolist(), (0.03, 0.03), 8))
    starts = np.arange(-height_m, length, mesh_m * np.sqrt(2))
    for sign in (1, -1):
        # Each wire runs from (s, 0) to (s + height, height), clipped at the fence's ends.
        s0 = np.clip(starts, 0.0, length)
        s1 = np.clip(starts + height_m, 0.0, length)
        t0, t1 = s0 - starts, s1 - starts
        if sign < 0:
            t0, t1 = height_m - t0, height_m - t1
        low = a + s0[:, None] * along + t0[:, None] * up
        high = a + s1[:, None] * along + t1[:, None] * up
        wide = 0.004 * (along - sign * up) / np.sqrt(2)
        corners = np.stack([low - wide, low + wide, high + wide, high - wide], axis=1)
        parts.append(quads("mesh", corners, corners[..., [0, 2]]))
    return parts


def bars(material: str, low: Float[np.ndarray, "n 3"], high: Float[np.ndarray, "n 3"]) -> Part:
    """Build many axis-aligned bars with four sides and a top."""
    x0, y0, z0 = np.minimum(low, high).T
    x1, y1, z1 = np.maximum(low, high).T
    p = [np.stack(c, axis=-1) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]

    def at(corner: int, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        return np.concatenate([p[corner], z[:, None]], axis=1)

    sides = [
        np.stack([at(k, z0), at((k + 1) % 4, z0), at((k + 1) % 4, z1), at(k, z1)], axis=1)
        for k in range(4)
    ]
    sides.append(np.stack([at(k, z1) for k in range(4)], axis=1))
    corners = np.concatenate(sides)
    return quads(material, corners, corners[..., [0, 2]] + corners[..., [1, 1]])
