"""What views and beams tell of the cells of a facade: from it panes of glass are told.

Glass sends back little of what falls on it: beams go through or are reflected away, and a camera
sees a dim room and the sky's reflection, which moves from view to view. All is told against the
wall around, which needs no camera gain and no exposure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64

from lightsim.core.buildings import Wall
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.silhouettes import spaced_views
from lightsim.geometry.completion.walls import returns_near, surface_offset_m

# A pixel of a camera that stands across the street.
CELL_M = 0.125
# Surface this far before and behind a wall's plane lies on it.
FRONT_M, BEHIND_M = 0.5, 0.7
PLANES = (
    "log luminance, median of views",
    "log luminance, low",
    "log luminance, high",
    "log red over green, mean of views",
    "log blue over green, mean of views",
    "views show it",
    "returns, over those around",
    "there are returns around",
)
"""Of each cell: luminance and colour less those of the wall around; 0 where nothing is known.

How deep surfaces lie is left out: panes of the streets that teach are recessed, and so is a garage
door of any other."""

# Walls have nothing above what was measured or shown of them, but for this.
_ABOVE_M = 3.0
# Holes up to this wide are part of the wall.
_HOLE_M = 1.5
# Views: how far apart, how far away, and the least cosine to the wall's normal.
_BASELINE_M, _MAX_VIEW_M, _LEAST_COSINE = 0.7, 40.0, 0.15
# Fewer views are no evidence.
_LEAST_VIEWS = 2
_LOW, _HIGH = 0.2, 0.8
# Half the width of the wall around, with which a cell is compared.
_AROUND_M = 1.5
# Half the width and height over which beams that came back are counted: along the wall and up,
# where their density changes quickly; fewer are none.
_BEAMS_M = (2.0, 0.25)
_LEAST_RETURNS = 0.2
# Over which the returns of one cell are counted, in cells.
_BLUR = 0.7
# Most returns over those around that are told.
_MOST = 2.0
_DARKEST = 2e-3


@dataclass(frozen=True, eq=False)
class FacadeCells:
    """Cells [s, z] of a wall, `CELL_M` wide, from its lowest corner on.

    Args:
        offset_m: of the surface before the plane; NaN where there is none.
        planes: `PLANES`.
        is_known: parts of the wall that views show.
        returns_out_m: of LiDAR's returns near the wall, how far before the plane they lie.
        returns_place: s and z of them, in cells.
    """

    wall: Wall
    offset_m: Float64[np.ndarray, "s z"]
    planes: Float32[np.ndarray, "p s z"]
    is_known: Bool[np.ndarray, "s z"]
    returns_out_m: Float64[np.ndarray, " m"]
    returns_place: Float64[np.ndarray, "m 2"]

    @property
    def typical_m(self) -> float:
        """Offset of most of the surface."""
        return _typical(self.offset_m)


def facade_cells(
    walls: Sequence[Wall],
    frames: Iterable[tuple[CameraFrame, PinholeCamera]],
    returns_world: Float32[np.ndarray, "n 3"],
    caster: RayCaster,
) -> list[FacadeCells]:
    """Of each wall.

    Args:
        walls: planes, frame world.
        frames: with their cameras.
        returns_world: of LiDAR beams, from what stands still.
        caster: over everything that stands still, walls closed.
    """
    looks = [_Look(wall, _offsets(wall, caster)) for wall in walls]
    for frame, camera in spaced_views(frames, _BASELINE_M):
        rgb = np.log(linear_from_srgb8(frame.load_srgb8()) + _DARKEST)
        for look in looks:
            look.add(frame, camera, rgb, caster)
    return [_cells(look, returns_world) for look in looks]


class _Look:
    """What views show of one wall."""

    def __init__(self, wall: Wall, offset_m: Float64[np.ndarray, "s z"]) -> None:
        self.wall, self.offset_m = wall, offset_m
        out = np.where(np.isfinite(offset_m), offset_m, _typical(offset_m))
        place = wall.at(*wall.grid(CELL_M, offset_m.shape)) + out[..., None] * wall.normal
        self._place = place.reshape(-1, 3)
        self._luminance: list[Float16[np.ndarray, "s z"]] = []
        self._count = np.zeros(offset_m.shape)
        self._colour = np.zeros((*offset_m.shape, 2))

    def add(
        self,
        frame: CameraFrame,
        camera: PinholeCamera,
        log_rgb: Float32[np.ndarray, "h w 3"],
        caster: RayCaster,
    ) -> None:
        """What one more image has at the cells that it shows."""
        rows, uv = self._seen(frame, camera, caster)
        if len(rows) == 0:
            return
        rgb = np.full((len(self._place), 3), np.nan)
        rgb[rows] = log_rgb[uv[:, 1], uv[:, 0]]
        rgb = rgb.reshape(*self.offset_m.shape, 3)
        shade = np.log(luminance(np.exp(rgb)))
        self._luminance.append((shade - mean_around(shade, _AROUND_M)).astype(np.float16))
        self._count += np.isfinite(shade)
        self._colour += np.nan_to_num(rgb[..., [0, 2]] - rgb[..., [1]])

    def planes(self) -> Float64[np.ndarray, "p s z"]:
        """The first six of `PLANES`."""
        is_shown = self._count >= _LEAST_VIEWS
        planes = np.zeros((6, *is_shown.shape))
        if not is_shown.any():
            return planes
        # NaN sorts last: the rank of a percentile counts from the darkest view.
        views = np.sort(np.stack(self._luminance)[:, is_shown].astype(np.float32), axis=0)
        last = self._count[is_shown] - 1
        for k, part in enumerate((0.5, _LOW, _HIGH)):
            rank = np.rint(part * last).astype(np.int64)
            planes[k, is_shown] = np.take_along_axis(views, rank[None], axis=0)[0]
        for k, total in enumerate(np.moveaxis(self._colour, -1, 0), start=3):
            colour = np.where(is_shown, total / np.maximum(self._count, 1), np.nan)
            planes[k, is_shown] = (colour - mean_around(colour, _AROUND_M))[is_shown]
        planes[5] = is_shown
        return planes

    def _seen(
        self, frame: CameraFrame, camera: PinholeCamera, caster: RayCaster
    ) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the cells that a view shows, and their pixels."""
        eye = frame.world_from_camera.translation_m
        way = self._place - eye
        distance = np.linalg.norm(way, axis=1)
        is_facing = -(way @ self.wall.normal) > _LEAST_COSINE * distance
        rows = np.flatnonzero((distance < _MAX_VIEW_M) & is_facing)
        uv, is_inside = frame.project(camera, self._place[rows])
        rows, uv = rows[is_inside], uv[is_inside].astype(np.int64)
        if len(rows) == 0:
            return rows, uv
        rays = way[rows] / distance[rows, None]
        hits = caster.intersect(np.broadcast_to(eye, rays.shape).copy(), rays)
        is_shown = ~(hits.distance_m < distance[rows] - FRONT_M)
        return rows[is_shown], uv[is_shown]


