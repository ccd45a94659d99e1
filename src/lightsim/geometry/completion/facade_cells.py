"""Features of facade cells from images and LiDAR: input of the network that classifies glass.

Glass transmits beams or reflects them specularly, so it has few returns. A camera observes a dim
room and the reflection of the sky, which depends on the view. All features are relative to the
surrounding wall, and therefore independent of camera gain and exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.geometry.completion.view_evidence import (
    DARK_LINEAR,
    DENSE_BASELINE_M,
    DETAIL_VIEW_M,
    View,
    ViewEvidence,
)
from lightsim.geometry.completion.walls import returns_near, surface_offset_m

# Edge of a cell, in metres: about the footprint of a pixel at the width of a street.
CELL_M = 0.125
# Measured surface up to this far before the wall's plane belongs to the wall, in metres.
FRONT_M = 0.5
# Measured surface up to this far behind the plane belongs to the wall, in metres: panes are set
# back in their frames.
BEHIND_M = 0.7
FEATURES = (
    "log luminance, median of views",
    "log luminance, low",
    "log luminance, high",
    "log red over green, mean of views",
    "log blue over green, mean of views",
    "views show it",
    "returns, over those around",
    "there are returns around",
)
"""Features of each cell: luminance and colour relative to the surrounding wall; 0 where unknown.

