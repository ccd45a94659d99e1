"""Stitching of all cameras into one panorama (paper, Sec. 3.2: I_pano = Theta(I, D, P))."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import CLIPPED_CODE, linear_from_srgb8
from lightsim.core.equirect import pixel_directions, uv_from_directions
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.panorama.overlaps import sky_factors
from lightsim.progress import Progress, SilentProgress

CastDepth = Callable[[CameraFrame, PinholeCamera], Float32[np.ndarray, "h w"]]
"""depth_z_m of the reconstructed scene at a camera's size; inf without a surface."""
SkyMatte = Callable[[CameraFrame, PinholeCamera], Float32[np.ndarray, "h w"]]
"""Sky alpha in [0, 1], at the camera's size or at the size of the image."""

# The sensitivity to the following constants was not measured.

# Distance to the camera plane below which points of actors' boxes are not projected, in metres.
_NEAR_M = 0.2

# Camera pixels along one side of a panorama pixel; larger images are reduced to this.
_SAMPLES_PER_PX = 2.0
# Alpha from which a camera pixel counts as sky.
_SKY_THRESHOLD = 0.9
# Margin around the masked boxes of moving actors, in metres.
_ACTOR_MARGIN_M = 0.4


@dataclass(frozen=True)
class StitchConfig:
    """Settings of the panorama."""

    height_px: int = 512
    """Rows of the panorama; it is twice as wide."""
    frame_count: int = 5
    """Number of times of the log whose sky is used; surfaces are taken from the middle one only."""


@dataclass(frozen=True, eq=False)
class _View:
    """One reduced image with the masks and depths that its projection requires."""

    camera: PinholeCamera
    frame: CameraFrame
    radiance: Float32[np.ndarray, "h w 3"]
    is_valid: Bool[np.ndarray, "h w"]
    is_clipped: Bool[np.ndarray, "h w"]
    is_sky: Bool[np.ndarray, "h w"]
    depth_z_m: Float32[np.ndarray, "h w"]


