"""Sun visibility at any point of a surface from labelled surfels; soft along shadow edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.spatial import KDTree

from lightsim.appearance.intrinsic.labels import (
    Labels,
    Observed,
    is_at_label_edge,
    rendered_visibility,
    smoothed,
)
from lightsim.core.found_visibility import decided

_NEAREST, _AROUND = 6, 32
_REACH_M = 1.2
_SURE = 0.03
# Prior of being lit below which a rendered shadow is near.
_NEAR_SHADOW = 0.75
# Points looked at together: some 30 MB of intermediate results, whatever the log.
_CHUNK = 1 << 15


@dataclass(frozen=True, eq=False)
class LabelField:
    """Labels and base colour on surfels, ready to be asked anywhere. Make it with `label_field`.

    Args:
        faces: of the mesh, those that the surfels lie on.
        lit: probability that the sun reaches each surfel.
        log_colour: log base colour of the firmly labelled surface around each surfel.
        is_known: whether there is such a surface.
        is_mixed: whether lit and shadowed surface meet at the surfel, or may.
    """

    faces: Int64[np.ndarray, " k"]
    tree: KDTree
    normal: Float64[np.ndarray, "n 3"]
    lit: Float64[np.ndarray, " n"]
    log_colour: Float64[np.ndarray, "n 3"]
    is_known: Bool[np.ndarray, " n"]
    is_mixed: Bool[np.ndarray, " n"]
    surfel_m: float


def label_field(
    faces: Int64[np.ndarray, " k"], observed: Observed, labels: Labels, edge_error_m: float
) -> LabelField:
    """What `refine_visibility` needs of labelled surfels; `edge_error_m` of `IntrinsicConfig`."""
    surfels = observed.surfels
    light = np.maximum(observed.light.total(labels.lit), 1e-6)
    log_colour = observed.log_radiance - np.log(light)
    # What is merely dark amid light (panes, tyres) is unsure, too: a shadow must be near.
    is_unsure = (labels.lit > _SURE) & (labels.lit < 1 - _SURE) & (labels.prior < _NEAR_SHADOW)
    is_mixed = is_unsure | is_at_label_edge(observed, labels.lit)
    is_mixed |= _is_at_thin_shadow(observed, edge_error_m)
    is_firm = ~is_mixed & (surfels.confidence > 0.5)
    colour, is_known = _colour_around(observed, log_colour, is_firm, is_mixed)
    return LabelField(
        faces,
        KDTree(surfels.position),
        surfels.normal,
        labels.lit,
        colour,
        is_known,
        is_mixed,
        observed.surfel_m,
    )


def _is_at_thin_shadow(observed: Observed, edge_error_m: float) -> Bool[np.ndarray, " n"]:
    """Patches near a rendered shadow, or a gap of light, that is narrower than its place is sure:
    a post's, or what falls between two of them. Labels of patches average it away, and say nothing
    of it; the texels can."""
    graph, rendered = observed.graph, rendered_visibility(observed.light)
    is_thin = (rendered > 0.5) != (smoothed(rendered, graph, edge_error_m) > 0.5)
    near = graph.pairs[graph.distance_m < edge_error_m]
    result = is_thin.copy()
    result[near[is_thin[near].any(axis=1)].ravel()] = True
    return result


def _colour_around(
    observed: Observed,
    log_colour: Float64[np.ndarray, "n 3"],
    is_firm: Bool[np.ndarray, " n"],
    is_mixed: Bool[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Mean log base colour of the firm surfels around those near an edge, and whether any are."""
    position, normal = observed.surfels.position, observed.surfels.normal
    asked = is_mixed.copy()
    touched = observed.graph.pairs[is_mixed[observed.graph.pairs].any(axis=1)]
    asked[touched.ravel()] = True
    is_known, result = is_firm.copy(), log_colour.copy()
    all_rows, firm = np.flatnonzero(asked), np.flatnonzero(is_firm)
    if len(all_rows) == 0 or len(firm) == 0:
        return result, is_known
    surfels = KDTree(position[firm]), normal[firm]
    step = _CHUNK * _NEAREST // _AROUND
    for start in range(0, len(all_rows), step):
        rows = all_rows[start : start + step]
        index, fraction, distance = _around(
            surfels, position[rows], normal[rows], _AROUND, _REACH_M / 2
        )
        result[rows] = (fraction[:, :, None] * log_colour[firm[index]]).sum(axis=1)
        facing = (fraction * (normal[firm[index]] * normal[rows][:, None]).sum(axis=2)).sum(axis=1)
        is_known[rows] = (distance < _REACH_M) & (facing > 0.8)
    return result, is_known


