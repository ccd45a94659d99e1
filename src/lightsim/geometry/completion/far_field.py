"""Background proxy beyond the LiDAR's range: a coarse skyline from images, on extended ground.

Directions in which images show a surface but nothing was measured or inferred end on an upright
cylinder around the path. A log is short, so parallax at such distances is small and the exact
distance hardly affects images; a low sun sets behind the proxy as it does behind the real skyline.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.core.casting import MakeCaster, RayCaster, check_world
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views
from lightsim.geometry.surface import quad_mesh

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Least radius of the cylinder around the middle of the path, in metres.
_DISTANCE_M = 160.0
# Least distance of the cylinder beyond all measured surfaces, in metres.
_MARGIN_M = 20.0
# Width of a panel of the cylinder, in degrees.
_AZIMUTH_STEP_DEG = 0.5
# Height of a level, in metres.
_LEVEL_M = 1.0
# Height of the levels' lowest border below the lowest camera position, in metres.
_BELOW_PATH_M = 2.0
# Height of the quads that a panel consists of, in metres: colours are per face.
_PANEL_M = 2.0
# Adjacent panels whose heights differ by less are joined without a step, in metres.
_SAME_ROOF_M = 3.0
# Height of the cylinder, in metres.
_MAX_HEIGHT_M = 90.0
# Depth of the panels' foot below the ground, in metres, so that no gap opens there.
_FOOT_M = 3.0
# Least number of views that decide a cell.
_MIN_VIEWS = 2
# Least fraction of the views of a cell that must show a surface.
_MIN_MATTER = 0.5
# Number of pixels used of an image row, about.
_COLUMNS_USED = 480
# Width in used pixels below which a strip beside a near surface is ignored: it is an unmeasured
# edge of that surface (a cornice) and would be placed far behind it.
_FRINGE = 3
# Distance from the path at which the extended ground begins, in metres; `ground` closes holes
# nearer.
_INNER_M = 30.0
# Edge of the extended ground's quads, in metres.
_GROUND_STEP_M = 4.0
# Depth of the extended ground below the ground map, in metres, so that measured surface is visible.
_SINK_M = 0.15
# Height from which rays search measured ground above the extended ground, in metres.
_COVER_M = 1.5
# Least number of observed ground cells for the plane fit; with fewer the map itself is used.
_MIN_CELLS = 10
# Scale of the plane fit's residuals, in metres; weights fall off beyond (Cauchy).
_PLANE_SCALE_M = 0.3
# Greatest residual of ground, in metres; roofs and slopes differ by more.
_OFF_PLANE_M = 1.5
# Distance over which the continued height changes from the map to the plane, in metres.
_BLEND_M = 8.0


@dataclass(eq=False)
class _BackgroundProxy:
    """Number of views that show surface or sky, for each panel and level [azimuth, height]."""

    centre: Float64[np.ndarray, "3"]
    radius_m: float
    matter: Int64[np.ndarray, "a h"]
    sky: Int64[np.ndarray, "a h"]
    low_m: float


def build_far_field(
    background: TriMesh,
    silhouettes: Iterable[View],
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    *,
    make_caster: MakeCaster,
) -> TriMesh:
    """Build the background proxy and the extended ground, frame world, black.

    Args:
        background: measured and inferred surfaces, frame world.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
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
    for view in classified_views(silhouettes):
        _look(proxy, view, caster)
    panels = _mesh_panels(proxy, _skyline(proxy), ground)
    return concatenate_meshes([extended, panels]).with_provenance(Provenance.BACKGROUND_PROXY)


def _empty_proxy(background: TriMesh, path_m: Float[np.ndarray, "k 3"]) -> _BackgroundProxy:
    centre = 0.5 * (path_m.min(axis=0) + path_m.max(axis=0)).astype(np.float64)
    places = np.concatenate([background.vertices[:, :2].astype(np.float64), path_m[:, :2]])
    reach = float(np.linalg.norm(places - centre[:2], axis=1).max())
    radius = max(_DISTANCE_M, reach + _MARGIN_M)
    shape = (
        round(360.0 / _AZIMUTH_STEP_DEG),
        int(np.ceil(_MAX_HEIGHT_M / _LEVEL_M)),
    )
    none = np.zeros(shape, dtype=np.int64)
    low = float(path_m[:, 2].min()) - _BELOW_PATH_M
    return _BackgroundProxy(centre, radius, none, none.copy(), low)


def _look(proxy: _BackgroundProxy, view: ClassifiedView, caster: RayCaster) -> None:
    """Count the cells of the proxy that one view shows as surface or as sky, each cell once."""
    from scipy.ndimage import maximum_filter, minimum_filter

    frame, camera, kind = view
    step = max(1, round(camera.width_px / _COLUMNS_USED))
    kind = kind[::step, ::step].copy()
    origins, rays = frame.pixel_rays(camera, camera.pixel_centres()[::step, ::step].reshape(-1, 2))
    matter = np.flatnonzero(kind < 0)
    is_hit = caster.intersect(origins[matter], rays[matter]).is_hit
    is_near, is_beyond = (np.zeros(kind.shape, dtype=bool) for _ in range(2))
    is_near.flat[matter[is_hit]] = is_beyond.flat[matter[~is_hit]] = True
    is_wide = np.asarray(maximum_filter(minimum_filter(is_beyond, _FRINGE), _FRINGE), dtype=bool)
    is_fringe = maximum_filter(is_near, _FRINGE) & ~is_wide
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
    count = proxy.matter.shape
    i = (azimuth / _AZIMUTH_STEP_DEG).astype(np.int64) % count[0]
    height = origins[:, 2] + distance * rays[:, 2] - proxy.low_m
    j = np.floor(height / _LEVEL_M).astype(np.int64)
    # Surface below the horizon counts as the lowest level: a descending road ends there.
    j = np.where(kind < 0, np.maximum(j, 0), j)
    is_inside = (j >= 0) & (j < count[1])
    flat = i[is_inside] * count[1] + j[is_inside]
    for table, sign in ((proxy.matter, -1), (proxy.sky, 1)):
        seen = np.unique(flat[kind[is_inside] == sign])
        table.reshape(-1)[seen] += 1