class _Sums:
    """Weighted sums per panorama pixel, separate for clipped and unclipped contributions."""

    def __init__(self, height_px: int) -> None:
        self._count = 2 * height_px * height_px
        self._shape = (height_px, 2 * height_px)
        self._open = np.zeros((self._count, 4))
        self._clipped = np.zeros((self._count, 4))

    def add(
        self,
        index: np.ndarray,
        radiance: Float[np.ndarray, "n 3"],
        weight: Float[np.ndarray, " n"],
        is_clipped: Bool[np.ndarray, " n"],
    ) -> None:
        """Add weighted radiance to the cells of the flat panorama given by `index`."""
        for sums, chosen in ((self._open, ~is_clipped), (self._clipped, is_clipped)):
            for channel in range(3):
                sums[:, channel] += np.bincount(
                    index[chosen],
                    (weight * radiance[:, channel])[chosen],
                    minlength=self._count,
                )
            sums[:, 3] += np.bincount(index[chosen], weight[chosen], minlength=self._count)

    def include(self, other: _Sums, factor: Float[np.ndarray, "3"]) -> None:
        """Add another camera's sums, its radiance times an RGB factor."""
        for own_sums, other_sums in ((self._open, other._open), (self._clipped, other._clipped)):
            own_sums += other_sums * np.append(factor, 1.0)

    def mean(
        self,
    ) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Return mean radiance, the observed pixels, and the pixels that are always clipped."""
        is_open = self._open[:, 3] > 0
        sums = np.where(is_open[:, None], self._open, self._clipped)
        is_seen = sums[:, 3] > 0
        mean = sums[:, :3] / np.where(is_seen, sums[:, 3], 1.0)[:, None]
        return (
            mean.astype(np.float32).reshape(*self._shape, 3),
            is_seen.reshape(self._shape),
            (is_seen & ~is_open).reshape(self._shape),
        )


def stitch_panorama(
    log: DrivingLog,
    camera_gains: Mapping[str, Float32[np.ndarray, "3"]],
    cast_depth: CastDepth,
    sky_matte: SkyMatte,
    config: StitchConfig,
    *,
    progress: Progress | None = None,
) -> Panorama:
    """Return the panorama that the cameras observed around the ego position in the middle of the
    log, scene units.

    Surfaces: every camera pixel of the middle time is unprojected with its depth and projected
    equirectangularly around the mean camera centre; the nearest surface is used. Sky is at
    infinity: every panorama direction is sampled in the cameras at several times, so that it has no
    holes and the ego motion reveals sky behind buildings. Overlaps are averaged after the gains are
    divided out and the cameras' skies are matched (`sky_factors`); clipped pixels are used only
    where all pixels are clipped. A direction that shows sky at any time is sky.

    Raises:
        InputError: the log has no frames, or a camera has no gain.
    """
    missing = [name for name in log.cameras if name not in camera_gains]
    if not log.frames or missing or config.frame_count < 1:
        raise InputError(
            "a panorama cannot be stitched",
            where=log.name,
            got=f"{config.frame_count} moments, {len(log.frames)} frames, no gain for {missing}",
            expected="1 moment or more, 1 frame or more, and a gain for every camera",
        )
    stems = log.stems
    middle = stems[len(stems) // 2]
    picks = np.linspace(0, len(stems) - 1, config.frame_count).round().astype(int)
    picks[np.abs(picks - len(stems) // 2).argmin()] = len(stems) // 2
    chosen = {stems[i] for i in picks}
    centre = np.mean(
        [f.world_from_camera.translation_m for f in log.frames if f.stem == middle], axis=0
    )
    skies = {name: _Sums(config.height_px) for name in log.cameras}
    surfaces = _Sums(config.height_px)
    nearest_m = np.full(2 * config.height_px**2, np.inf, np.float32)
    frames = [f for f in log.frames if f.stem in chosen]
    splats = []
    for frame in (progress or SilentProgress()).track(frames, "stitching the panorama"):
        view = _load_view(
            log, frame, camera_gains[frame.camera_name], cast_depth, sky_matte, config
        )
        # Sky is at infinity and independent of the ego position, so all times contribute to it.
        _add_sky(skies[frame.camera_name], view, config.height_px)
        if frame.stem == middle:
            splats.append(_splat(view, centre, config.height_px))
            np.minimum.at(nearest_m, splats[-1][0], splats[-1][1])
    for index, distance_m, radiance, is_clipped in splats:
        # Tolerance of 5 % plus 0.3 m for depth errors between cameras that observe one surface.
        near = distance_m <= nearest_m[index] * 1.05 + 0.3
        surfaces.add(index[near], radiance[near], np.ones(int(near.sum())), is_clipped[near])
    return _merge(_matched(list(skies.values()), config.height_px), surfaces)


def _matched(skies: list[_Sums], height_px: int) -> _Sums:
    """Return the sum of all cameras' skies, matched in exposure and white balance."""
    means = [sums.mean() for sums in skies]
    factors = sky_factors(
        [radiance for radiance, _, _ in means],
        [is_seen & ~is_clipped for _, is_seen, is_clipped in means],
    )
    sky = _Sums(height_px)
    for sums, factor in zip(skies, factors, strict=True):
        sky.include(sums, factor)
    return sky


def _merge(sky: _Sums, surfaces: _Sums) -> Panorama:
    radiance, is_sky, is_clipped = sky.mean()
    surface, is_surface, is_surface_clipped = surfaces.mean()
    use_surface = is_surface & ~is_sky
    radiance[use_surface] = surface[use_surface]
    is_clipped[use_surface] = is_surface_clipped[use_surface]
    return Panorama(radiance, is_sky | is_surface, is_sky, is_clipped)


def _load_view(
    log: DrivingLog,
    frame: CameraFrame,
    gain: Float32[np.ndarray, "3"],
    cast_depth: CastDepth,
    sky_matte: SkyMatte,
    config: StitchConfig,
) -> _View:
    full = log.cameras[frame.camera_name]
    px_per_rad = _SAMPLES_PER_PX * 2 * config.height_px / (2 * np.pi)
    camera = full.scaled(min(1.0, float(px_per_rad / full.fx)))
    srgb8 = frame.load_srgb8()
    size = (camera.height_px, camera.width_px)
    linear = resize_area(linear_from_srgb8(srgb8), *size)
    saturated = np.any(srgb8 >= CLIPPED_CODE, axis=-1, keepdims=True)
    clipped = resize_area(np.asarray(saturated, np.float32), *size)
    is_valid = ~_moving_actor_mask(log, frame, camera)
    if frame.camera_name in log.ego_vehicle_masks:
        ego_vehicle = log.ego_vehicle_masks[frame.camera_name].astype(np.float32)[..., None]
        is_valid &= resize_area(ego_vehicle, *size)[..., 0] == 0
    matte = sky_matte(frame, camera)
    return _View(
        camera,
        frame,
        (linear / gain).astype(np.float32),
        is_valid,
        clipped[..., 0] > 0.5,
        resize_area(matte[..., None], *size)[..., 0] >= _SKY_THRESHOLD,
        cast_depth(frame, camera),
    )


