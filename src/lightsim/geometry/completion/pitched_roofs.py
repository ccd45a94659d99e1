"""Pitched roofs: measured slopes are continued beyond their ridge, and end the walls below them.

A LiDAR measures the slope that faces the road. The other side is assumed to be its mirror image, so
gables, hips and half-measured ends keep their shape. Walls end at a measured roof above them, and
no flat roof is inferred there (`wall_cells`, `rooflines`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, Delaunay

from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.materials import FACADE, VEGETATION
from lightsim.geometry.surface import make_mesh

# The values below were chosen on street suburban 21; only their joint effect was measured.

# Vertical component of a slope's normal: 15 to 60 degrees of pitch.
_NORMAL_Z = (0.5, 0.966)
# Least cosine between the normals of adjacent faces of one slope.
_SAME_COSINE = 0.966
# Least height of a roof above the ground, in metres.
_MIN_HEIGHT_M = 2.0
# Least area of a slope, in square metres: smaller ones are porches.
_MIN_AREA_M2 = 6.0
# Minimum length from eave to ridge in plan, in metres: shorter slopes are only partly measured.
_MIN_RUN_M = 2.0
# Minimum length along the eave, in metres: the inferred body begins `_BEHIND_M` from both ends.
_MIN_LENGTH_M = 3.0
# Largest RMS distance of the faces from their plane, in metres.
_ROUGH_M = 0.15
# Distance within which the ground, or a wall that a lean-to stands at, would continue a slope, in
# metres.
_BESIDE_M = 1.5
# Depth of the inferred roof below the measured slope, in metres, so that it casts no shadow on it.
_BELOW_M = 0.08
# Distance of the inferred house behind the eaves, in metres: eaves overhang walls by up to a metre,
# and measured walls must not be shaded.
_BEHIND_M = 1.2


@dataclass(frozen=True, eq=False)
class PitchedRoof:
    """A measured slope and its assumed mirror image, frame world.

    Args:
        corners_m: corners of the slope's outline, on its plane.
        middle_m: a point of its plane.
        uphill: horizontal unit vector towards the ridge.
        rise: rise over run.
        ridge_m: distance of the ridge from `middle_m` along `uphill`.
        ground_m: height of the ground.
    """

    corners_m: Float64[np.ndarray, "n 3"]
    middle_m: Float64[np.ndarray, "3"]
    uphill: Float64[np.ndarray, "3"]
    rise: float
    ridge_m: float
    ground_m: float

    @cached_property
    def outline_m(self) -> Float64[np.ndarray, "m 3"]:
        """Corners of both slopes."""
        uphill_m = (self.corners_m - self.middle_m) @ self.uphill
        mirrored = self.corners_m + 2.0 * (self.ridge_m - uphill_m)[:, None] * self.uphill
        return np.concatenate([self.corners_m, mirrored])

    def height_m(self, places_m: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
        """Return z of the roof, in metres, at the x and y of points; infinite outside its plan."""
        uphill_m = (places_m - self.middle_m) @ self.uphill
        uphill_m = np.minimum(uphill_m, 2.0 * self.ridge_m - uphill_m)
        is_under = self._plan.find_simplex(places_m[:, :2]) >= 0
        return np.where(is_under, self.middle_m[2] + self.rise * uphill_m, np.inf)

    @cached_property
    def _plan(self) -> Delaunay:
        return Delaunay(self.outline_m[:, :2])

    def solid(self) -> list[TriMesh]:
        """Return the unmeasured parts: the body of the roof, and the house below it; inferred."""
        roof = self.outline_m - [0.0, 0.0, _BELOW_M]
        inner = _moved_inwards(roof - self.middle_m, _along(self.uphill)) + self.middle_m
        house = _moved_inwards(inner - self.middle_m, self.uphill) + self.middle_m
        eave_m = inner[:, 2].min()
        body = np.concatenate([house, house])
        body[:, 2] = np.repeat([self.ground_m, eave_m], len(house))
        return [_hull(inner), _hull(body)]


def find_pitched_roofs(
    background: TriMesh, ground: GroundMap, caster: RayCaster
) -> list[PitchedRoof]:
    """Find measured slopes that end freely at their eave and at their ridge.

    Args:
        background: measured surface, frame world.
        ground: reference of heights.
        caster: over `background`.
    """
    roofs = []
    for rows in _slopes(background, ground):
        roof = _roof_of(background, rows, ground, caster)
        roofs += [] if roof is None else [roof]
    return roofs


def lowest_roof_m(
    roofs: Sequence[PitchedRoof], places_m: Float64[np.ndarray, "p 3"]
) -> Float64[np.ndarray, " p"]:
    """Return the height of the lowest roof at each place; infinite without one."""
    heights = [np.full(len(places_m), np.inf), *(roof.height_m(places_m) for roof in roofs)]
    return np.min(heights, axis=0)


def _slopes(mesh: TriMesh, ground: GroundMap) -> list[Int64[np.ndarray, " f"]]:
    """Return the faces of each connected sloping surface, largest first."""
    normals, area = mesh.face_normals().astype(np.float64), mesh.face_areas_m2()
    middle = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    height_m = middle[:, 2] - ground.look_up(middle[:, :2])
    is_used = (normals[:, 2] > _NORMAL_Z[0]) & (normals[:, 2] < _NORMAL_Z[1])
    is_used &= (height_m > _MIN_HEIGHT_M) & mesh.has_provenance(Provenance.MEASURED)
    is_used &= ~_is_leaf(mesh)
    rows = np.flatnonzero(is_used)
    if not len(rows):
        return []
    number = _connected(mesh.faces[rows].astype(np.int64), normals[rows])
    total = np.bincount(number, area[rows])
    return [
        rows[number == k]
        for k in np.argsort(-total, kind="stable").tolist()
        if total[k] > _MIN_AREA_M2
    ]


def _is_leaf(mesh: TriMesh) -> Bool[np.ndarray, " m"]:
    if mesh.face_material is None:
        return np.zeros(len(mesh.faces), dtype=bool)
    leaves = [k for k, material in enumerate(mesh.materials) if material == VEGETATION]
    return np.isin(mesh.face_material, leaves)


def _connected(
    faces: Int64[np.ndarray, "f 3"], normals: Float64[np.ndarray, "f 3"]
) -> Int64[np.ndarray, " f"]:
    """Number the surfaces of faces that share an edge and a direction."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    is_same = (np.diff(edges[order], axis=0) == 0).all(axis=1)
    one, other = owner[order][:-1][is_same], owner[order][1:][is_same]
    is_alike = (normals[one] * normals[other]).sum(axis=1) > _SAME_COSINE
    links = (np.ones(is_alike.sum()), (one[is_alike], other[is_alike]))
    return connected_components(coo_matrix(links, (len(faces),) * 2), directed=False)[1].astype(
        np.int64
    )


