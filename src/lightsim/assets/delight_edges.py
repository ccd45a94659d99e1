"""Sun visibility at any point of a surface from labelled surfels; soft along shadow edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import KDTree

from lightsim.assets.delight_labels import Labels, Observed
from lightsim.assets.delight_light import LightScales, SurfaceLight

_NEAREST, _AROUND = 6, 32
_REACH_M = 1.2
_MIXED = 0.03
_CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class LabelField:
    """Labels and base colour on surfels, ready to be asked anywhere.

    Args:
        lit: probability that the sun reaches each surfel.
        log_colour: log base colour under that label.
        is_firm: inside a label, away from its edges: the colour can be relied on.
    """

    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    lit: Float64[np.ndarray, " n"]
    log_colour: Float64[np.ndarray, "n 3"]
    is_firm: Bool[np.ndarray, " n"]
    scales: LightScales
    surfel_m: float

    @staticmethod
    def of(observed: Observed, labels: Labels) -> LabelField:
        surfels, graph = observed.surfels, observed.graph
        light = np.maximum(observed.light.total(labels.scales, labels.lit), 1e-6)
        first, second = graph.pairs.T
        near = graph.distance_m < 2.5 * observed.surfel_m
        differs = near & (np.abs(labels.lit[first] - labels.lit[second]) > 0.5)
        is_firm = (labels.lit < 0.1) | (labels.lit > 0.9)
        is_firm &= surfels.confidence > 0.5
        is_firm[graph.pairs[differs].ravel()] = False
        return LabelField(
            surfels.position,
            surfels.normal,
            labels.lit,
            observed.log_radiance - np.log(light),
            is_firm,
            labels.scales,
            observed.surfel_m,
        )


def refine_visibility(
    field: LabelField,
    points: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    radiance: Float32[np.ndarray, "n 3"],
    light: SurfaceLight,
) -> Float32[np.ndarray, " n"]:
    """Fraction of the sun that reaches each point.

    Away from edges it is the label of the surfels around. Near an edge it is what makes the
    point's base colour that of the firm surfels around it, which places the edge, and its
    penumbra, at the resolution of the radiance.
    """
    result = np.empty(len(points), dtype=np.float32)
    everywhere = KDTree(field.position)
    firm = np.flatnonzero(field.is_firm)
    tree = KDTree(field.position[firm]) if len(firm) else None
    diffuse, direct = light.diffuse(field.scales), light.direct(field.scales)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        index, share = _around(everywhere, field, points[part], normals[part], _NEAREST)
        lit = (share * field.lit[index]).sum(axis=1)
        edge = np.flatnonzero((lit > _MIXED) & (lit < 1 - _MIXED))
        if tree is not None and len(edge):
            rows = start + edge
            lit[edge] = _by_colour(
                field,
                (tree, firm),
                (points[rows], normals[rows], radiance[rows].astype(np.float64)),
                (diffuse[rows], direct[rows]),
                lit[edge],
            )
        result[part] = lit
    return result


def _around(
    tree: KDTree,
    field: LabelField,
    points: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    count: int,
    rows: np.ndarray | None = None,
    width_m: float = 0.0,
) -> tuple[np.ndarray, Float64[np.ndarray, "n k"]]:
    """Nearest surfels and their shares, which favour near ones of the same facing."""
    distance, index = tree.query(points, k=min(count, tree.n))
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    if rows is not None:
        index = rows[index]
    width = width_m or 0.6 * field.surfel_m
    facing = np.clip((field.normal[index] * normals[:, None]).sum(axis=2), 0.0, 1.0)
    near = np.exp(-0.5 * ((distance - distance[:, :1]) / width) ** 2)
    share = near * (facing**4 + 1e-4)
    return index, share / share.sum(axis=1, keepdims=True)


def _by_colour(
    field: LabelField,
    firm: tuple[KDTree, np.ndarray],
    seen: tuple[np.ndarray, np.ndarray, Float64[np.ndarray, "n 3"]],
    light: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]],
    lit: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """The visibility that gives points the base colour around them; the label where none is."""
    points, normals, radiance = seen
    diffuse, direct = light
    tree, rows = firm
    index, share = _around(tree, field, points, normals, _AROUND, rows, _REACH_M / 2)
    colour = np.exp((share[:, :, None] * field.log_colour[index]).sum(axis=1))
    wanted = ((radiance / colour - diffuse) * direct).sum(axis=1)
    found = wanted / np.maximum((direct**2).sum(axis=1), 1e-12)
    reach = np.linalg.norm(field.position[index[:, 0]] - points, axis=1)
    facing = (field.normal[index[:, 0]] * normals).sum(axis=1)
    is_known = (reach < _REACH_M) & (facing > 0.8)
    return np.where(is_known, np.clip(found, 0.0, 1.0), lit)
