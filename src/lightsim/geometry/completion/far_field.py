"""Background proxy beyond the LiDAR's range: a coarse skyline from images, on extended ground.

Rays along which images show a surface, but that meet no measured or inferred surface, end on an
upright cylinder around the path. A log is short, so parallax is small at such distances and the
exact distance hardly affects images. The proxy occludes a low sun as the real skyline does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.core.casting import MakeCaster, RayCaster, check_world
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.view_evidence import View, ViewEvidence
from lightsim.geometry.surface import quad_mesh

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).


class _Panels:
    """The cylinder of the background proxy and the evidence of its cells."""

    distance_m = 160.0  # Least radius around the middle of the path.
    margin_m = 20.0  # Least distance beyond all measured surfaces.
    azimuth_step_deg = 0.5  # Width of a panel.
    level_m = 1.0  # Height of a level.
    below_path_m = 2.0  # Height of the lowest border below the lowest camera position.
    max_height_m = 90.0  # Height of the cylinder.
    quad_m = 2.0  # Height of the quads of a panel: colours are per face.
    same_roof_m = 3.0  # Greatest difference between adjacent heights without a step.
    foot_m = 3.0  # Depth of the panels' foot below the ground, against gaps.
    min_views = 2  # Least number of views of a cell that show a surface.
    min_surface_fraction = 0.5  # Least fraction of views of a cell that show a surface.
    columns_used = 480  # Pixels used of an image row, about.
    # Width in used pixels below which a strip beside a near surface is ignored: it is an unmeasured
    # edge of that surface (a cornice) and would be placed far behind it.
    fringe = 3


class _Ground:
    """Extension of the ground."""

    inner_m = 30.0  # Distance from the path at which it begins; `ground` closes nearer holes.
    step_m = 4.0  # Edge of its quads.
    sink_m = 0.15  # Depth below the ground map, so that measured surface is visible.
    cover_m = 1.5  # Height from which rays search measured ground above.
    min_cells = 10  # Least number of observed cells for a plane fit; else the map is used.
    plane_scale_m = 0.3  # Scale of the fit's residuals; weights decrease beyond (Cauchy).
    off_plane_m = 1.5  # Greatest residual of ground; roofs and slopes deviate by more.
    blend_m = 8.0  # Distance over which the height changes from the map to the plane.


@dataclass(eq=False)
class _BackgroundProxy:
    """Number of views that show surface or sky, for each panel and level [azimuth, height]."""

    centre: Float64[np.ndarray, "3"]
    radius_m: float
    surface_views: Int64[np.ndarray, "a h"]
    sky: Int64[np.ndarray, "a h"]
    low_m: float


def build_far_field(
    background: TriMesh,
    evidence: ViewEvidence,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    *,
    make_caster: MakeCaster,
) -> TriMesh:
    """Build the background proxy and the extended ground, frame world, black.

    Args:
        background: measured and inferred surfaces, frame world.
        evidence: the views of the log.
        ground: map whose heights are continued outwards.
        path_m: positions of the recording vehicle.
        make_caster: builds the ray caster.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    check_world([background])
    proxy = _empty_proxy(background, path_m)
    extended = _extend_ground(background, ground, path_m, proxy, make_caster)
    caster = make_caster([background, extended])
    for view in evidence.views():
        _count_cells(proxy, view, caster)
    panels = _mesh_panels(proxy, _skyline(proxy), ground)
    return concatenate_meshes([extended, panels]).with_provenance(Provenance.BACKGROUND_PROXY)


def _empty_proxy(background: TriMesh, path_m: Float[np.ndarray, "k 3"]) -> _BackgroundProxy:
    centre = 0.5 * (path_m.min(axis=0) + path_m.max(axis=0)).astype(np.float64)
    places = np.concatenate([background.vertices[:, :2].astype(np.float64), path_m[:, :2]])
    reach = float(np.linalg.norm(places - centre[:2], axis=1).max())
    radius = max(_Panels.distance_m, reach + _Panels.margin_m)
    shape = (
        round(360.0 / _Panels.azimuth_step_deg),
        int(np.ceil(_Panels.max_height_m / _Panels.level_m)),
    )
    none = np.zeros(shape, dtype=np.int64)
    low = float(path_m[:, 2].min()) - _Panels.below_path_m
    return _BackgroundProxy(centre, radius, none, none.copy(), low)