def _roof_of(
    mesh: TriMesh, rows: Int64[np.ndarray, " f"], ground: GroundMap, caster: RayCaster
) -> PitchedRoof | None:
    """Return the roof of one slope; None if it is no plane, too short, or does not end freely."""
    area = mesh.face_areas_m2()[rows]
    middles = mesh.vertices[mesh.faces[rows]].mean(axis=1).astype(np.float64)
    normal = area @ mesh.face_normals()[rows]
    normal /= np.linalg.norm(normal)
    middle = area @ middles / area.sum()
    off_m = (middles - middle) @ normal
    uphill = np.array([-normal[0], -normal[1], 0.0])
    run = np.linalg.norm(uphill)
    if np.sqrt(area @ off_m**2 / area.sum()) > _ROUGH_M or run == 0:
        return None
    uphill /= run
    corners = mesh.vertices[np.unique(mesh.faces[rows])].astype(np.float64)
    uphill_m = (corners - middle) @ uphill
    low, high = np.percentile(uphill_m, [1.0, 99.0])
    length_m = np.ptp(corners @ _along(uphill))
    if high - low < _MIN_RUN_M or length_m < _MIN_LENGTH_M:
        return None
    if not _is_free(corners, uphill_m, uphill, caster):
        return None
    rise = float(run / normal[2])
    outline = corners[ConvexHull(corners[:, :2]).vertices]
    beyond_m = (outline - middle) @ uphill - high
    outline -= np.maximum(beyond_m, 0.0)[:, None] * uphill
    outline[:, 2] = middle[2] + rise * (np.minimum(beyond_m, 0.0) + high)
    ground_m = float(ground.look_up(middle[None, :2])[0])
    return PitchedRoof(outline, middle, uphill, rise, float(high), ground_m)


def _is_free(
    corners: Float64[np.ndarray, "n 3"],
    uphill_m: Float64[np.ndarray, " n"],
    uphill: Float64[np.ndarray, "3"],
    caster: RayCaster,
) -> bool:
    """Return whether the slope neither lies on the ground nor leans against a wall."""
    eave = corners[uphill_m <= np.percentile(uphill_m, 20.0)] - 0.5 * _BESIDE_M * uphill
    ridge = corners[uphill_m >= np.percentile(uphill_m, 80.0)] + [0.0, 0.0, 0.5 * _BESIDE_M]
    return not (_meets(caster, eave, np.array([0.0, 0.0, -1.0])) or _meets(caster, ridge, uphill))


def _meets(
    caster: RayCaster, starts: Float64[np.ndarray, "n 3"], way: Float64[np.ndarray, "3"]
) -> bool:
    """Return whether most rays along `way` meet surface soon."""
    hits = caster.intersect(starts, np.broadcast_to(way, starts.shape).copy())
    return bool(np.mean(hits.distance_m < _BESIDE_M) > 0.5)


def _along(uphill: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return the horizontal direction of the eave."""
    return np.array([-uphill[1], uphill[0], 0.0])


def _moved_inwards(
    offset_m: Float64[np.ndarray, "n 3"], way: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return points with both ends along `way` cut by `_BEHIND_M`."""
    at = offset_m @ way
    low, high = at.min() + _BEHIND_M, at.max() - _BEHIND_M
    inside = np.clip(at, low, high) if low < high else np.full(len(at), (low + high) / 2)
    return offset_m + (inside - at)[:, None] * way


def _hull(points: Float64[np.ndarray, "n 3"]) -> TriMesh:
    """Return the convex hull, outward faces counter-clockwise; inferred, black."""
    hull = ConvexHull(points, qhull_options="QJ")
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    corners = points[used]
    first, second, third = (corners[faces[:, k]] for k in range(3))
    outward = (np.cross(second - first, third - first) * (first - corners.mean(axis=0))).sum(axis=1)
    faces[outward < 0] = faces[outward < 0][:, ::-1]
    mesh = replace(make_mesh("world", corners, faces), materials=(FACADE,))
    return mesh.with_provenance(Provenance.INFERRED)