def _around(
    surfels: tuple[KDTree, Float64[np.ndarray, "n 3"]],
    points: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
    count: int,
    width_m: float,
) -> tuple[Int64[np.ndarray, "m k"], Float64[np.ndarray, "m k"], Float64[np.ndarray, " m"]]:
    """Nearest surfels, their weights (which favour near ones of the same facing), and the distance
    of the nearest."""
    tree, normal = surfels
    distance, index = (np.asarray(part) for part in tree.query(points, k=min(count, tree.n)))
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    facing = np.clip((normal[index] * normals[:, None]).sum(axis=2), 0.0, 1.0)
    near = np.exp(-0.5 * ((distance - distance[:, :1]) / width_m) ** 2)
    fraction = near * (facing**4 + 1e-4)
    return index.astype(np.int64), fraction / fraction.sum(axis=1, keepdims=True), distance[:, 0]


@dataclass(frozen=True, eq=False)
class ShadedPoints:
    """Points of the surface with what was seen, the light without and of the sun there, and what
    they reflect of both."""

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    radiance: Float32[np.ndarray, "n 3"]
    diffuse: Float32[np.ndarray, "n 3"]
    direct: Float32[np.ndarray, "n 3"]
    reflected: Float32[np.ndarray, "n 3"]
    reflected_sun: Float32[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.points)

    def at(self, rows: slice | Int64[np.ndarray, " m"]) -> ShadedPoints:
        """Some of the points."""
        return ShadedPoints(
            self.points[rows],
            self.normals[rows],
            self.radiance[rows],
            self.diffuse[rows],
            self.direct[rows],
            self.reflected[rows],
            self.reflected_sun[rows],
        )


def refine_visibility(field: LabelField, seen: ShadedPoints) -> Float32[np.ndarray, " n"]:
    """Fraction of the sun that reaches each point.

    Away from edges it is the label of the surfels around. Near an edge it is what makes the
    point's base colour that of the firm surfels around it, which places the edge, and its
    penumbra, at the resolution of the radiance.
    """
    result = np.empty(len(seen), dtype=np.float32)
    for start in range(0, len(seen), _CHUNK):
        rows = slice(start, start + _CHUNK)
        result[rows] = _refine(field, seen.at(rows))
    return result


def _refine(field: LabelField, seen: ShadedPoints) -> Float32[np.ndarray, " n"]:
    surfels = (field.tree, field.normal)
    index, fraction, _ = _around(surfels, seen.points, seen.normals, _NEAREST, 0.6 * field.surfel_m)
    lit = (fraction * field.lit[index]).sum(axis=1)
    known = (fraction * field.is_known[index]).sum(axis=1)
    colour = fraction * field.is_known[index]
    colour = (colour[:, :, None] * field.log_colour[index]).sum(axis=1)
    colour = np.exp(colour / np.maximum(known, 1e-9)[:, None])
    diffuse = seen.diffuse + seen.reflected / colour
    direct = seen.direct + seen.reflected_sun / colour
    wanted = ((seen.radiance / colour - diffuse) * direct).sum(axis=1)
    found = wanted / np.maximum((direct**2).sum(axis=1), 1e-12)
    is_edge = field.is_mixed[index].any(axis=1) & (known > 0.3)
    return decided(np.where(is_edge, found, lit))
