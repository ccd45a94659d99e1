"""Views with their sky matte: selection by camera motion, and classification of pixels.

The constants are common to all detectors of this package that use views. They were chosen on log
002 and synthetic streets; only their joint effect is measured (docs/benchmarks/reconstruction.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster, RayHits
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

# Log-odds that a cell is occupied, from one view that shows a surface there.
MATTER_ODDS = 1.0
# Log-odds from one view that shows sky. It has more weight: the surface in a view may lie behind
# the cell, whereas sky excludes any surface.
SKY_ODDS = -2.0
# Greatest absolute log-odds from all views of one kind: errors of views of one place are
# correlated.
MOST_ODDS = 6.0
# Log-odds of a cell without any view, so that a profile ends at the last observed cell.
UNKNOWN_ODDS = -0.5

# Linear pixel value at which logarithms of images are limited: 7 of 255 in sRGB, below which noise
# dominates.
DARK_LINEAR = 2e-3

View = tuple[CameraFrame, PinholeCamera, Float32[np.ndarray, "h w"]]
ClassifiedView = tuple[CameraFrame, PinholeCamera, Int8[np.ndarray, "h w"]]
"""A view whose matte is classified by `classify_matte`."""

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


def classified_views(views: Iterable[View]) -> Iterator[ClassifiedView]:
    """Yield views at least `MIN_BASELINE_M` apart, with classified mattes.

    Raises:
        InputError: a matte does not fit its camera.
    """
    for frame, camera, matte in spaced_views(views, MIN_BASELINE_M):
        yield frame, camera, classify_matte(camera, matte)


def check_matte(camera: PinholeCamera, matte: Float32[np.ndarray, "h w"]) -> None:
    """Check that a matte has the size of its camera's images.

    Raises:
        InputError: the sizes differ.
    """
    if matte.shape != (camera.height_px, camera.width_px):
        raise InputError(
            "the sky matte and the camera differ in size",
            where=f"camera '{camera.name}'",
            got=f"{matte.shape[1]}x{matte.shape[0]} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )


def classify_matte(
    camera: PinholeCamera, matte: Float32[np.ndarray, "h w"]
) -> Int8[np.ndarray, "h w"]:
    """Classify pixels: 1 for sky with sky around it, -1 for a surface, 0 for mixed pixels.

    Raises:
        InputError: matte and camera differ in size.
    """
    from scipy.ndimage import minimum_filter

    check_matte(camera, matte)
    kind = np.zeros(matte.shape, dtype=np.int8)
    kind[matte <= SOLID_ALPHA] = -1
    # One pixel around must be sky too: poses and mattes have errors of about a pixel.
    is_sky = np.asarray(minimum_filter(matte, 3)) >= SKY_ALPHA
    kind[is_sky] = 1
    return kind


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

    def cast(self, caster: RayCaster) -> RayHits:
        """Return the first hit along each line."""
        return caster.intersect(np.broadcast_to(self.eye_m, self.ray.shape).copy(), self.ray)


def sightlines(
    frame: CameraFrame, camera: PinholeCamera, points: Float64[np.ndarray, "n 3"], range_m: float
) -> Sightlines:
    """Return the lines to the points inside an image and nearer than `range_m`."""
    eye = frame.world_from_camera.translation_m
    way = points - eye
    distance = np.linalg.norm(way, axis=1)
    near = np.flatnonzero((distance < range_m) & (distance > 0))
    uv, is_inside = frame.project(camera, points[near])
    row = near[is_inside]
    u, v = uv[is_inside].astype(np.int64).T
    return Sightlines(eye, row, (v, u), way[row] / distance[row][:, None], distance[row])