def _count_cells(proxy: _BackgroundProxy, view: View, caster: RayCaster) -> None:
    """Count the cells of the proxy that one view shows as surface or as sky, each cell once."""
    from scipy.ndimage import maximum_filter, minimum_filter

    frame, camera, kind = view.frame, view.camera, view.classes
    step = max(1, round(camera.width_px / _Panels.columns_used))
    kind = kind[::step, ::step].copy()
    origins, rays = frame.pixel_rays(camera, camera.pixel_centres()[::step, ::step].reshape(-1, 2))
    surface_pixels = np.flatnonzero(kind < 0)
    is_hit = caster.intersect(origins[surface_pixels], rays[surface_pixels]).is_hit
    is_near, is_beyond = (np.zeros(kind.shape, dtype=bool) for _ in range(2))
    is_near.flat[surface_pixels[is_hit]] = is_beyond.flat[surface_pixels[~is_hit]] = True
    is_wide = np.asarray(
        maximum_filter(minimum_filter(is_beyond, _Panels.fringe), _Panels.fringe), dtype=bool
    )
    is_fringe = maximum_filter(is_near, _Panels.fringe) & ~is_wide
    kind[(kind < 0) & (~is_beyond | is_fringe)] = 0
    kind = kind.ravel()
    origins, rays, kind = origins[kind != 0], rays[kind != 0], kind[kind != 0]
    offset = origins[:, :2] - proxy.centre[:2]
    # Intersection of the rays with the cylinder, a quadratic equation in plan.
    a = (rays[:, :2] ** 2).sum(axis=1)
    b = (rays[:, :2] * offset).sum(axis=1)
    c = (offset**2).sum(axis=1) - proxy.radius_m**2
    distance = (-b + np.sqrt(b * b - a * c)) / np.maximum(a, 1e-9)
    place = offset + distance[:, None] * rays[:, :2]
    azimuth = np.degrees(np.arctan2(place[:, 1], place[:, 0])) % 360.0
    count = proxy.surface_views.shape
    i = (azimuth / _Panels.azimuth_step_deg).astype(np.int64) % count[0]
    height = origins[:, 2] + distance * rays[:, 2] - proxy.low_m
    j = np.floor(height / _Panels.level_m).astype(np.int64)
    # Surface below the horizon counts as the lowest level: a descending road ends there.
    j = np.where(kind < 0, np.maximum(j, 0), j)
    is_inside = (j >= 0) & (j < count[1])
    flat = i[is_inside] * count[1] + j[is_inside]
    for table, sign in ((proxy.surface_views, -1), (proxy.sky, 1)):
        seen = np.unique(flat[kind[is_inside] == sign])
        table.reshape(-1)[seen] += 1


def _skyline(proxy: _BackgroundProxy) -> Float64[np.ndarray, " a"]:
    """Return the height of each panel above the lowest level; 0 without a panel."""
    from scipy.ndimage import median_filter

    seen = proxy.surface_views + proxy.sky
    is_surface = (proxy.surface_views >= _Panels.min_views) & (
        proxy.surface_views >= _Panels.min_surface_fraction * np.maximum(seen, 1)
    )
    levels = np.arange(is_surface.shape[1])
    is_sky = (proxy.sky >= _Panels.min_views) & ~is_surface
    first_sky = np.where(is_sky.any(axis=1), is_sky.argmax(axis=1), len(levels))
    is_below = is_surface & (levels < first_sky[:, None])
    top = np.where(is_below.any(axis=1), np.where(is_below, levels + 1, 0).max(axis=1), 0)
    top = np.asarray(median_filter(top, 3, mode="wrap"))
    return top.astype(np.float64) * _Panels.level_m


def _slanted(height_m: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, "a 2"]:
    """Return the height of each panel at its right and left end, joined to similar neighbours."""

    def side(neighbour: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, " a"]:
        is_same = (np.abs(neighbour - height_m) <= _Panels.same_roof_m) & (neighbour > 0)
        return np.where(is_same, 0.5 * (neighbour + height_m), height_m)

    return np.stack([side(np.roll(height_m, 1)), side(np.roll(height_m, -1))], axis=1)


