"""Image-based rendering: a view blended from recorded images through the twin's geometry.

Unstructured lumigraph rendering (Buehler et al. 2001, doi:10.1145/383259.383309).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Int64, UInt8
from scipy import ndimage

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.sensors import CameraFrame

# The penalty of an image at a pixel is the angle, in radians, between the image's ray and the
# view's, plus terms in the same unit. All weights are chosen by hand; their sensitivity is not
# measured.
#
# Penalty of an image one second away: shadows and reflections move with time.
_PENALTY_PER_S = 0.3
# Penalty of an image one second away for pixels without a surface: a wire that is missing in the
# twin is assumed to be at infinity, so its position differs between images.
_PENALTY_FAR_PER_S = 1.0
# Penalty of an image whose pixels cover e times as much surface as the view's, because it is
# blurred.
_PENALTY_COARSE = 0.1
# Penalty at an image's border. Without it, small differences between cameras leave a seam in the
# sky.
_PENALTY_BORDER = 0.1
# Width over which the border's penalty falls to 0, as a fraction of the image's width.
_BORDER = 0.15
# Decay of the blending weight exp(-penalty / width): images of about this difference are blended.
_BLENDED_RAD = 0.03
# Decay of the weight in the comparison of images, wider than for blending to include more images.
_COMPARED_RAD = 0.1

# Relative tolerance between the distance of a surface and the range of distances in the 3 x 3
# pixels around its projection.
_DISTANCE_TOLERANCE = 0.02
# Depth of a crown, in metres: rims that two images show of one crown may differ by this much.
_RIM_M = 1.0


@dataclass(frozen=True, eq=False)
class RecordedView:
    """Recorded image with the distance of the surface in each pixel; made by `recorded_view`.

    Args:
        frame: frame of the image.
        camera: of the frame.
        srgb8: the image.
        gain: of the camera.
        sky_matte: fraction of sky, in 255ths.
        near_m, far_m: least and greatest distance along the rays of a pixel and its neighbours; inf
            without a surface, NaN for unusable pixels.
        is_rim: pixels that show a part of an actor or crown missing in the twin's mesh; their
            distance is that of the actor or crown.
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
    """Rays of a view and the surfaces they meet.

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
        """Surface points on the rays; far away without a surface."""
        return self.origins_world + self._reach_m[:, None] * self.directions_world

    @property
    def _reach_m(self) -> Float[np.ndarray, " n"]:
        # 100 km is far enough for no parallax.
        return np.where(np.isfinite(self.distance_m), self.distance_m, 1e5)

    def part(self, rows: slice | Int64[np.ndarray, " k"]) -> ViewRays:
        """Return some of the rays."""
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
        """Return the penalty of an image for each ray, and where it shows the ray's surface.

        Args:
            points_world: surface points of the rays at the image's time; NaN if the surface was
                absent then.

        Returns:
            Penalty in radians, inf outside the image, without regard to occlusion. Then (u, v) in
            the image, and the distance from its camera in metres.
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
            # Cameras differ in colour, and the borders of many images of one camera may coincide,
            # so the weight falls to 0 there, which avoids a visible edge.
            penalty -= _BLENDED_RAD * np.log(np.clip(inside, 1e-3, 1.0))
        is_valid = is_inside & np.isfinite(away_m)
        return np.where(is_valid, penalty, np.inf).astype(np.float32), uv, away_m


@dataclass(frozen=True, eq=False)
class BlendedView:
    """View blended from recorded images.

    Args:
        radiance: linear, scene units; 0 for surfaces that no image shows.
        sky_matte: fraction of sky.
        is_observed: at least one image shows the surface.
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
    """Return an image with the distances along its pixels' rays.

    Args:
        sky_matte: fraction of sky in [0, 1].
        distance_m: to the twin's surface along each pixel's ray; inf without one.
        is_usable: mask of usable pixels; False on the ego vehicle.
        rim_m: distance of leaves and outlines in front of the twin's surface, inf elsewhere.
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
    """Return the view from the best image at each pixel, or from the mean of about equally good
    images.

    Args:
        pictures: each image with the rays' surface points at its time; NaN if the surface was
            absent or lit differently.
    """
    mean = _Mean.empty(len(rays.distance_m), 4)
    for view, points in pictures:
        penalty, uv, away_m = rays.penalties(view.frame, view.camera, points)
        away_m = np.where(np.isfinite(rays.distance_m), away_m, np.inf)
        rows = np.flatnonzero(np.isfinite(penalty) & _shows(view, uv, away_m))
        mean.add(rows, penalty[rows], _sampled(view, uv[rows]))
    found = mean.values
    return BlendedView(found[:, :3], found[:, 3], mean.weight > 0)


