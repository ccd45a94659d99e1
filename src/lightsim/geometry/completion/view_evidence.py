"""Evidence of the images: what each view shows along lines of sight to given points.

A pixel is classified as sky, surface or mixed (wires, twigs, borders); the measured mesh determines
which surface lies before or behind a point. All steps of the completion use this module, with one
depth tolerance and one set of log-odds. Mattes are decoded once and stored as three bits a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError

# Least motion of a camera between two views that are used, in metres: views closer together show
# nearly the same and would count as independent evidence.
MIN_BASELINE_M = 2.0
# Least motion of a camera where many views are required, for glass reflections and free space, in
# metres.
DENSE_BASELINE_M = 0.7

# Matte value from which a pixel shows sky.
SKY_ALPHA = 0.8
# Matte value up to which a pixel shows a surface. Values between the two are mixed pixels (wires,
# twigs and borders), which are no evidence.
SOLID_ALPHA = 0.2

# Distance up to which views are evidence of walls and masts, in metres.
WALL_VIEW_M = 90.0
# Distance up to which views are evidence of objects of half a metre (crowns, billboards), in
# metres.
OBJECT_VIEW_M = 60.0
# Distance up to which views are evidence of details of a decimetre (poles, panes), in metres.
DETAIL_VIEW_M = 40.0

# Tolerance of depth, in metres: surface within it counts as the surface at the point. Of
# the returns of log 002 and street 731, 80 % lie within 0.67 and 0.27 m of the mesh
# (benchmarks/view_evidence.py).
DEPTH_TOLERANCE_M = 0.5

# Log-odds that a cell is occupied, from one view that shows a surface there.
SURFACE_LOG_ODDS = 1.0
# Log-odds from one view that shows sky. It has more weight, because the surface in a view may lie
# behind the cell, whereas sky excludes any surface. Against LiDAR the value is -5 up to 30 m, and
# -0.6 from 30 to 60 m in small images of log 002, where mattes omit thin objects
# (benchmarks/view_evidence.py).
SKY_LOG_ODDS = -2.0
# Greatest absolute log-odds from all views that show sky, or a surface: errors of views of one
# point are correlated. A second view repeats a false sky in 33 to 76 % of cases beyond 30 m.
MAX_LOG_ODDS = 6.0
# Log-odds of a cell without any view, so that a profile ends at the last observed cell.
UNOBSERVED_LOG_ODDS = -0.5

# Linear pixel value at which logarithms of images are limited: 7 of 255 in sRGB, below which noise
# dominates.
DARK_LINEAR = 2e-3

Matte = Float32[np.ndarray, "h w"]
SourceView = tuple[CameraFrame, PinholeCamera, Matte | Callable[[], Matte]]
"""A frame, its camera (of the matte's size), and its sky matte or a function that reads it."""

_FrameFirst = TypeVar("_FrameFirst", bound=tuple[Any, ...])


def spaced_views(views: Iterable[_FrameFirst], min_baseline_m: float) -> Iterator[_FrameFirst]:
    """Yield the views whose camera moved at least `min_baseline_m` since its last yielded view.

    Each view is a tuple that begins with its frame.
    """
    last: dict[str, np.ndarray] = {}
    for view in views:
        frame: CameraFrame = view[0]
        position = frame.world_from_camera.translation_m
        before = last.get(frame.camera_name)
        if before is not None and np.linalg.norm(position - before) < min_baseline_m:
            continue
        last[frame.camera_name] = position
        yield view


def log_odds_of_views(
    surface_views: Int64[np.ndarray, "*n"], sky: Int64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    """Return the log-odds that cells are occupied, from the numbers of views that show them as
    surface and as sky; `UNOBSERVED_LOG_ODDS` without any view."""
    log_odds = np.minimum(SURFACE_LOG_ODDS * surface_views, MAX_LOG_ODDS) + np.maximum(
        SKY_LOG_ODDS * sky, -MAX_LOG_ODDS
    )
    return np.where(surface_views + sky == 0, UNOBSERVED_LOG_ODDS, log_odds)


@dataclass(frozen=True, eq=False)
class Sightlines:
    """Straight lines from a camera to points in its image, frame world.

    Args:
        eye_m: position of the camera.
        row: row of each line's point among the points given.
        pixel: row and column of its pixel.
        ray: unit direction.
        distance_m: distance of the point.
    """

    eye_m: Float64[np.ndarray, "3"]
    row: Int64[np.ndarray, " n"]
    pixel: tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]
    ray: Float64[np.ndarray, "n 3"]
    distance_m: Float64[np.ndarray, " n"]

    def select(self, chosen: Bool[np.ndarray, " n"]) -> Sightlines:
        """Return the selected lines."""
        v, u = (index[chosen] for index in self.pixel)
        return Sightlines(
            self.eye_m, self.row[chosen], (v, u), self.ray[chosen], self.distance_m[chosen]
        )

    def beyond_m(self, caster: RayCaster) -> Float64[np.ndarray, " n"]:
        """Return the distance behind its point at which each line meets a surface, in metres.

        Negative if the surface occludes the point; infinite without a surface.
        """
        if not len(self.row):
            return np.zeros(0)
        hits = caster.intersect(np.broadcast_to(self.eye_m, self.ray.shape).copy(), self.ray)
        return np.where(hits.is_hit, hits.distance_m, np.inf) - self.distance_m

    def visible(self, caster: RayCaster) -> Sightlines:
        """Return the lines whose point is not occluded."""
        return self.select(self.beyond_m(caster) > -DEPTH_TOLERANCE_M)


@dataclass(frozen=True, eq=False)
class View:
    """A frame with its camera and packed bits of its sky matte.

    Args:
        packed: bits of `has_sky`, of `classes` > 0, and of `classes` < 0.
    """

    frame: CameraFrame
    camera: PinholeCamera
    packed: UInt8[np.ndarray, "3 b"]

    @staticmethod
    def of(frame: CameraFrame, camera: PinholeCamera, matte: Matte) -> View:
        """Classify the pixels of a matte.

        Raises:
            InputError: matte and camera differ in size.
        """
        from scipy.ndimage import minimum_filter

        if matte.shape != (camera.height_px, camera.width_px):
            raise InputError(
                "the sky matte and the camera differ in size",
                where=f"camera '{camera.name}'",
                got=f"{matte.shape[1]}x{matte.shape[0]} px",
                expected=f"{camera.width_px}x{camera.height_px} px",
            )
        # One pixel around must be sky too: poses and mattes have errors of about a pixel.
        is_inner = np.asarray(minimum_filter(matte, 3)) >= SKY_ALPHA
        bits = np.stack([matte >= SKY_ALPHA, is_inner, matte <= SOLID_ALPHA])
        return View(frame, camera, np.packbits(bits.reshape(3, -1), axis=1))

    def _bits(self, k: int) -> Bool[np.ndarray, "h w"]:
        shape = self.camera.height_px, self.camera.width_px
        return np.unpackbits(self.packed[k], count=shape[0] * shape[1]).reshape(shape).view(bool)

    @property
    def has_sky(self) -> Bool[np.ndarray, "h w"]:
        """Return whether each pixel shows sky."""
        return self._bits(0)

    @property
    def has_surface(self) -> Bool[np.ndarray, "h w"]:
        """Return whether each pixel shows a surface."""
        return self._bits(2)

    @property
    def classes(self) -> Int8[np.ndarray, "h w"]:
        """Return 1 for sky with sky around it, -1 for a surface, 0 for mixed pixels."""
        return self._bits(1).astype(np.int8) - self._bits(2).astype(np.int8)

    def sightlines(self, points: Float64[np.ndarray, "n 3"], range_m: float) -> Sightlines:
        """Return the lines to the points inside the image and nearer than `range_m`."""
        eye = self.frame.world_from_camera.translation_m
        way = points - eye
        distance = np.linalg.norm(way, axis=1)
        near = np.flatnonzero((distance < range_m) & (distance > 0))
        uv, is_inside = self.frame.project(self.camera, points[near])
        row = near[is_inside]
        u, v = uv[is_inside].astype(np.int64).T
        return Sightlines(eye, row, (v, u), way[row] / distance[row][:, None], distance[row])

    def classes_at(self, sightlines: Sightlines) -> Int8[np.ndarray, " n"]:
        """Return `classes` at the pixels of lines, without unpacking the others."""
        row, column = sightlines.pixel
        place = row * self.camera.width_px + column
        bits = (self.packed[1:, place >> 3] >> (7 - (place & 7))) & 1
        return bits[0].astype(np.int8) - bits[1].astype(np.int8)


class ViewEvidence:
    """The views of a log; each matte is read once, at its first use."""

    def __init__(self, views: Iterable[SourceView]) -> None:
        self._sources = tuple(views)
        self._read: dict[int, View] = {}

    def views(self, min_baseline_m: float = MIN_BASELINE_M) -> Iterator[View]:
        """Yield the views whose cameras moved at least `min_baseline_m` in between.

        Raises:
            InputError: a matte does not fit its camera.
        """
        numbered = ((frame, k) for k, (frame, _, _) in enumerate(self._sources))
        for _, k in spaced_views(numbered, min_baseline_m):
            if k not in self._read:
                frame, camera, matte = self._sources[k]
                self._read[k] = View.of(frame, camera, matte() if callable(matte) else matte)
            yield self._read[k]

    def count(
        self, points: Float64[np.ndarray, "n 3"], caster: RayCaster, range_m: float
    ) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Return the numbers of views that show each point as surface and as sky, without views in
        which it is occluded."""
        surface_views, sky = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
        for view in self.views():
            sightlines = view.sightlines(points, range_m)
            sightlines = sightlines.select(view.classes_at(sightlines) != 0).visible(caster)
            kind = view.classes_at(sightlines)
            surface_views[sightlines.row[kind < 0]] += 1
            sky[sightlines.row[kind > 0]] += 1
        return surface_views, sky
