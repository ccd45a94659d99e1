"""Trees with dense crowns, hedges and shrubs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.greenery import leaf_cluster
from lightsim_lab.synthetic.shapes import Part, box, ellipsoid, quads, tube


@dataclass(frozen=True)
class TreeTable:
    """Dimensions of a kind of tree, in metres, as ranges between individuals.

    Args:
        trunk_m: height of the lowest leaves.
        crown_radius_m: horizontal radius of the crown.
        crown_height_m: vertical extent of the crown.
        clusters: number of leaf clusters on the crown; their leaves overlap, so that it is dense.
        leaves: number of leaves per cluster; the triangles of the street are mostly leaves.
        leaf_m: edge length of a leaf.
    """

    trunk_m: tuple[float, float]
    crown_radius_m: tuple[float, float]
    crown_height_m: tuple[float, float]
    trunk_radius_m: float
    clusters: int = 16
    leaves: int = 130
    leaf_m: float = 0.3


def dense_tree(
    rng: np.random.Generator, foot_m: tuple[float, float, float], table: TreeTable
) -> list[Part]:
    """Build a tree with boughs into every cluster of an egg-shaped crown."""
    foot = np.asarray(foot_m)
    trunk, radius, height = (
        float(rng.uniform(*span))
        for span in (table.trunk_m, table.crown_radius_m, table.crown_height_m)
    )
    fork = foot + np.array([0.0, 0.0, trunk])
    heart = foot + np.array([0.0, 0.0, trunk + 0.55 * height])
    thick = table.trunk_radius_m
    parts = [
        tube("bark", foot.tolist(), fork.tolist(), (thick, 0.8 * thick), 12),
        tube("bark", fork.tolist(), heart.tolist(), (0.8 * thick, 0.3 * thick), 8),
    ]
    for direction in _spread(rng, table.clusters):
        # Clusters are smaller than the crown and near its surface, so that it has hollows.
        centre = heart + 0.6 * direction * np.array([radius, radius, height / 2])
        parts.append(tube("bark", fork.tolist(), centre.tolist(), (0.35 * thick, 0.02), 5))
        radii = float(rng.uniform(0.42, 0.56)) * np.array([radius, radius, 0.5 * height])
        parts.append(leaf_cluster(rng, centre, radii, table.leaves, table.leaf_m))
    return parts


def _spread(rng: np.random.Generator, count: int) -> Float[np.ndarray, "{count} 3"]:
    """Return directions that cover the sphere evenly (a Fibonacci lattice), with jitter."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + 5**0.5) * k + float(rng.uniform(0, 6))
    ring = np.sqrt(1 - z**2)
    out = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    return out + 0.15 * rng.standard_normal((count, 3))


def hedge(
    rng: np.random.Generator, low: tuple[float, float, float], high: tuple[float, float, float]
) -> list[Part]:
    """Build a clipped hedge: a dark core with a layer of leaves over its sides and top."""
    a, b = np.asarray(low), np.asarray(high)
    size = b - a
    # Leaves per square metre of the two long sides and the top; chosen by eye.
    area = 2 * (size[0] + size[1]) * size[2] + size[0] * size[1]
    count = round(45 * area)
    face = rng.choice(
        5,
        count,
        p=np.array([size[1] * size[2]] * 2 + [size[0] * size[2]] * 2 + [size[0] * size[1]]) / area,
    )
    at = rng.random((count, 3))
    axis = np.array([0, 0, 1, 1, 2])[face]
    at[np.arange(count), axis] = np.array([0.0, 1.0, 0.0, 1.0, 1.0])[face]
    centres = a + at * size + 0.03 * rng.standard_normal((count, 3))
    core = box("hedge", (a + [0.05, 0.05, 0.0]).tolist(), (b - 0.05).tolist())
    return [core, _loose_leaves(rng, centres, 0.13)]


def shrub(
    rng: np.random.Generator, foot_m: tuple[float, float, float], radius_m: float
) -> list[Part]:
    """Build a round shrub that touches the ground."""
    centre = np.asarray(foot_m) + np.array([0.0, 0.0, 0.75 * radius_m])
    radii = np.array([radius_m, radius_m, 0.85 * radius_m])
    core = ellipsoid("hedge", centre.tolist(), (0.8 * radii).tolist(), 5)
    count = round(150 * radius_m**2)
    unit = rng.standard_normal((count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    centres = centre + unit * radii * rng.uniform(0.8, 1.05, (count, 1))
    return [core, _loose_leaves(rng, centres, 0.14)]


def _loose_leaves(
    rng: np.random.Generator, centres: Float[np.ndarray, "n 3"], leaf_m: float
) -> Part:
    """Build one leaf at each centre, in a random orientation."""
    count = len(centres)
    normal = rng.standard_normal((count, 3))
    side = np.cross(normal, rng.standard_normal((count, 3)))
    side *= 0.5 * leaf_m / np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(normal, side)
    other *= 0.4 * leaf_m / np.linalg.norm(other, axis=1, keepdims=True)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = np.stack([centres + i * side + j * other for i, j in signs], axis=1)
    return quads("leaf1", corners, corners[..., [0, 2]] + corners[..., [1, 1]])
