"""Sky mattes without learned weights: which part of each pixel is sky.

The image is cut into small regions of even colour. Each region gets log-odds of being sky from
LiDAR returns and their absence, ray elevation, colour and texture; the odds spread between
regions that meet without an edge; what other frames saw of the sky at the same directions corrects
them; a matting step at full resolution gives soft borders.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.masks.sky_matting import SkyMatte, refine_matte
from lightsim.masks.sky_panorama import (
    CameraSky,
    SkyPanorama,
    SkyView,
    frames_apart,
    panoramas,
)
from lightsim.masks.sky_regions import (
    ColourCounts,
    ImageEvidence,
    RegionGraph,
    keep_open_sky,
    region_graph,
    region_log_odds,
    spread_log_odds,
    with_colours,
)
from lightsim.masks.sure_sky import SURELY_SKY
from lightsim.progress import Progress

_WORKERS = 2
"""Frames worked on at once."""


# None was measured alone; tests/masks hold what the matte must get right on drawn streets.

# Width at which regions are found; borders are refined at full width.
_WORKING_WIDTH_PX = 480
# Felzenszwalb's scale: larger regions for larger values.
_REGION_SCALE = 30.0
# Smallest region at working width.
_MIN_REGION_PX = 24
# No sky is expected below this elevation.
_HORIZON_DEG = 0.0
# Elevations in which a solid surface within range surely gives LiDAR returns.
_LIDAR_BAND_DEG = (2.0, 9.0)
# Largest angle between neighbouring beams in that band.
_LIDAR_BEAM_GAP_DEG = 3.2
# CIE Lab step over two pixels at which two regions stop agreeing.
_EDGE_CONTRAST = 4.0
# Weight of agreement between neighbours against a region's own evidence.
_SMOOTHING = 1.5
# Half width of the soft border, working pixels.
_BORDER_PX = 3
# Image fraction of the smallest sky that does not touch the top of the image.
_MIN_SKY_FRACTION = 0.0015
# Log-odds up to which colours of anything else are learnt from one image; a log's are those of
# returns. Sky's are learnt from what is surely sky: what is less sure would speak for itself, as a
# pale blue front did on street 1.
_LIKELY_NONE = -1.5
# Frames of each camera from which colours are learnt.
_COLOUR_FRAMES = 4
# `sky_mattes` gathers the high returns of every n-th sweep: older viewpoints see higher.
_SWEEP_STEP = 6


def estimate_sky_matte(
    srgb8: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
    lidar_points_world: Float[np.ndarray, "n 3"],
    ego_vehicle_mask: Bool[np.ndarray, "h w"] | None,
    log_colours: ColourCounts | None = None,
    panorama: SkyPanorama | None = None,
) -> SkyMatte:
    """Fraction of each pixel that is sky.

    An image without sky gives zeros. Without LiDAR points, colour, texture and elevation decide
    alone, and a bright plain wall that fills the top of the image can pass for sky.

    Args:
        srgb8: the image.
        camera: its intrinsics, for exactly this image size.
        world_from_camera: the camera's pose; world z is up.
        lidar_points_world: returns around the time of the image; may be empty.
        ego_vehicle_mask: True where the camera sees the ego vehicle.
        log_colours: of sky and anything else, learnt from a whole log; None learns from the
            image, which cannot tell a pale gable in its corner from a cloud.
        panorama: the sky as this camera saw it from other places; None where it did not move.

    Raises:
        InputError: image and camera differ in size.
    """
    height, width = srgb8.shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        raise InputError(
            "the image and the camera differ in size",
            where=f"camera '{camera.name}'",
            got=f"image {width}x{height} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )
    evidence = _gather(srgb8, camera, world_from_camera, lidar_points_world, ego_vehicle_mask)
    if not (evidence.elevation_deg > _HORIZON_DEG).any():
        return SkyMatte(*np.zeros((2, height, width), np.float32))
    labels, sky = _judge(evidence, log_colours, panorama)
    min_px = int(_MIN_SKY_FRACTION * labels.size)
    probability = keep_open_sky(labels, sky, evidence, max(min_px, 1))
    return refine_matte(srgb8, probability, evidence, _BORDER_PX)


def sky_mattes(
    log: DrivingLog, frames: Sequence[CameraFrame], progress: Progress
) -> Iterator[tuple[CameraFrame, SkyMatte]]:
    """Some frames with their mattes, few in memory at a time; what they know of colours and of the
    sky's directions is all of the log's, of which they need not be frames."""
    if not frames:
        return
    points_world = gather_high_points(log)
    colours = learn_colours(log, points_world)
    panorama_by_camera = learn_panoramas(log, points_world, colours)

    def matte_of(frame: CameraFrame) -> SkyMatte:
        return estimate_sky_matte(
            frame.load_srgb8(),
            log.cameras[frame.camera_name],
            frame.world_from_camera,
            points_world,
            log.ego_vehicle_masks.get(frame.camera_name),
            colours,
            panorama_by_camera.get(frame.camera_name),
        )

    # Array operations leave Python's lock, so threads do share the work.
    with ThreadPoolExecutor(_WORKERS) as pool:
        ahead: deque[Future[SkyMatte]] = deque()
        coming = iter(frames)
        for frame in progress.track(frames, "sky mattes", len(frames)):
            ahead.extend(
                pool.submit(matte_of, f) for f in islice(coming, _WORKERS - len(ahead) + 1)
            )
            yield frame, ahead.popleft().result()


def learn_colours(log: DrivingLog, points_world: Float[np.ndarray, "n 3"]) -> ColourCounts | None:
    """Colours of what is surely sky, and of what is surely none (what returned a beam: regions
    alone would count bright clouds to it), in some frames of each camera; None where a log shows
    too little of either."""
    total: ColourCounts | None = None
    for name in log.cameras:
        frames = log.frames_of(name)
        for frame in frames[:: max(1, len(frames) // _COLOUR_FRAMES)]:
            evidence = _gather_frame(log, frame, points_world)
            if (evidence.elevation_deg > _HORIZON_DEG).any():
                labels, _, _, first = _before_colours(evidence)
                is_sky = first[labels] > SURELY_SKY
                counts = ColourCounts.of(evidence, is_sky, evidence.has_hit)
                total = counts if total is None else total + counts
    return total if total is not None and total.are_enough else None


def learn_panoramas(
    log: DrivingLog, points_world: Float[np.ndarray, "n 3"], log_colours: ColourCounts | None
) -> dict[str, SkyPanorama]:
    """The sky that each camera saw, by direction; of cameras that moved."""
    skies: dict[str, CameraSky] = {}
    for name in log.cameras:
        views = []
        for frame in frames_apart(log.frames_of(name)):
            evidence = _gather_frame(log, frame, points_world)
            if (evidence.elevation_deg > _HORIZON_DEG).any():
                labels, sky = _judge(evidence, log_colours, None)
                views.append(SkyView(evidence, sky[labels]))
        if views:
            skies[name] = CameraSky.of(views)
    return panoramas(skies)


def _judge(
    evidence: ImageEvidence, log_colours: ColourCounts | None, panorama: SkyPanorama | None
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, " n"]]:
    """Regions and their log-odds of being sky, by all that is known."""
    labels, graph, own, first = _before_colours(evidence)
    odds = first[labels]
    colours = ColourCounts.of(evidence, odds > SURELY_SKY, odds < _LIKELY_NONE)
    if panorama is None:
        own = with_colours(labels, evidence, own, colours, log_colours)
    else:
        agreement = panorama.compare(evidence)
        labels = agreement.split(labels)
        graph = region_graph(labels, evidence.lab, _EDGE_CONTRAST, agreement.expected_lab)
        own = region_log_odds(labels, evidence)
        own = with_colours(labels, evidence, own, colours, log_colours, agreement.beside)
        own = agreement.applied_to(labels, own)
    return labels, spread_log_odds(graph, own, _SMOOTHING)


def _before_colours(
    evidence: ImageEvidence,
) -> tuple[Int[np.ndarray, "h w"], RegionGraph, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Regions, how they agree, and their log-odds: their own, and after neighbours agreed."""
    labels = _segment(evidence.lab)
    graph = region_graph(labels, evidence.lab, _EDGE_CONTRAST)
    own = region_log_odds(labels, evidence)
    return labels, graph, own, spread_log_odds(graph, own, _SMOOTHING)


