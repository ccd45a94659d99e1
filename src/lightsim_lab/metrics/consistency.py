"""Agreement of two pictures of one scene at matching surface points, found by exact depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb_from_linear
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame

# Largest distance between a point and the surface that the other view shows there, in pixel widths;
# farther points are occluded. Sensitivity not measured.
_SAME_PX = 3.0


@dataclass(frozen=True, eq=False)
class View:
    """One picture with its geometry.

    Args:
        buffers: geometry, in frame `world` at the frame's time.
        radiance: linear picture divided by the camera gain, scene units.
        world_from_actor: poses at the frame's time, by the actor index in `buffers`.
    """

    frame: CameraFrame
    camera: PinholeCamera
    buffers: GBuffers
    radiance: Float32[np.ndarray, "h w 3"]
    world_from_actor: Mapping[int, RigidTransform]


@dataclass(frozen=True, eq=False)
class Matches:
    """Pixels of a first view whose surface is visible in a second view.

    Args:
        pixel: (row, column) in the first view.
        uv: position of the same point in the second view, in pixels.
        error_px: distance between the pixel and the point that the second view shows at `uv`,
            projected back into the first view.
    """

    pixel: Int64[np.ndarray, "n 2"]
    uv: Float64[np.ndarray, "n 2"]
    error_px: Float64[np.ndarray, " n"]

    @property
    def other(self) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Rows and columns of the pixels in the second view."""
        column, row = np.floor(self.uv).astype(np.int64).T
        return row, column


def match(a: View, b: View, chosen: Bool[np.ndarray, "h w"]) -> Matches:
    """Match the surfaces of chosen pixels, moved with their actors, with another view.

    Points that are occluded or outside the picture there are omitted.
    """
    pixel = np.argwhere(chosen & a.buffers.has_surface)
    rows, columns = pixel.T
    number = a.buffers.actor_index[rows, columns]
    at_b = _moved(a.buffers.position_world[rows, columns].astype(np.float64), number, a, b)
    uv, is_inside = b.frame.project(b.camera, at_b)
    # Points behind the other camera or outside its picture have no pixel to compare.
    keep = np.flatnonzero(is_inside)
    pixel, number, at_b, uv = pixel[keep], number[keep], at_b[keep], uv[keep]
    j, i = np.floor(uv).astype(np.int64).T
    surface = b.buffers.position_world[i, j].astype(np.float64)
    normal = b.buffers.normal_world[i, j].astype(np.float64)
    origin, direction = b.frame.pixel_rays(b.camera, uv)
    facing = np.einsum("nc,nc->n", direction, normal)
    # Rays nearly parallel to the surface have no stable intersection.
    facing = np.where(np.abs(facing) < 1e-3, -1e-3, facing)
    distance = np.einsum("nc,nc->n", surface - origin, normal) / facing
    seen = origin + distance[:, None] * direction
    footprint_m = np.linalg.norm(at_b - origin, axis=1) / b.camera.fx / np.abs(facing)
    # Depth alone would match an actor with the road just behind it.
    is_same = b.buffers.actor_index[i, j] == number
    is_same &= np.linalg.norm(seen - at_b, axis=1) < _SAME_PX * footprint_m
    pixel, uv = pixel[is_same], uv[is_same]
    back, _ = a.frame.project(a.camera, _moved(seen[is_same], number[is_same], b, a))
    error_px = np.linalg.norm(back - (pixel[:, ::-1] + 0.5), axis=1)
    is_seen = np.isfinite(error_px)
    return Matches(pixel[is_seen], uv[is_seen], error_px[is_seen])


def _moved(
    points_world: Float64[np.ndarray, "n 3"], number: np.ndarray, a: View, b: View
) -> Float64[np.ndarray, "n 3"]:
    """Move points of actors from their poses in one view to those in the other."""
    moved = points_world.copy()
    for actor in np.unique(number[number > BACKGROUND]).tolist():
        is_its = number == actor
        if actor in a.world_from_actor and actor in b.world_from_actor:
            step = b.world_from_actor[actor] @ a.world_from_actor[actor].inverse()
            moved[is_its] = step.apply(points_world[is_its])
    return moved


@dataclass(frozen=True)
class ConsistencyRow:
    """Agreement of one method's pictures of the same surfaces.

    Args:
        pairs: `cameras` (at one time) or `frames` (successive frames of one camera).
        count: number of pairs of pictures with surface in common.
        points: number of matching points in all pairs.
        delta_e: mean CIEDE2000 difference.
        warp_error: mean absolute difference of sRGB values.
        relative_warp_error: `warp_error` over that of the recorded pictures; NaN without recorded
            pictures, and where they do not differ.
    """

    condition: str
    method: str
    pairs: str
    count: int
    points: int
    delta_e: float
    warp_error: float
    relative_warp_error: float = float("nan")


def picture_differences(a: View, b: View, matches: Matches) -> tuple[float, float]:
    """Return sums of CIEDE2000 differences and of absolute sRGB differences over matching points.

    CIEDE2000: Sharma et al. 2005, doi:10.1002/col.20070. The second is the warp error of Lai et al.
    2018, arXiv:1808.00449, mean of the channels, with exact motion and occlusion.
    """
    from scipy.ndimage import map_coordinates
    from skimage.color import deltaE_ciede2000, rgb2lab

    rows, columns = matches.pixel.T
    at = matches.uv[:, ::-1].T - 0.5
    here, there = (srgb_from_linear(view.radiance) for view in (a, b))
    seen = np.stack(
        [map_coordinates(there[..., c], at, order=1, mode="nearest") for c in range(3)], axis=1
    )
    pair = (here[rows, columns], seen)
    delta_e = deltaE_ciede2000(*(rgb2lab(np.clip(x, 0.0, 1.0)) for x in pair))
    return float(np.sum(delta_e)), float(np.abs(pair[0] - pair[1]).mean(axis=1).sum())
