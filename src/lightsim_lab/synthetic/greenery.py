"""Trees, lamp posts and signs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.shapes import Part, box, quads, tube

# Edge length of a leaf quadrilateral, in metres; larger than a real leaf, to limit their number.
_LEAF_M = 0.17


def build_tree(
    rng: np.random.Generator, foot_m: tuple[float, float, float], height_m: float
) -> list[Part]:
    """Build a tree: trunk, boughs, and clusters of leaves (single quadrilaterals)."""
    foot = np.asarray(foot_m)
    fork = foot + np.array([0.0, 0.0, 0.42 * height_m])
    parts = [tube("bark", foot.tolist(), fork.tolist(), (0.16, 0.11), 12)]
    clusters = []
    # Six boughs around the trunk, and one that continues it upwards.
    for k in range(7):
        angle = 2 * np.pi * k / 7 + float(rng.uniform(-0.3, 0.3))
        reach = float(rng.uniform(0.45, 1.25)) if k else 0.1
        rise = float(rng.uniform(0.2, 0.5)) * height_m if k else 0.5 * height_m
        end = fork + np.array([reach * np.cos(angle), reach * np.sin(angle), rise])
        parts.append(tube("bark", fork.tolist(), end.tolist(), (0.07, 0.02), 7))
        clusters.append((end, float(rng.uniform(0.55, 0.95))))
    parts += [
        leaf_cluster(rng, centre, radius, round(260 * radius**2)) for centre, radius in clusters
    ]
    return parts


def leaf_cluster(
    rng: np.random.Generator,
    centre: Float[np.ndarray, "3"],
    radius_m: float | Float[np.ndarray, "3"],
    count: int,
    leaf_m: float = _LEAF_M,
) -> Part:
    """Build leaves (single quadrilaterals) in a ball, most of them in its outer half.

    Args:
        radius_m: radius, or the three radii of an ellipsoid.
        leaf_m: edge length of a leaf.
    """
    out = rng.standard_normal((count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    centres = centre + out * radius_m * rng.uniform(0.3, 1.0, (count, 1)) ** 0.5
    normal = out + 0.9 * rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = np.cross(normal, rng.standard_normal((count, 3)))
    side *= 0.5 * leaf_m / np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(normal, side) * rng.uniform(0.6, 1.0, (count, 1))
    corners = np.stack(
        [
            centres - side - other,
            centres + side - other,
            centres + side + other,
            centres - side + other,
        ],
        axis=1,
    )
    return quads("leaf", corners, corners[..., [0, 2]] + corners[..., [1, 1]])


def build_post(foot_m: tuple[float, float, float], towards: int, height_m: float) -> list[Part]:
    """Build a street lamp with an arm over the road.

    Args:
        towards: direction of the arm: +1 is +y, -1 is -y.
    """
    x, y, z = foot_m
    top = (x, y, z + height_m)
    tip = (x, y + 1.6 * towards, z + height_m + 0.25)
    low, high = sorted((tip[1], tip[1] + 0.6 * towards))
    return [
        tube("steel", foot_m, (x, y, z + 1.1), (0.11, 0.1), 14),
        tube("steel", (x, y, z + 1.1), top, (0.075, 0.05), 14),
        tube("steel", top, tip, (0.045, 0.035), 10),
        box("slab", (x - 0.13, low, tip[2] - 0.06), (x + 0.13, high, tip[2] + 0.06)),
    ]


def build_sign(foot_m: tuple[float, float, float], material: str) -> list[Part]:
    """Build a traffic sign: a plate on a pole, facing along the street."""
    x, y, z = foot_m
    return [
        tube("steel", foot_m, (x, y, z + 2.7), (0.035, 0.035), 10),
        box(material, (x - 0.07, y - 0.32, z + 2.05), (x - 0.045, y + 0.32, z + 2.68)),
    ]