def mean_around(values: Float64[np.ndarray, "s z"], reach_m: float) -> Float64[np.ndarray, "s z"]:
    """Mean of what is finite within a square of twice the reach."""
    from scipy.ndimage import uniform_filter

    size = 2 * round(reach_m / CELL_M) + 1
    is_known = np.isfinite(values)
    total = np.asarray(uniform_filter(np.where(is_known, values, 0.0), size))
    return total / np.maximum(uniform_filter(is_known.astype(np.float64), size), 1e-6)


def _offsets(wall: Wall, caster: RayCaster) -> Float64[np.ndarray, "s z"]:
    """How far before the plane each cell's surface lies; NaN where there is none."""
    size = wall.span_m[1] - wall.span_m[0], wall.height_m[1] + _ABOVE_M - wall.height_m[0]
    shape = tuple(max(int(np.ceil(length / CELL_M)), 1) for length in size)
    return surface_offset_m(wall, *wall.grid(CELL_M, shape), caster, (FRONT_M, BEHIND_M))


def _typical(offset_m: Float64[np.ndarray, "s z"]) -> float:
    return float(np.nanmedian(offset_m)) if np.isfinite(offset_m).any() else 0.0


def _cells(look: _Look, returns_world: Float32[np.ndarray, "n 3"]) -> FacadeCells:
    wall, offset_m = look.wall, look.offset_m
    near = returns_near(wall, returns_world, (FRONT_M, BEHIND_M))
    s, out_m = wall.place(near)
    place = np.stack([s - wall.span_m[0], near[:, 2] - wall.height_m[0]], axis=1) / CELL_M
    seen = look.planes()
    planes = np.concatenate([seen, _met(offset_m.shape, place)]).astype(np.float32)
    is_known = (seen[5] > 0) & _is_closed(offset_m)
    return FacadeCells(wall, offset_m, planes, is_known, out_m, place)


def _met(shape: tuple[int, int], place: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "2 s z"]:
    """What beams tell: returns over those of the wall around, and whether it gives any, above and
    below."""
    from scipy.ndimage import gaussian_filter, minimum_filter, uniform_filter1d

    cell = np.floor(place).astype(np.int64)
    is_inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    count = np.zeros(shape)
    np.add.at(count, tuple(cell[is_inside].T), 1.0)
    size = [2 * round(reach / CELL_M) + 1 for reach in _BEAMS_M]
    around = uniform_filter1d(uniform_filter1d(count, size[0], axis=0), size[1], axis=1)
    # Above the highest beam nothing is missing.
    is_met = np.asarray(minimum_filter(around, (1, size[1]))) > _LEAST_RETURNS
    own = np.asarray(gaussian_filter(count, _BLUR)) / np.maximum(around, _LEAST_RETURNS)
    return np.stack([np.where(is_met, np.minimum(own, _MOST), 0.0), is_met])


def _is_closed(offset_m: Float64[np.ndarray, "s z"]) -> Bool[np.ndarray, "s z"]:
    """Cells with surface, and holes between them."""
    from scipy.ndimage import binary_closing

    reach = round(_HOLE_M / CELL_M)
    is_on = np.pad(np.isfinite(offset_m), reach)
    closed = np.asarray(binary_closing(is_on, np.ones((reach + 1, reach + 1), dtype=bool)))
    return closed[reach:-reach, reach:-reach]
