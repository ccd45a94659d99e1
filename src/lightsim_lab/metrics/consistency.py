"""Whether two pictures of one scene agree: where surfaces are, which colour they have, where the
shadows of edits fall. Surfaces are followed from one view to the other through exact depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import luminance, srgb_from_linear
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame

# A point is what the other view shows there if it lies this many pixels' width from it: beyond, it
# is hidden.
_SAME_PX = 3.0
# Side of the patches whose shift is measured; at least this part of one is seen by both views, and
# the shift of one that tells it worse than this (standard deviation) is not counted.
_PATCH_PX, _SEEN, _CERTAIN_PX = 24, 0.6, 0.1
_DARK = np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class View:
    """One picture and what it shows.

    Args:
        buffers: geometry, in frame `world` at the frame's time.
        radiance: of the picture, linear, scene units (gain divided out).
        world_from_actor: poses at the frame's time, by the actors' numbers in `buffers`.
    """

    frame: CameraFrame
    camera: PinholeCamera
    buffers: GBuffers
    radiance: Float32[np.ndarray, "h w 3"]
    world_from_actor: Mapping[int, RigidTransform]


@dataclass(frozen=True, eq=False)
class Matches:
    """Pixels of one view whose surface another one shows too.

    Args:
        pixel: (row, column) in the first view.
        uv: where the second shows the same point.
        error_px: from the pixel to where the first view has the point that the second sees there.
    """

    pixel: Int64[np.ndarray, "n 2"]
    uv: Float64[np.ndarray, "n 2"]
    error_px: Float64[np.ndarray, " n"]

    @property
    def other(self) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Rows and columns of the second view's pixels."""
        column, row = np.floor(self.uv).astype(np.int64).T
        return row, column


def match(a: View, b: View, chosen: Bool[np.ndarray, "h w"]) -> Matches:
    """Follows the surfaces of chosen pixels of one view, with the actors they belong to, into
    another one; what is hidden or out of the picture there is left out."""
    pixel = np.argwhere(chosen & a.buffers.has_surface)
    rows, columns = pixel.T
    number = a.buffers.actor_index[rows, columns]
    at_b = _moved(a.buffers.position_world[rows, columns].astype(np.float64), number, a, b)
    uv, is_inside = b.frame.project(b.camera, at_b)
    keep = np.flatnonzero(is_inside)
    pixel, number, at_b, uv = pixel[keep], number[keep], at_b[keep], uv[keep]
    j, i = np.floor(uv).astype(np.int64).T
    surface = b.buffers.position_world[i, j].astype(np.float64)
    normal = b.buffers.normal_world[i, j].astype(np.float64)
    origin, direction = b.frame.pixel_rays(b.camera, uv)
    facing = np.einsum("nc,nc->n", direction, normal)
    facing = np.where(np.abs(facing) < 1e-3, -1e-3, facing)
    distance = np.einsum("nc,nc->n", surface - origin, normal) / facing
    seen = origin + distance[:, None] * direction
    footprint_m = np.linalg.norm(at_b - origin, axis=1) / b.camera.fx / np.abs(facing)
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
    """Points of actors from where they stand in one view to where they do in the other."""
    moved = points_world.copy()
    for actor in np.unique(number[number > BACKGROUND]).tolist():
        is_its = number == actor
        if actor in a.world_from_actor and actor in b.world_from_actor:
            step = b.world_from_actor[actor] @ a.world_from_actor[actor].inverse()
            moved[is_its] = step.apply(points_world[is_its])
    return moved


def colour_difference(a: View, b: View, matches: Matches) -> Float64[np.ndarray, " n"]:
    """Mean over the channels of the absolute log ratio of radiances at matching points."""
    from scipy.ndimage import map_coordinates

    rows, columns = matches.pixel.T
    at = matches.uv[:, ::-1].T - 0.5
    other = [map_coordinates(b.radiance[..., c], at, order=1, mode="nearest") for c in range(3)]
    ratio = (a.radiance[rows, columns] + _DARK) / (np.stack(other, axis=1) + _DARK)
    return np.abs(np.log(ratio)).mean(axis=1).astype(np.float64)


def picture_shifts_px(a: View, b: View, matches: Matches) -> Float64[np.ndarray, " k"]:
    """How far the second picture, brought to the first through the surfaces, lies beside it: for
    each patch with enough texture (Lucas & Kanade 1981, one step, with gain and offset)."""
    from scipy.ndimage import map_coordinates

    grey_a, grey_b = (srgb_from_linear(luminance(x.radiance)).astype(np.float64) for x in (a, b))
    rows, columns = matches.pixel.T
    seen = np.full(grey_a.shape, np.nan)
    seen[rows, columns] = map_coordinates(
        grey_b, matches.uv[:, ::-1].T - 0.5, order=3, mode="nearest"
    )
    rise, run = (np.asarray(slope) for slope in np.gradient(grey_a))
    shifts = []
    for top in range(0, grey_a.shape[0] - _PATCH_PX + 1, _PATCH_PX):
        for left in range(0, grey_a.shape[1] - _PATCH_PX + 1, _PATCH_PX):
            part = (slice(top, top + _PATCH_PX), slice(left, left + _PATCH_PX))
            known = np.isfinite(seen[part])
            if known.mean() < _SEEN:
                continue
            here = grey_a[part][known]
            system = np.stack([run[part][known], rise[part][known], here, np.ones_like(here)], 1)
            shifts.append(_shift(system, seen[part][known] - here))
    found = np.array([s for s in shifts if s is not None])
    return np.linalg.norm(found.reshape(-1, 2), axis=1)


def _shift(
    system: Float64[np.ndarray, "n 4"], change: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "2"] | None:
    """The shift that explains a change by least squares; None where the patch does not tell it."""
    normal = system.T @ system
    if np.linalg.cond(normal) > 1e10:
        return None
    solution = np.asarray(np.linalg.solve(normal, system.T @ change))
    variance = float(np.square(change - system @ solution).mean())
    deviation = np.sqrt(variance * np.diagonal(np.linalg.inv(normal))[:2])
    return solution[:2] if bool(np.all(deviation < _CERTAIN_PX)) else None


def overlap(
    in_a: Bool[np.ndarray, "h w"], in_b: Bool[np.ndarray, "h w"], matches: Matches
) -> tuple[int, int]:
    """Matching points that both views show in a mask, and those that either does: intersection and
    union."""
    rows, columns = matches.pixel.T
    one, other = in_a[rows, columns], in_b[matches.other]
    return int(np.count_nonzero(one & other)), int(np.count_nonzero(one | other))


@dataclass(frozen=True)
class ConsistencyRow:
    """How alike one method's pictures show the same surfaces.

    Args:
        pairs: `cameras` (at one time) or `frames` (of one camera, one after the other).
        count: pairs of pictures that share surface.
        points: matching points in all of them.
        delta_e: CIEDE2000 between them, mean over points.
        warp_error: mean absolute difference of their sRGB values.
        relative_warp_error: the latter over that of the recorded pictures; NaN without them, and
            where they do not change.
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
    """Sums over the matching points: of CIEDE2000 colour differences (Sharma et al. 2005,
    doi:10.1002/col.20070), and of absolute differences of sRGB values, mean of the channels (the
    warp error of Lai et al. 2018, arXiv:1808.00449, with exact motion and occlusion)."""
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