Depth is not a feature: panes of the training streets are recessed, but so are garage doors."""

# The values below belong to the trained network: a change requires a new fit
# (benchmarks/panes_fit.py). They were chosen on log 002 and training streets; sensitivity not
# measured.


class _Features:
    """Cells and features of the trained network; a change requires a new fit."""

    above_m = 3.0  # Height of cells above the measured or inferred part of a wall.
    hole_m = 1.5  # Widest hole that belongs to the wall.
    min_cosine = 0.15  # Least cosine between a view and the wall's normal.
    min_views = 2  # Least number of views of a cell.
    quantiles = (0.5, 0.2, 0.8)  # Median, low and high over the views.
    around_m = 1.5  # Half the width of the wall with which a cell is compared.
    # Half the width and height over which returns are averaged; low, because the density of beams
    # changes quickly with height.
    beams_m = (2.0, 0.25)
    min_returns = 0.2  # Least mean number of returns a cell around.
    blur = 0.7  # Standard deviation of the blur of returns, in cells.
    max_returns = 2.0  # Greatest ratio of returns to returns around.


@dataclass(frozen=True, eq=False)
class FacadeCells:
    """Cells [s, z] of a wall, `CELL_M` wide, from its lowest corner on.

    Args:
        wall: plane of the cells.
        offset_m: offset of the surface in front of the plane; NaN without surface.
        features: features `FEATURES`.
        is_known: whether a cell belongs to the wall and views show it.
        returns_out_m: offset of the LiDAR returns near the wall in front of its plane.
        returns_place: s and z of these returns, in cells.
    """

    wall: Wall
    offset_m: Float64[np.ndarray, "s z"]
    features: Float32[np.ndarray, "p s z"]
    is_known: Bool[np.ndarray, "s z"]
    returns_out_m: Float64[np.ndarray, " m"]
    returns_place: Float64[np.ndarray, "m 2"]

    @property
    def typical_m(self) -> float:
        """Median offset of the surface, in metres."""
        return _typical(self.offset_m)


def facade_cells(
    walls: Sequence[Wall],
    evidence: ViewEvidence,
    returns_world: Float32[np.ndarray, "n 3"],
    caster: RayCaster,
) -> list[FacadeCells]:
    """Compute the features of each wall's cells.

    Args:
        walls: planes, frame world.
        evidence: the views of the log.
        returns_world: LiDAR returns from static surfaces, frame world.
        caster: over all static surfaces, with walls closed.

    Returns:
        One grid of cells for each wall.
    """
    looks = [_WallViews(wall, _offsets(wall, caster)) for wall in walls]
    for view in evidence.views(DENSE_BASELINE_M):
        rgb = np.log(linear_from_srgb8(view.frame.load_srgb8()) + DARK_LINEAR)
        for look in looks:
            look.add(view, rgb, caster)
    return [_cells(look, returns_world) for look in looks]


class _WallViews:
    """Luminance and colour of one wall's cells, accumulated over the views."""

    def __init__(self, wall: Wall, offset_m: Float64[np.ndarray, "s z"]) -> None:
        self.wall, self.offset_m = wall, offset_m
        out = np.where(np.isfinite(offset_m), offset_m, _typical(offset_m))
        place = wall.at(*wall.grid(CELL_M, offset_m.shape)) + out[..., None] * wall.normal
        self._place = place.reshape(-1, 3)
        self._luminance: list[Float16[np.ndarray, "s z"]] = []
        self._count = np.zeros(offset_m.shape)
        self._colour = np.zeros((*offset_m.shape, 2))

    def add(self, view: View, log_rgb: Float32[np.ndarray, "h w 3"], caster: RayCaster) -> None:
        """Add the pixels of one view."""
        rows, pixel = self._visible_cells(view, caster)
        if len(rows) == 0:
            return
        rgb = np.full((len(self._place), 3), np.nan)
        rgb[rows] = log_rgb[pixel]
        rgb = rgb.reshape(*self.offset_m.shape, 3)
        shade = np.log(luminance(np.exp(rgb)))
        self._luminance.append((shade - mean_around(shade, _Features.around_m)).astype(np.float16))
        self._count += np.isfinite(shade)
        self._colour += np.nan_to_num(rgb[..., [0, 2]] - rgb[..., [1]])

    def features(self) -> Float64[np.ndarray, "p s z"]:
        """Return the first six of `FEATURES`."""
        is_shown = self._count >= _Features.min_views
        features = np.zeros((6, *is_shown.shape))
        if not is_shown.any():
            return features
        # NaN sorts last: the rank of a percentile counts from the darkest view.
        views = np.sort(np.stack(self._luminance)[:, is_shown].astype(np.float32), axis=0)
        last = self._count[is_shown] - 1
        for k, part in enumerate(_Features.quantiles):
            rank = np.rint(part * last).astype(np.int64)
            features[k, is_shown] = np.take_along_axis(views, rank[None], axis=0)[0]
        for k, total in enumerate(np.moveaxis(self._colour, -1, 0), start=3):
            colour = np.where(is_shown, total / np.maximum(self._count, 1), np.nan)
            features[k, is_shown] = (colour - mean_around(colour, _Features.around_m))[is_shown]
        features[5] = is_shown
        return features

    def _visible_cells(
        self, view: View, caster: RayCaster
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the rows of the cells that a view shows, and their pixels."""
        way = self._place - view.frame.world_from_camera.translation_m
        least_m = _Features.min_cosine * np.linalg.norm(way, axis=1)
        rows = np.flatnonzero(-(way @ self.wall.normal) > least_m)
        sightlines = view.sightlines(self._place[rows], DETAIL_VIEW_M).visible(caster)
        return rows[sightlines.row], sightlines.pixel


def mean_around(values: Float64[np.ndarray, "s z"], reach_m: float) -> Float64[np.ndarray, "s z"]:
    """Return the mean of the finite values in the square that extends `reach_m` to each side."""
    from scipy.ndimage import uniform_filter

    size = 2 * round(reach_m / CELL_M) + 1
    is_known = np.isfinite(values)
    total = np.asarray(uniform_filter(np.where(is_known, values, 0.0), size))
    return total / np.maximum(uniform_filter(is_known.astype(np.float64), size), 1e-6)


def _offsets(wall: Wall, caster: RayCaster) -> Float64[np.ndarray, "s z"]:
    """Return the offset of the surface at each cell, in metres; NaN without surface."""
    size = wall.span_m[1] - wall.span_m[0], wall.height_m[1] + _Features.above_m - wall.height_m[0]
    shape = tuple(max(int(np.ceil(length / CELL_M)), 1) for length in size)
    return surface_offset_m(wall, *wall.grid(CELL_M, shape), caster, (FRONT_M, BEHIND_M))


def _typical(offset_m: Float64[np.ndarray, "s z"]) -> float:
    return float(np.nanmedian(offset_m)) if np.isfinite(offset_m).any() else 0.0


def _cells(look: _WallViews, returns_world: Float32[np.ndarray, "n 3"]) -> FacadeCells:
    wall, offset_m = look.wall, look.offset_m
    near = returns_near(wall, returns_world, (FRONT_M, BEHIND_M))
    s, out_m = wall.place(near)
    place = np.stack([s - wall.span_m[0], near[:, 2] - wall.height_m[0]], axis=1) / CELL_M
    image_planes = look.features()
    features = np.concatenate([image_planes, _return_features(offset_m.shape, place)]).astype(
        np.float32
    )
    is_known = (image_planes[5] > 0) & _is_closed(offset_m)
    return FacadeCells(wall, offset_m, features, is_known, out_m, place)


def _return_features(
    shape: tuple[int, int], place: Float64[np.ndarray, "m 2"]
) -> Float64[np.ndarray, "2 s z"]:
    """Return the last two of `FEATURES`: relative number of returns, and mask of returns around."""
    from scipy.ndimage import gaussian_filter, minimum_filter, uniform_filter1d

    cell = np.floor(place).astype(np.int64)
    is_inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    count = np.zeros(shape)
    np.add.at(count, tuple(cell[is_inside].T), 1.0)
    size = [2 * round(reach / CELL_M) + 1 for reach in _Features.beams_m]
    around = uniform_filter1d(uniform_filter1d(count, size[0], axis=0), size[1], axis=1)
    # Above the highest beam missing returns are no evidence, hence the minimum over height.
    is_measured = np.asarray(minimum_filter(around, (1, size[1]))) > _Features.min_returns
    own = np.asarray(gaussian_filter(count, _Features.blur)) / np.maximum(
        around, _Features.min_returns
    )
    return np.stack(
        [np.where(is_measured, np.minimum(own, _Features.max_returns), 0.0), is_measured]
    )


def _is_closed(offset_m: Float64[np.ndarray, "s z"]) -> Bool[np.ndarray, "s z"]:
    """Return whether each cell has surface or lies in a hole of it."""
    from scipy.ndimage import binary_closing

    reach = round(_Features.hole_m / CELL_M)
    is_on = np.pad(np.isfinite(offset_m), reach)
    closed = np.asarray(binary_closing(is_on, np.ones((reach + 1, reach + 1), dtype=bool)))
    return closed[reach:-reach, reach:-reach]
