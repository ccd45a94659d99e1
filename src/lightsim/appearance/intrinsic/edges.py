"""Sun visibility at any point of a surface from labelled surfels, with soft shadow edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from lightsim.appearance.intrinsic.labels import (
    Labels,
    ObservedSurfels,
    is_at_label_edge,
    rendered_visibility,
    smoothed,
)
from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.core.found_visibility import decided
from lightsim.core.mesh import TriMesh

# The values below were chosen on log 002 and synthetic street 0; their sensitivity was not
# measured.

# Number of surfels that are interpolated at a point.
_LABEL_NEIGHBOURS = 6
# Number of surfels with certain labels whose mean is the base colour beside an edge.
_COLOUR_NEIGHBOURS = 32
# Greatest distance of the nearest of these surfels, in metres.
_REACH_M = 1.2
# A label is certain if its probability is within this distance of 0 or 1.
_CERTAIN = 0.03
# Prior probability of being lit below which a rendered shadow is near.
_NEAR_SHADOW = 0.75
# Points processed together: some 30 MB of intermediate results for any log.
_CHUNK = 1 << 15


@dataclass(frozen=True, eq=False)
class LabelField:
    """Labels and base colours of surfels, for interpolation. Made by `label_field`.

    Args:
        faces: indices of the mesh's faces that the surfels sample.
        tree: positions of the surfels.
        normal: unit normals.
        lit: probability that the sun reaches each surfel.
        log_colour: log base colour of the firmly labelled surface around each surfel.
        is_known: mask of surfels with such a surface in reach.
        is_mixed: mask of surfels at a certain or possible shadow edge.
        surfel_m: size of a surfel.
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
    faces: Int64[np.ndarray, " k"], observed: ObservedSurfels, labels: Labels, edge_error_m: float
) -> LabelField:
    """Prepare labelled surfels for `refine_visibility`; `edge_error_m` as in `IntrinsicConfig`."""
    surfels = observed.surfels
    light = np.maximum(observed.light.total(labels.lit), 1e-6)
    log_colour = observed.log_radiance - np.log(light)
    # Labels of dark objects in full light (panes, tyres) are uncertain, too, so an edge requires a
    # rendered shadow near it.
    is_unsure = (labels.lit > _CERTAIN) & (labels.lit < 1 - _CERTAIN)
    is_unsure &= labels.prior < _NEAR_SHADOW
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


def _is_at_thin_shadow(observed: ObservedSurfels, edge_error_m: float) -> Bool[np.ndarray, " n"]:
    """Return the mask of patches near a rendered shadow or gap narrower than its position error.

    Examples are the shadow of a post and the gap between two posts. Patches are too large for them;
    texels resolve them.
    """
    graph, rendered = observed.graph, rendered_visibility(observed.light)
    is_thin = (rendered > 0.5) != (smoothed(rendered, graph, edge_error_m) > 0.5)
    near = graph.pairs[graph.distance_m < edge_error_m]
    result = is_thin.copy()
    result[near[is_thin[near].any(axis=1)].ravel()] = True
    return result


