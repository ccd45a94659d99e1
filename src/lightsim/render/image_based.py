"""A view put together from recorded pictures, through the geometry of the twin: unstructured
lumigraph rendering (Buehler et al. 2001, doi:10.1145/383259.383309)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Int64, UInt8
from scipy import ndimage

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.sensors import CameraFrame

# What a picture costs that is a second away, and one whose pixels cover e times as much surface, in
# radians between its ray and the view's: shadows and reflections move on, blur stays.
_PENALTY_PER_S, _PENALTY_COARSE = 0.3, 0.1
# And where the view meets no surface: a wire that none was made of is taken to be infinitely far
# away, and each picture shows it elsewhere.
_PENALTY_FAR_PER_S = 1.0
# And one whose border is close, at the border; it rises over this fraction of the picture's width.
# Without it, cameras that differ a little leave a seam in the sky.
_PENALTY_BORDER, _BORDER = 0.1, 0.15
# Pictures are mixed that differ by about this much.
_BLENDED_RAD = 0.03
# And compared; the second must count this much of the best.
_COMPARED_RAD, _LEAST_COMPARED = 0.1, 0.2
# A picture shows a surface if their distances agree to this fraction beyond those of the pixels
# around.
_SAME_DISTANCE = 0.02
# Crowns are about this deep: rims that two pictures show of one may lie so far apart.
_RIM_M = 1.0
_SKY_M = 1e5
"""Everything without a surface is this far."""


@dataclass(frozen=True, eq=False)
class RecordedView:
    """A picture and how far away is what it shows. Make it with `recorded_view`.

    Args:
        gain: of the camera.
        sky_matte: fraction of sky, in 255ths.
        near_m, far_m: least and greatest distance along the rays of a pixel and those around it;
            inf without a surface, NaN where the picture is not to be used.
        is_rim: what the twin's actors and crowns lack, as far away as they are.
    """

    frame: CameraFrame
    camera: PinholeCamera
    srgb8: UInt8[np.ndarray, "h w 3"]
    gain: Float32[np.ndarray, "3"]
    sky_matte: UInt8[np.ndarray, "h w"]
    near_m: Float16[np.ndarray, "h w"]
    far_m: Float16[np.ndarray, "h w"]
    is_rim: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class ViewRays:
    """The rays of a view and what they meet.

    Args:
        camera_name: of the view.
        time_ns: of the view.
        focal_px: of its camera.
        origins_world, directions_world: of the rays; directions are unit vectors.
        distance_m: to the surfaces, inf without one.
    """

    camera_name: str
    time_ns: int
    focal_px: float
    origins_world: Float[np.ndarray, "n 3"]
    directions_world: Float[np.ndarray, "n 3"]
    distance_m: Float[np.ndarray, " n"]

    @property
    def points_world(self) -> Float[np.ndarray, "n 3"]:
        """What the rays meet; far away without a surface."""
        return self.origins_world + self._reach_m[:, None] * self.directions_world

    @property
    def _reach_m(self) -> Float[np.ndarray, " n"]:
        return np.where(np.isfinite(self.distance_m), self.distance_m, _SKY_M)

    def part(self, rows: slice | Int64[np.ndarray, " k"]) -> ViewRays:
        """Some of the rays."""
        return ViewRays(
            self.camera_name,
            self.time_ns,
            self.focal_px,
            self.origins_world[rows],
            self.directions_world[rows],
            self.distance_m[rows],
        )

    def penalties(
        self,
        frame: CameraFrame,
        camera: PinholeCamera,
        points_world: Float[np.ndarray, "n 3"],
    ) -> tuple[Float32[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """How badly a picture tells what the rays see, where it would be in the picture (u, v) and
        at which distance.

        Args:
            points_world: what the rays meet, where it was when the picture was taken; NaN where it
                was not there.

        Returns:
            Radians, inf outside the picture; occlusion is not looked at.
        """
        uv, is_inside = frame.project(camera, points_world)
        uv = np.where(is_inside[:, None], uv, 0.0)
        origins, _ = frame.pixel_rays(camera, uv)
        ray = points_world - origins
        away_m = np.linalg.norm(ray, axis=1)
        cosine = np.einsum("nc,nc->n", ray, self.directions_world) / np.maximum(away_m, 1e-9)
        angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        size = away_m / camera.fx * self.focal_px / self._reach_m
        seconds = abs(frame.time_ns - self.time_ns) / 1e9
        penalty = angle_rad + _PENALTY_COARSE * np.log(np.maximum(size, 1.0))
        is_far = ~np.isfinite(self.distance_m)
        penalty += seconds * np.where(is_far, _PENALTY_FAR_PER_S, _PENALTY_PER_S)
        size_px = np.array([camera.width_px, camera.height_px])
        inside = np.minimum(uv, size_px - uv).min(axis=1) / (_BORDER * camera.width_px)
        penalty += _PENALTY_BORDER * np.maximum(1 - inside, 0)
        if frame.camera_name != self.camera_name:
            # Cameras differ in colour, and a dozen pictures of one may end in one place: the weight
            # falls to nothing there.
            penalty -= _BLENDED_RAD * np.log(np.clip(inside, 1e-3, 1.0))
        is_told = is_inside & np.isfinite(away_m)
        return np.where(is_told, penalty, np.inf).astype(np.float32), uv, away_m


@dataclass(frozen=True, eq=False)
class BlendedView:
    """What recorded pictures show of a view.

    Args:
        radiance: linear, scene units; 0 where no picture shows the surface.
        sky_matte: fraction of sky.
        is_observed: at least one picture shows the surface.
    """

    radiance: Float32[np.ndarray, "n 3"]
    sky_matte: Float32[np.ndarray, " n"]
    is_observed: Bool[np.ndarray, " n"]


def recorded_view(
    frame: CameraFrame,
    srgb8: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    gain: Float32[np.ndarray, "3"],
    sky_matte: Float32[np.ndarray, "h w"],
    distance_m: Float32[np.ndarray, "h w"],
    is_usable: Bool[np.ndarray, "h w"],
    rim_m: Float32[np.ndarray, "h w"] | None = None,
) -> RecordedView:
    """A picture with the distances along its pixels' rays; the ego vehicle is not usable.

    Args:
        srgb8: the frame's picture.
        rim_m: distance of leaves and outlines that hide what the twin has there, inf elsewhere.
    """
    is_rim = np.zeros(distance_m.shape, dtype=bool)
    if rim_m is not None:
        is_rim = rim_m < distance_m
        distance_m = np.minimum(distance_m, rim_m)
    near, far = ndimage.minimum_filter(distance_m, 3), ndimage.maximum_filter(distance_m, 3)
    near[~is_usable] = far[~is_usable] = np.nan
    return RecordedView(
        frame,
        camera,
        srgb8,
        gain,
        np.rint(255 * sky_matte).astype(np.uint8),
        near.astype(np.float16),
        far.astype(np.float16),
        is_rim & is_usable,
    )


def blended(
    rays: ViewRays,
    pictures: Iterable[tuple[RecordedView, Float[np.ndarray, "n 3"]]],
) -> BlendedView:
    """The view as pictures show it, the best of them at each pixel; where several are about as
    good, their mean.

    Args:
        pictures: each with the points that the rays meet, where they were when it was taken (NaN
            where they were not there, or in another light).
    """
    mean = _Mean.empty(len(rays.distance_m), 4)
    for view, points in pictures:
        penalty, uv, away_m = rays.penalties(view.frame, view.camera, points)
        away_m = np.where(np.isfinite(rays.distance_m), away_m, np.inf)
        rows = np.flatnonzero(np.isfinite(penalty) & _shows(view, uv, away_m))
        mean.add(rows, penalty[rows], _sampled(view, uv[rows]))
    found = mean.values
    return BlendedView(found[:, :3], found[:, 3], mean.weight > 0)


def rims_seen(
    rays: ViewRays, pictures: Iterable[tuple[RecordedView, Float[np.ndarray, "n 3"]]]
) -> BlendedView:
    """What pictures show where rays pass an actor or a crown of the twin, which is smaller than the
    true one: `is_observed` where most pictures that look there see its rim.

    Args:
        rays: `distance_m` to where they pass it.
        pictures: each with those points, where they were when it was taken (NaN where they were
            not there, or in another light).
    """
    count = len(rays.distance_m)
    rims, seen = _Mean.empty(count, 4), _Mean.empty(count, 1)
    for view, points in pictures:
        penalty, uv, away_m = rays.penalties(view.frame, view.camera, points)
        is_rim = _shows_rim(view, uv, away_m)
        # A picture tells of a place that it sees, or sees past.
        is_told = np.isfinite(penalty) & (is_rim | _sees_past(view, uv, away_m))
        rows = np.flatnonzero(is_told)
        seen.add(rows, penalty[rows], is_rim[rows, None].astype(np.float32))
        rows = np.flatnonzero(is_told & is_rim)
        rims.add(rows, penalty[rows], _sampled(view, uv[rows]))
    found = rims.values
    return BlendedView(found[:, :3], found[:, 3], seen.values[:, 0] > 0.5)


def disagreement(
    rays: ViewRays,
    pictures: Iterable[tuple[RecordedView, Float[np.ndarray, "n 3"]]],
    *,
    of_rims: bool = False,
) -> Float32[np.ndarray, " n"]:
    """How much what pictures show of a view differs from picture to picture: the standard deviation
    of the root of luminance, inf where no two tell.

    What is taken to stand elsewhere than it does changes with the place of the camera (Seitz and
    Dyer 1999, doi:10.1023/A:1008176507526).

    Args:
        of_rims: of `rims_seen`; else of `blended`.
    """
    codes = _Mean.empty(len(rays.distance_m), 2, _COMPARED_RAD)
    shows = _shows_rim if of_rims else _shows
    for view, points in pictures:
        penalty, uv, away_m = rays.penalties(view.frame, view.camera, points)
        away_m = np.where(np.isfinite(rays.distance_m), away_m, np.inf)
        rows = np.flatnonzero(np.isfinite(penalty) & shows(view, uv, away_m))
        code = np.sqrt(np.maximum(luminance(_sampled(view, uv[rows])[:, :3]), 0.0))
        codes.add(rows, penalty[rows], np.column_stack([code, code * code]))
    mean, square = codes.values.T
    # The best weighs 1.
    is_compared = codes.weight > 1 + _LEAST_COMPARED
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
    return np.where(is_compared, spread, np.float32(np.inf)).astype(np.float32)


@dataclass(eq=False)
class _Mean:
    """Means of what pictures show, each with the weight exp(-penalty / width) relative to the
    best so far."""

    best: Float32[np.ndarray, " n"]
    total: Float32[np.ndarray, "n c"]
    weight: Float32[np.ndarray, " n"]
    width_rad: float

    @staticmethod
    def empty(count: int, channels: int, width_rad: float = _BLENDED_RAD) -> _Mean:
        """Of no picture."""
        nothing = np.zeros((count, channels), np.float32), np.zeros(count, np.float32)
        return _Mean(np.full(count, np.inf, dtype=np.float32), *nothing, width_rad)

    def add(
        self,
        rows: Int64[np.ndarray, " k"],
        penalty: Float32[np.ndarray, " k"],
        values: Float32[np.ndarray, "k c"],
    ) -> None:
        """What one picture shows of some of the rays."""
        better = np.minimum(self.best[rows], penalty)
        fading = np.exp(-(self.best[rows] - better) / self.width_rad)
        weight = np.exp(-(penalty - better) / self.width_rad)
        self.total[rows] = self.total[rows] * fading[:, None] + weight[:, None] * values
        self.weight[rows] = self.weight[rows] * fading + weight
        self.best[rows] = better

    @property
    def values(self) -> Float32[np.ndarray, "n c"]:
        """0 where no picture shows anything."""
        return np.asarray(self.total / np.maximum(self.weight, np.float32(1e-12))[:, None])


def _shows(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether a picture shows at (u, v) what is this far away: nothing stands in front of it."""
    columns, rows = uv.astype(np.int64).T
    near, far = (a[rows, columns].astype(np.float32) for a in (view.near_m, view.far_m))
    is_same = (away_m > near * (1 - _SAME_DISTANCE)) & (away_m < far * (1 + _SAME_DISTANCE))
    return np.where(np.isinf(away_m), np.isinf(far), is_same)


def _shows_rim(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether a picture shows at (u, v) a rim about this far away."""
    columns, rows = uv.astype(np.int64).T
    near = view.near_m[rows, columns].astype(np.float32)
    return view.is_rim[rows, columns] & (np.abs(near - away_m) < _RIM_M)


def _sees_past(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether what a picture shows at (u, v) stands well behind."""
    columns, rows = uv.astype(np.int64).T
    return np.asarray(view.near_m[rows, columns].astype(np.float32) > away_m + _RIM_M)


def _sampled(view: RecordedView, uv: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 4"]:
    """Radiance and sky matte at (u, v), bilinear."""
    height, width = view.sky_matte.shape
    x = np.clip(uv[:, 0] - 0.5, 0, width - 1)
    y = np.clip(uv[:, 1] - 0.5, 0, height - 1)
    j, i = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    sample = np.zeros((len(uv), 4), dtype=np.float32)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - down - (y - i)) * np.abs(1 - right - (x - j))
        at = i + down, j + right
        values = np.column_stack(
            [linear_from_srgb8(view.srgb8[at]) / view.gain, view.sky_matte[at]]
        )
        sample += weight[:, None].astype(np.float32) * values.astype(np.float32)
    sample[:, 3] /= 255
    return sample