def _moving_actor_mask(
    log: DrivingLog, frame: CameraFrame, camera: PinholeCamera
) -> Bool[np.ndarray, "h w"]:
    """True where the box of a moving actor may be visible."""
    mask = np.zeros((camera.height_px, camera.width_px), dtype=bool)
    camera_from_world = frame.world_from_camera.inverse()
    for actor in log.actors_at(frame.time_ns):
        if actor.is_moving:
            points = _box_points_world(actor, frame.time_ns)
            front = points[camera_from_world.apply(points)[:, 2] > _NEAR_M]
            if len(front) >= 8:
                _fill_hull(mask, *frame.project(camera, front))
    return mask


def _box_points_world(actor: ActorTrack, time_ns: int) -> Float[np.ndarray, "n 3"]:
    """Grid of points in the box with its margin; the hull of their projections covers the box."""
    # Eight corners do not suffice: near the camera some are behind it and are dropped.
    steps = np.linspace(-0.5, 0.5, 6)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return actor.world_from_actor(time_ns).apply(grid * (actor.size_lwh_m + 2 * _ACTOR_MARGIN_M))


def _fill_hull(
    mask: Bool[np.ndarray, "h w"], uv: Float[np.ndarray, "n 2"], is_inside: Bool[np.ndarray, " n"]
) -> None:
    from scipy.spatial import ConvexHull
    from skimage.draw import polygon

    if not is_inside.any():
        return
    hull = uv[ConvexHull(uv).vertices]
    rows, columns = polygon(hull[:, 1] - 0.5, hull[:, 0] - 0.5, mask.shape)
    mask[rows, columns] = True


def _add_sky(sums: _Sums, view: _View, height_px: int) -> None:
    """Sample a view at every panorama direction; weights decrease towards the image border."""
    directions = pixel_directions(height_px).reshape(-1, 3)
    pose = view.frame.world_from_camera
    index = np.nonzero(directions @ pose.rotation[:, 2] > 0)[0]
    # Sky is placed at 1000 km, so that the camera's motion during its readout does not shift it.
    far = pose.translation_m + 1e6 * directions[index]
    uv, is_inside = view.frame.project(view.camera, far)
    index = index[is_inside]
    column, row = uv[is_inside].astype(np.int64).T
    # The rim of the sky is left out, because its pixels are mixed with buildings and leaves.
    good = view.is_valid & ndimage.binary_erosion(view.is_sky, border_value=1)
    keep = good[row, column]
    index, column, row = index[keep], column[keep], row[keep]
    height, width = view.is_sky.shape
    border = np.minimum.reduce([column + 1, width - column, row + 1, height - row])
    weight = np.clip(border / (0.1 * width), 0.05, 1.0)
    sums.add(index, view.radiance[row, column], weight, view.is_clipped[row, column])


def _splat(
    view: _View, centre_world: Float[np.ndarray, "3"], height_px: int
) -> tuple[np.ndarray, Float32[np.ndarray, " n"], Float32[np.ndarray, "n 3"], np.ndarray]:
    """Return panorama index, distance, radiance and clipping of every surface pixel of a view.

    Pixels that are neither sky nor reconstructed (a roof above the LiDAR) are placed 1 km away.
    """
    chosen = view.is_valid & ~view.is_sky
    depth_m = np.where(np.isfinite(view.depth_z_m), view.depth_z_m, 1000.0)[chosen]
    uv = view.camera.pixel_centres()[chosen]
    origins, rays = view.frame.pixel_rays(view.camera, uv)
    along_m = depth_m / view.camera.directions(uv)[:, 2]
    offset = origins + rays * along_m[:, None] - centre_world
    distance_m = np.linalg.norm(offset, axis=1)
    uv = uv_from_directions(offset / distance_m[:, None])
    column = np.minimum((uv[:, 0] * 2 * height_px).astype(np.int64), 2 * height_px - 1)
    row = np.minimum((uv[:, 1] * height_px).astype(np.int64), height_px - 1)
    return (
        row * 2 * height_px + column,
        distance_m.astype(np.float32),
        view.radiance[chosen],
        view.is_clipped[chosen],
    )