def gather_high_points(log: DrivingLog) -> Float32[np.ndarray, "n 3"]:
    """Static returns of every n-th sweep above the ego's ground, thinned to 0.15 m, in `world`.

    A wall that towers over the LiDAR's field of view nearby was often measured from afar.
    """
    chosen = list(log.sweeps[:: max(1, _SWEEP_STEP)])
    if log.sweeps and chosen[-1] is not log.sweeps[-1]:
        chosen.append(log.sweeps[-1])
    kept = [np.zeros((0, 3), np.float32)]
    for lazy in chosen:
        sweep = lazy.load()
        points = sweep.points_world[sweep.points_world[:, 2] > sweep.origins_world[:, 2] - 0.5]
        is_moving = np.zeros(len(points), bool)
        for actor in log.actors_at(lazy.time_ns):
            if actor.is_moving:
                is_moving |= actor.contains(points, lazy.time_ns, 0.3)
        kept.append(points[~is_moving])
    points_world = np.concatenate(kept)
    cells = np.floor(points_world / 0.15).astype(np.int64)
    _, first = np.unique(cells @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    return points_world[first]


def _gather_frame(
    log: DrivingLog, frame: CameraFrame, points_world: Float[np.ndarray, "n 3"]
) -> ImageEvidence:
    name = frame.camera_name
    ego_vehicle, pose = log.ego_vehicle_masks.get(name), frame.world_from_camera
    return _gather(frame.load_srgb8(), log.cameras[name], pose, points_world, ego_vehicle)


def _gather(
    srgb8: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
    lidar_points_world: Float[np.ndarray, "n 3"],
    ego_vehicle_mask: Bool[np.ndarray, "h w"] | None,
) -> ImageEvidence:
    """Per-pixel evidence at working width."""
    from skimage.color import rgb2lab

    small = camera.scaled(min(1.0, _WORKING_WIDTH_PX / camera.width_px))
    rows, columns = small.height_px, small.width_px
    rgb = resize_area(srgb8.astype(np.float32) / np.float32(255.0), rows, columns)
    directions = world_from_camera.rotate(small.directions(small.pixel_centres()))
    elevation_deg = np.degrees(np.arcsin(np.clip(directions[..., 2], -1.0, 1.0)))
    is_ego_vehicle = np.zeros((rows, columns), bool)
    if ego_vehicle_mask is not None:
        fraction = resize_area(ego_vehicle_mask[..., None].astype(np.float32), rows, columns)
        is_ego_vehicle = fraction[..., 0] > 0.01
    hits = _project_hits(lidar_points_world, small, world_from_camera)
    low, high = _LIDAR_BAND_DEG
    in_band = (elevation_deg > low) & (elevation_deg < high)
    is_silent = np.zeros((rows, columns), bool)
    if hits.any():
        is_silent = in_band & ~_near_hits(hits, small, _LIDAR_BEAM_GAP_DEG)
    return ImageEvidence(
        lab=rgb2lab(rgb).astype(np.float32),
        directions_world=directions.astype(np.float32),
        elevation_deg=elevation_deg.astype(np.float32),
        has_hit=hits,
        is_scanned=elevation_deg < high,
        is_silent=is_silent,
        is_excluded=is_ego_vehicle | (elevation_deg < _HORIZON_DEG),
    )


def _segment(lab: Float32[np.ndarray, "h w 3"]) -> np.ndarray:
    from skimage.segmentation import felzenszwalb

    return felzenszwalb(
        lab.astype(np.float64) / 100.0,
        scale=_REGION_SCALE,
        sigma=0.7,
        min_size=_MIN_REGION_PX,
        channel_axis=-1,
    )


def _project_hits(
    points_world: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
) -> Bool[np.ndarray, "h w"]:
    """Pixels that a return falls into; returns nearer than 1 m are the car's own."""
    hits = np.zeros((camera.height_px, camera.width_px), bool)
    points_camera = world_from_camera.inverse().apply(points_world.astype(np.float64))
    uv, inside = camera.project(points_camera)
    inside &= points_camera[:, 2] > 1.0
    columns, rows = uv[inside].astype(np.int64).T
    hits[rows, columns] = True
    return hits


def _near_hits(
    hits: Bool[np.ndarray, "h w"], camera: PinholeCamera, beam_gap_deg: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels with a return within half a beam gap above or below and 1 pixel beside."""
    from scipy.ndimage import maximum_filter

    reach_px = int(np.ceil(np.tan(np.radians(beam_gap_deg / 2)) * camera.fy))
    return maximum_filter(hits, size=(2 * reach_px + 1, 3))
