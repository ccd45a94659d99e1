"""Surfaces of shapes that are given as fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64, Int64

Points = Float64[np.ndarray, "n 3"]
Field = Float64[np.ndarray, " n"]
"""A number at each point; negative inside."""
Shape = Callable[[Points], Field]


def grown(shape: Shape, by_m: float) -> Shape:
    """The shape, and what lies within a distance of it."""
    return lambda points: shape(points) - by_m


def level_set(
    shape: Shape,
    low: Sequence[float] | Float64[np.ndarray, "3"],
    high: Sequence[float] | Float64[np.ndarray, "3"],
    voxel_m: float,
) -> tuple[Points, Int64[np.ndarray, "m 3"]]:
    """Vertices and faces of a shape's surface between two corners: marching cubes, the vertices
    moved onto it by Newton's method."""
    from skimage.measure import marching_cubes

    axes = [np.arange(a, b, voxel_m) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = shape(points.reshape(-1, 3)).reshape(points.shape[:3])
    found, faces, _, _ = marching_cubes(values, 0.0)
    vertices = np.array(low) + voxel_m * found.astype(np.float64)
    step = 1e-3 * np.eye(3)
    for _ in range(2):
        value = shape(vertices)
        slope = np.stack([(shape(vertices + e) - value) / 1e-3 for e in step], axis=1)
        size = np.maximum(np.square(slope).sum(axis=1), 0.3)
        vertices = vertices - np.clip(value / size, -0.02, 0.02)[:, None] * slope
    return vertices, faces.astype(np.int64)