def _mesh_panels(
    proxy: _BackgroundProxy,
    height_m: Float64[np.ndarray, " a"],
    ground: GroundMap,
) -> TriMesh:
    """Return upright quads from below the ground to the skyline, facing the path."""
    panel = np.flatnonzero(height_m > 0)
    angle = np.radians(_Panels.azimuth_step_deg * np.stack([panel, panel + 1], axis=1))
    xy = proxy.centre[:2] + proxy.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    top = proxy.low_m + _slanted(height_m)[panel]
    foot = _continued_height(ground, xy.reshape(-1, 2)).min() if len(panel) else 0.0
    low = np.minimum(foot, top.min(axis=1)) - _Panels.foot_m
    count = np.maximum(np.ceil((top.max(axis=1) - low) / _Panels.quad_m), 1).astype(np.int64)
    row = np.repeat(np.arange(len(panel)), count)
    part = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count))[:, None]
    rise = ((top - low[:, None]) / count[:, None])[row]
    z0 = low[row][:, None] + part * rise
    z = np.concatenate([z0[:, ::-1], (z0 + rise)], axis=1)
    # Counter-clockwise from the centre of the path: azimuth increases to the left.
    corners = np.concatenate([xy[row][:, [1, 0, 0, 1]], z[:, :, None]], axis=2).reshape(-1, 3)
    return quad_mesh(corners, np.arange(len(corners)).reshape(-1, 4))


def _extend_ground(
    background: TriMesh,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    proxy: _BackgroundProxy,
    make_caster: MakeCaster,
) -> TriMesh:
    """Return ground slightly below the map, up to the proxy, where no ground was measured."""
    from scipy.spatial import KDTree

    step = _Ground.step_m
    count = int(np.ceil(2 * proxy.radius_m / step)) + 1
    axis = step * (np.arange(count) - (count - 1) / 2)
    xy = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1) + proxy.centre[:2]
    flat = xy.reshape(-1, 2)
    height = _continued_height(ground, flat) - _Ground.sink_m
    points = np.concatenate([flat, height[:, None]], axis=1)
    index = np.arange(count * count).reshape(count, count)
    quads = np.stack(
        [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1
    ).reshape(-1, 4)
    middle = points[quads].mean(axis=1)
    is_used = np.linalg.norm(middle[:, :2] - proxy.centre[:2], axis=1) < proxy.radius_m
    distance, _ = KDTree(path_m[:, :2]).query(middle[:, :2])
    is_used &= np.asarray(distance) > _Ground.inner_m
    quads, middle = quads[is_used], middle[is_used]
    # Quads whose corners all lie under measured ground are dropped.
    start = points[quads].reshape(-1, 3) + np.array([0.0, 0.0, _Ground.cover_m])
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape).copy()
    hits = make_caster([background]).intersect(start, down)
    is_covered = (hits.distance_m < _Ground.cover_m).reshape(-1, 4).all(axis=1)
    return quad_mesh(points, quads[~is_covered])


def _continued_height(
    ground: GroundMap, xy: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, " n"]:
    """Return the height of the ground map near observed ground, and of a plane fitted to it beyond.

    Roofs and slopes that were classified as ground are outliers of the fit.
    """
    from scipy.spatial import KDTree

    cells = np.argwhere(ground.is_observed)
    if len(cells) < _Ground.min_cells:
        return ground.look_up(xy).astype(np.float64)
    places = ground.origin_m + ground.cell_m * cells
    z = ground.height_m[ground.is_observed].astype(np.float64)
    terms = np.concatenate([places, np.ones((len(cells), 1))], axis=1)
    weight = np.ones(len(z))
    plane = np.zeros(3)
    for _ in range(10):
        plane = np.linalg.lstsq(terms * weight[:, None], z * weight, rcond=None)[0]
        weight = 1.0 / np.sqrt(1.0 + ((z - terms @ plane) / _Ground.plane_scale_m) ** 2)
    is_ground = np.abs(z - terms @ plane) < _Ground.off_plane_m
    distance, nearest = KDTree(places[is_ground]).query(xy)
    fraction = np.exp(-np.asarray(distance) / _Ground.blend_m)
    far = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ plane
    return fraction * z[is_ground][nearest] + (1.0 - fraction) * far
