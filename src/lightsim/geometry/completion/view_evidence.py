"""Evidence of the images: what each view shows along lines of sight to given points.

A view shows sky, a surface, or neither for certain (wires, twigs, borders) at a pixel; the measured
mesh determines what lies before and behind a point. All steps of the completion use this module,
with one tolerance of depth and one set of log-odds. Mattes are decoded once and stored as three
bits a pixel.
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
# Matte value up to which a pixel shows a surface. Values between the two are wires, twigs and
# borders, which are evidence of neither.
SOLID_ALPHA = 0.2

# Distance up to which views are evidence of walls and masts, in metres.
WALL_VIEW_M = 90.0
# Distance up to which views are evidence of objects of half a metre (crowns, billboards), in
# metres.
OBJECT_VIEW_M = 60.0
# Distance up to which views are evidence of details of a decimetre (poles, panes), in metres.
DETAIL_VIEW_M = 40.0

# Tolerance of depth, in metres: surface nearer to a point than this is the surface at the point. Of
# the returns of log 002 and street 731, 80 % lie within 0.67 and 0.27 m of the mesh
# (benchmarks/view_evidence.py).
DEPTH_M = 0.5

# Log-odds that a cell is occupied, from one view that shows a surface there.
MATTER_ODDS = 1.0
# Log-odds from one view that shows sky. It has more weight: the surface in a view may lie behind
# the cell, whereas sky excludes any surface. Beams give -5 up to 30 m, and -0.6 from 30 to 60 m in
# small images of log 002, where mattes miss thin objects (benchmarks/view_evidence.py).
SKY_ODDS = -2.0
# Greatest absolute log-odds from all views of one kind: errors of views of one place are
# correlated. A second view of a place repeats a false sky in 33 to 76 % of cases beyond 30 m.
MOST_ODDS = 6.0
# Log-odds of a cell without any view, so that a profile ends at the last observed cell.
UNKNOWN_ODDS = -0.5

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


def odds_of_views(
    matter: Int64[np.ndarray, "*n"], sky: Int64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    """Return the log-odds that cells are occupied, from the numbers of views that show them as
    surface and as sky; `UNKNOWN_ODDS` without any view."""
    odds = np.minimum(MATTER_ODDS * matter, MOST_ODDS) + np.maximum(SKY_ODDS * sky, -MOST_ODDS)
    return np.where(matter + sky == 0, UNKNOWN_ODDS, odds)


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

    def some(self, chosen: Bool[np.ndarray, " n"]) -> Sightlines:
        """Return the selected lines."""
        v, u = (index[chosen] for index in self.pixel)
        return Sightlines(
            self.eye_m, self.row[chosen], (v, u), self.ray[chosen], self.distance_m[chosen]
        )

    def beyond_m(self, caster: RayCaster) -> Float64[np.ndarray, " n"]:
        """Return how far behind its point each line meets a surface, in metres.

        Negative before the point, where the surface hides it; infinite without a surface.
        """
        if not len(self.row):
            return np.zeros(0)
        hits = caster.intersect(np.broadcast_to(self.eye_m, self.ray.shape).copy(), self.ray)
        return np.where(hits.is_hit, hits.distance_m, np.inf) - self.distance_m

    def visible(self, caster: RayCaster) -> Sightlines:
        """Return the lines whose point no surface hides."""
        return self.some(self.beyond_m(caster) > -DEPTH_M)


@dataclass(frozen=True, eq=False)
class View:
    """A frame with its camera and packed bits of its sky matte.

    Args:
        packed: bits of `has_sky`, of `kinds` > 0 and of `kinds` < 0.
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
    def kinds(self) -> Int8[np.ndarray, "h w"]:
        """Return 1 for sky with sky around it, -1 for a surface, 0 for mixed pixels."""
        return self._bits(1).astype(np.int8) - self._bits(2).astype(np.int8)

    def lines(self, points: Float64[np.ndarray, "n 3"], range_m: float) -> Sightlines:
        """Return the lines to the points inside the image and nearer than `range_m`."""
        eye = self.frame.world_from_camera.translation_m
        way = points - eye
        distance = np.linalg.norm(way, axis=1)
        near = np.flatnonzero((distance < range_m) & (distance > 0))
        uv, is_inside = self.frame.project(self.camera, points[near])
        row = near[is_inside]
        u, v = uv[is_inside].astype(np.int64).T
        return Sightlines(eye, row, (v, u), way[row] / distance[row][:, None], distance[row])

    def kinds_at(self, lines: Sightlines) -> Int8[np.ndarray, " n"]:
        """Return `kinds` at the pixels of lines, without unpacking the others."""
        row, column = lines.pixel
        place = row * self.camera.width_px + column
        bits = (self.packed[1:, place >> 3] >> (7 - (place & 7))) & 1
        return bits[0].astype(np.int8) - bits[1].astype(np.int8)


class ViewEvidence:
    """The views of a log; each matte is read when a step first needs it, and once."""

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
        """Return the numbers of views that show each point as surface and as sky; views in which a
        surface hides the point do not count."""
        matter, sky = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
        for view in self.views():
            lines = view.lines(points, range_m)
            lines = lines.some(view.kinds_at(lines) != 0).visible(caster)
            kind = view.kinds_at(lines)
            matter[lines.row[kind < 0]] += 1
            sky[lines.row[kind > 0]] += 1
        return matter, sky