def observed_rims(
    rays: ViewRays, pictures: Iterable[tuple[RecordedView, Float[np.ndarray, "n 3"]]]
) -> BlendedView:
    """Return the observed rims of actors and crowns beside the twin's meshes, which are too small.

    `is_observed` is true if the majority of the images, by weight, shows a rim on the ray.

    Args:
        rays: `distance_m` is the distance at which they pass the mesh.
        pictures: each image with these points at its time; NaN if the surface was absent or lit
            differently.
    """
    count = len(rays.distance_m)
    rims, fraction = _Mean.empty(count, 4), _Mean.empty(count, 1)
    for view, points in pictures:
        penalty, uv, away_m = rays.penalties(view.frame, view.camera, points)
        is_rim = _shows_rim(view, uv, away_m)
        # An image in which a nearer surface occludes the point is no evidence.
        is_visible = np.isfinite(penalty) & (is_rim | _shows_background(view, uv, away_m))
        rows = np.flatnonzero(is_visible)
        fraction.add(rows, penalty[rows], is_rim[rows, None].astype(np.float32))
        rows = np.flatnonzero(is_visible & is_rim)
        rims.add(rows, penalty[rows], _sampled(view, uv[rows]))
    found = rims.values
    return BlendedView(found[:, :3], found[:, 3], fraction.values[:, 0] > 0.5)


def disagreement(
    rays: ViewRays,
    pictures: Iterable[tuple[RecordedView, Float[np.ndarray, "n 3"]]],
    *,
    of_rims: bool = False,
) -> Float32[np.ndarray, " n"]:
    """Return the standard deviation between images of the square root of luminance, for each ray.

    The colours of a surface at a wrong distance differ between images (photo-consistency; Seitz and
    Dyer 1999, doi:10.1023/A:1008176507526).

    Args:
        pictures: see `blended`.
        of_rims: compare the pixels of `observed_rims`; otherwise those of `blended`.

    Returns:
        Standard deviation; inf for rays with fewer than two images.
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
    # The best image has the weight 1; all others together need 0.2 for a comparison.
    is_compared = codes.weight > 1 + 0.2
    deviation = np.sqrt(np.maximum(square - mean * mean, 0.0))
    return np.where(is_compared, deviation, np.float32(np.inf)).astype(np.float32)


@dataclass(eq=False)
class _Mean:
    """Running weighted means over images.

    The weight of an image is exp(-penalty / width) relative to the best image so far, so that no
    exponential underflows.
    """

    best: Float32[np.ndarray, " n"]
    total: Float32[np.ndarray, "n c"]
    weight: Float32[np.ndarray, " n"]
    width_rad: float

    @staticmethod
    def empty(count: int, channels: int, width_rad: float = _BLENDED_RAD) -> _Mean:
        """Return means over no image."""
        nothing = np.zeros((count, channels), np.float32), np.zeros(count, np.float32)
        return _Mean(np.full(count, np.inf, dtype=np.float32), *nothing, width_rad)

    def add(
        self,
        rows: Int64[np.ndarray, " k"],
        penalty: Float32[np.ndarray, " k"],
        values: Float32[np.ndarray, "k c"],
    ) -> None:
        """Add one image's values at some of the rays."""
        better = np.minimum(self.best[rows], penalty)
        fading = np.exp(-(self.best[rows] - better) / self.width_rad)
        weight = np.exp(-(penalty - better) / self.width_rad)
        self.total[rows] = self.total[rows] * fading[:, None] + weight[:, None] * values
        self.weight[rows] = self.weight[rows] * fading + weight
        self.best[rows] = better

    @property
    def values(self) -> Float32[np.ndarray, "n c"]:
        """Means; 0 for rays without an image."""
        return np.asarray(self.total / np.maximum(self.weight, np.float32(1e-12))[:, None])


def _shows(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return the rays whose surface, at this distance, is visible in an image at (u, v)."""
    columns, rows = uv.astype(np.int64).T
    near, far = (a[rows, columns].astype(np.float32) for a in (view.near_m, view.far_m))
    is_same = (away_m > near * (1 - _DISTANCE_TOLERANCE)) & (
        away_m < far * (1 + _DISTANCE_TOLERANCE)
    )
    return np.where(np.isinf(away_m), np.isinf(far), is_same)


def _shows_rim(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return the rays at which an image shows a rim at about this distance."""
    columns, rows = uv.astype(np.int64).T
    near = view.near_m[rows, columns].astype(np.float32)
    return view.is_rim[rows, columns] & (np.abs(near - away_m) < _RIM_M)


def _shows_background(
    view: RecordedView, uv: Float[np.ndarray, "n 2"], away_m: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return the rays at which an image shows only surfaces well behind this distance."""
    columns, rows = uv.astype(np.int64).T
    return np.asarray(view.near_m[rows, columns].astype(np.float32) > away_m + _RIM_M)


def _sampled(view: RecordedView, uv: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 4"]:
    """Return radiance and sky matte at (u, v), interpolated bilinearly."""
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