def _colour_around(
    observed: ObservedSurfels,
    log_colour: Float64[np.ndarray, "n 3"],
    is_firm: Bool[np.ndarray, " n"],
    is_mixed: Bool[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the mean log base colour of certain surfels around each edge surfel, and a mask of
    edge surfels that have any."""
    position, normal = observed.surfels.position, observed.surfels.normal
    is_chosen = is_mixed.copy()
    touched = observed.graph.pairs[is_mixed[observed.graph.pairs].any(axis=1)]
    is_chosen[touched.ravel()] = True
    is_known, result = is_firm.copy(), log_colour.copy()
    all_rows, firm = np.flatnonzero(is_chosen), np.flatnonzero(is_firm)
    if len(all_rows) == 0 or len(firm) == 0:
        return result, is_known
    surfels = KDTree(position[firm]), normal[firm]
    step = _CHUNK * _LABEL_NEIGHBOURS // _COLOUR_NEIGHBOURS
    for start in range(0, len(all_rows), step):
        rows = all_rows[start : start + step]
        index, fraction, distance = _around(
            surfels, position[rows], normal[rows], _COLOUR_NEIGHBOURS, _REACH_M / 2
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
    """Nearest surfels, their weights (large for near ones of similar normal), and the least
    distance."""
    tree, normal = surfels
    distance, index = (np.asarray(part) for part in tree.query(points, k=min(count, tree.n)))
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    facing = np.clip((normal[index] * normals[:, None]).sum(axis=2), 0.0, 1.0)
    near = np.exp(-0.5 * ((distance - distance[:, :1]) / width_m) ** 2)
    fraction = near * (facing**4 + 1e-4)
    return index.astype(np.int64), fraction / fraction.sum(axis=1, keepdims=True), distance[:, 0]


@dataclass(frozen=True, eq=False)
class ShadedPoints:
    """Surface samples with radiance and light, all linear RGB.

    Args:
        points, normals: in the frame of the mesh.
        radiance: observed.
        diffuse: light without the sun, irradiance / pi.
        direct: light of the unoccluded sun, irradiance / pi.
        reflected: specular radiance without the sun.
        reflected_sun: specular radiance of the unoccluded sun.
    """

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    radiance: Float32[np.ndarray, "n 3"]
    diffuse: Float32[np.ndarray, "n 3"]
    direct: Float32[np.ndarray, "n 3"]
    reflected: Float32[np.ndarray, "n 3"]
    reflected_sun: Float32[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def vertices_of(mesh: TriMesh, light: SurfaceLight) -> ShadedPoints:
        """Return the vertices of a mesh, whose `base_colour` holds radiance, under a light."""
        reflected = light.reflections
        return ShadedPoints(
            mesh.vertices,
            mesh.vertex_normals().astype(np.float32),
            mesh.base_colour,
            light.diffuse.astype(np.float32),
            light.sun,
            reflected.rest,
            reflected.sun,
        )

    def at(self, rows: slice | Int64[np.ndarray, " m"]) -> ShadedPoints:
        """Return the chosen points."""
        return ShadedPoints(*(values[rows] for values in vars(self).values()))

    def between(
        self,
        corners: Int32[np.ndarray, "t 3"],
        barycentric: Float32[np.ndarray, "t 3"],
        radiance: Float32[np.ndarray, "t 3"],
    ) -> ShadedPoints:
        """Interpolate at points inside triangles; their radiance is given."""
        weights = barycentric[:, :, None]
        found = {
            name: (weights * values[corners]).sum(axis=1)
            for name, values in vars(self).items()
            if name != "radiance"
        }
        # Texels beyond a face's long edge are extrapolated, and could become negative.
        found["diffuse"] = np.maximum(found["diffuse"], 1e-6)
        found["direct"] = np.maximum(found["direct"], 0.0)
        return ShadedPoints(radiance=radiance, **found)


def refine_visibility(field: LabelField, seen: ShadedPoints) -> Float32[np.ndarray, " n"]:
    """Return the sun visibility of each point, in [0, 1].

    Away from edges it is interpolated from the labels of the surfels around. Near an edge it is
    solved for: the point's base colour must equal that of the certain surfels around it. The edge
    and its penumbra then have the resolution of the radiance.
    """
    result = np.empty(len(seen), dtype=np.float32)
    for start in range(0, len(seen), _CHUNK):
        rows = slice(start, start + _CHUNK)
        result[rows] = _refine(field, seen.at(rows))
    return result


def _refine(field: LabelField, seen: ShadedPoints) -> Float32[np.ndarray, " n"]:
    surfels = (field.tree, field.normal)
    index, fraction, _ = _around(
        surfels, seen.points, seen.normals, _LABEL_NEIGHBOURS, 0.6 * field.surfel_m
    )
    lit = (fraction * field.lit[index]).sum(axis=1)
    known = (fraction * field.is_known[index]).sum(axis=1)
    colour = fraction * field.is_known[index]
    colour = (colour[:, :, None] * field.log_colour[index]).sum(axis=1)
    colour = np.exp(colour / np.maximum(known, 1e-9)[:, None])
    diffuse = seen.diffuse + seen.reflected / colour
    direct = seen.direct + seen.reflected_sun / colour
    # Least squares over the channels of radiance / colour = diffuse + visibility * direct.
    wanted = ((seen.radiance / colour - diffuse) * direct).sum(axis=1)
    found = wanted / np.maximum((direct**2).sum(axis=1), 1e-12)
    is_edge = field.is_mixed[index].any(axis=1) & (known > 0.3)
    return decided(np.where(is_edge, found, lit))