def _skyline(proxy: _BackgroundProxy) -> Float64[np.ndarray, " a"]:
    """Return the height of each panel above the lowest level; 0 without a panel."""
    from scipy.ndimage import median_filter

    seen = proxy.matter + proxy.sky
    is_matter = (proxy.matter >= _MIN_VIEWS) & (proxy.matter >= _MIN_MATTER * np.maximum(seen, 1))
    levels = np.arange(is_matter.shape[1])
    is_sky = (proxy.sky >= _MIN_VIEWS) & ~is_matter
    first_sky = np.where(is_sky.any(axis=1), is_sky.argmax(axis=1), len(levels))
    is_below = is_matter & (levels < first_sky[:, None])
    top = np.where(is_below.any(axis=1), np.where(is_below, levels + 1, 0).max(axis=1), 0)
    top = np.asarray(median_filter(top, 3, mode="wrap"))
    return top.astype(np.float64) * _LEVEL_M


def _slanted(height_m: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, "a 2"]:
    """Return the height of each panel at its right and left end, averaged with the neighbour's
    height if the difference is below `_SAME_ROOF_M`."""

    def side(neighbour: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, " a"]:
        is_same = (np.abs(neighbour - height_m) <= _SAME_ROOF_M) & (neighbour > 0)
        return np.where(is_same, 0.5 * (neighbour + height_m), height_m)

    return np.stack([side(np.roll(height_m, 1)), side(np.roll(height_m, -1))], axis=1)


def _mesh_panels(
    proxy: _BackgroundProxy,
    height_m: Float64[np.ndarray, " a"],
    ground: GroundMap,
) -> TriMesh:
    """Return upright quads from below the ground to the skyline, facing the path."""
    panel = np.flatnonzero(height_m > 0)
    angle = np.radians(_AZIMUTH_STEP_DEG * np.stack([panel, panel + 1], axis=1))
    xy = proxy.centre[:2] + proxy.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    top = proxy.low_m + _slanted(height_m)[panel]
    foot = _continued_height(ground, xy.reshape(-1, 2)).min() if len(panel) else 0.0
    low = np.minimum(foot, top.min(axis=1)) - _FOOT_M
    count = np.maximum(np.ceil((top.max(axis=1) - low) / _PANEL_M), 1).astype(np.int64)
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
    """Return ground from near the path to the proxy where none was measured, slightly below the
    map."""
    from scipy.spatial import KDTree

    step = _GROUND_STEP_M
    count = int(np.ceil(2 * proxy.radius_m / step)) + 1
    axis = step * (np.arange(count) - (count - 1) / 2)
    xy = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1) + proxy.centre[:2]
    flat = xy.reshape(-1, 2)
    height = _continued_height(ground, flat) - _SINK_M
    points = np.concatenate([flat, height[:, None]], axis=1)
    index = np.arange(count * count).reshape(count, count)
    quads = np.stack(
        [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1
    ).reshape(-1, 4)
    middle = points[quads].mean(axis=1)
    is_used = np.linalg.norm(middle[:, :2] - proxy.centre[:2], axis=1) < proxy.radius_m
    distance, _ = KDTree(path_m[:, :2]).query(middle[:, :2])
    is_used &= np.asarray(distance) > _INNER_M
    quads, middle = quads[is_used], middle[is_used]
    # Quads whose corners all lie under measured ground are dropped.
    start = points[quads].reshape(-1, 3) + np.array([0.0, 0.0, _COVER_M])
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape).copy()
    hits = make_caster([background]).intersect(start, down)
    is_covered = (hits.distance_m < _COVER_M).reshape(-1, 4).all(axis=1)
    return quad_mesh(points, quads[~is_covered])


def _continued_height(
    ground: GroundMap, xy: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, " n"]:
    """Return the height of observed ground near by, and of a plane through it further away.

    Roofs and slopes that were classified as ground lie off the plane and are excluded.
    """
    from scipy.spatial import KDTree

    cells = np.argwhere(ground.is_observed)
    if len(cells) < _MIN_CELLS:
        return ground.look_up(xy).astype(np.float64)
    places = ground.origin_m + ground.cell_m * cells
    z = ground.height_m[ground.is_observed].astype(np.float64)
    terms = np.concatenate([places, np.ones((len(cells), 1))], axis=1)
    weight = np.ones(len(z))
    plane = np.zeros(3)
    for _ in range(10):
        plane = np.linalg.lstsq(terms * weight[:, None], z * weight, rcond=None)[0]
        weight = 1.0 / np.sqrt(1.0 + ((z - terms @ plane) / _PLANE_SCALE_M) ** 2)
    is_ground = np.abs(z - terms @ plane) < _OFF_PLANE_M
    distance, nearest = KDTree(places[is_ground]).query(xy)
    fraction = np.exp(-np.asarray(distance) / _BLEND_M)
    far = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ plane
    return fraction * z[is_ground][nearest] + (1.0 - fraction) * far
