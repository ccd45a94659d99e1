"""Sky mattes without learned weights: the fraction of each pixel that is sky.

The image is divided into small regions of even colour. Each region has log-odds of being sky from
LiDAR returns and their absence, ray elevation, colour and texture. The log-odds are smoothed over
neighbouring regions without an edge between them, and corrected by the sky that other frames
observed in the same directions. Matting at full resolution gives soft borders.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from lightsim.core.ahead import mapped_ahead
from lightsim.core.camera import PinholeCamera
from lightsim.core.cores import worker_count
from lightsim.core.frames import RigidTransform
from lightsim.core.lidar_returns import is_static
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.masks.certain_sky import CERTAIN_LOG_ODDS
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
    smoothed_log_odds,
    with_colours,
)
from lightsim.progress import Progress

# Sensitivity to each constant is not measured; tests/masks has synthetic streets with the cases
# that must not fail.

# Greatest number of frames that are processed in parallel; each needs some hundred megabytes.
_MOST_WORKERS = 8
# Width at which regions are found; borders are refined at full width.
_WORKING_WIDTH_PX = 480
# Elevations at which every surface within range certainly gives LiDAR returns.
_LIDAR_BAND_DEG = (2.0, 9.0)
# Largest angle between neighbouring beams in that band.
_LIDAR_BEAM_GAP_DEG = 3.2
# Area of the smallest sky that does not touch the top of the image, as a fraction of the image.
_MIN_SKY_FRACTION = 0.0015
# Largest log-odds of regions whose colours are samples of surfaces. Samples of sky need
# `CERTAIN_LOG_ODDS`: a lower limit would confirm wrong regions, as a pale blue front on street 1.
_SURFACE_LOG_ODDS = -1.5
# Frames of each camera that contribute to the colours of the log.
_COLOUR_FRAMES = 4
# Step between the sweeps whose high returns are gathered; bounds the time.
_SWEEP_STEP = 6


def estimate_sky_matte(
    srgb8: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
    lidar_points_world: Float[np.ndarray, "n 3"],
    ego_vehicle_mask: Bool[np.ndarray, "h w"] | None,
    log_colours: ColourCounts | None = None,
    panorama: SkyPanorama | None = None,
    regions: Int[np.ndarray, "h w"] | None = None,
) -> SkyMatte:
    """Estimate the fraction of each pixel that is sky; 0 everywhere in an image without sky.

    Without LiDAR points, a bright plain wall that fills the top of the image can be mistaken for
    sky.

    Args:
        srgb8: the image.
        camera: intrinsics for this image size.
        world_from_camera: pose of the camera; world z is up.
        lidar_points_world: returns around the time of the image; may be empty.
        ego_vehicle_mask: True for pixels of the ego vehicle.
        log_colours: colours of sky and surfaces in the whole log. None: colours of the image only,
            which do not distinguish a pale gable in its corner from a cloud.
        panorama: sky that this camera observed at other positions; None if it did not move.
        regions: regions of even colour at working width; None: they are found.

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
    if not _sees_above_horizon(evidence):
        return SkyMatte(*np.zeros((2, height, width), np.float32))
    labels, sky = _classified(
        evidence, _segment(evidence.lab) if regions is None else regions, log_colours, panorama
    )
    min_px = int(_MIN_SKY_FRACTION * labels.size)
    probability = keep_open_sky(labels, sky, evidence, max(min_px, 1))
    return refine_matte(srgb8, probability, evidence)


@dataclass(frozen=True, eq=False)
class SkyModel:
    """Evidence from a whole log for the mattes of its frames.

    Args:
        log: the log.
        points_world: high returns of static surfaces, frame `world`.
        colours: colours of certain sky and of surfaces; None if the log has too few pixels of
            either.
        panorama_by_camera: the observed sky by direction, by name of each camera that moved.
        regions: regions of even colour of the frames from which this was learned, by camera and
            stem, so that they need not be found again.
    """

    log: DrivingLog
    points_world: Float[np.ndarray, "n 3"]
    colours: ColourCounts | None = None
    panorama_by_camera: Mapping[str, SkyPanorama] = field(default_factory=dict)
    regions: dict[tuple[str, str], Int[np.ndarray, "h w"]] = field(default_factory=dict)

    def matte(self, frame: CameraFrame) -> SkyMatte:
        """Return the matte of a frame, which need not be a frame of the log."""
        return estimate_sky_matte(
            frame.load_srgb8(),
            self.log.cameras[frame.camera_name],
            frame.world_from_camera,
            self.points_world,
            self.log.ego_vehicle_masks.get(frame.camera_name),
            self.colours,
            self.panorama_by_camera.get(frame.camera_name),
            self.regions.get((frame.camera_name, frame.stem)),
        )

    def divided(self, frame: CameraFrame) -> tuple[ImageEvidence, Int[np.ndarray, "h w"]]:
        """Return the evidence of a frame and its regions, which are stored in `regions`."""
        name = frame.camera_name
        evidence = _gather(
            frame.load_srgb8(),
            self.log.cameras[name],
            frame.world_from_camera,
            self.points_world,
            self.log.ego_vehicle_masks.get(name),
        )
        key = name, frame.stem
        if key not in self.regions:
            self.regions[key] = _segment(evidence.lab)
        return evidence, self.regions[key]


def learn_sky(log: DrivingLog) -> SkyModel:
    """Collect high returns, colours and observed sky of a log."""
    model = SkyModel(log, gather_high_points(log))
    # Array operations release Python's global lock, so threads run in parallel.
    with ThreadPoolExecutor(_workers()) as pool:
        model = replace(model, colours=_learn_colours(model, pool))
        return replace(model, panorama_by_camera=_learn_panoramas(model, pool))


def sky_mattes(
    model: SkyModel, frames: Sequence[CameraFrame], progress: Progress
) -> Iterator[tuple[CameraFrame, SkyMatte]]:
    """Yield frames with their mattes, few in memory at a time."""
    mattes = mapped_ahead(model.matte, frames, _workers())
    yield from progress.track(zip(frames, mattes, strict=True), "sky mattes", len(frames))


def _workers() -> int:
    return min(worker_count(), _MOST_WORKERS)


def _learn_colours(model: SkyModel, pool: ThreadPoolExecutor) -> ColourCounts | None:
    """Collect colours of certain sky and of surfaces in some frames of each camera.

    Surfaces are pixels with LiDAR returns, since regions without sky can include bright clouds.
    """

    def counted(frame: CameraFrame) -> ColourCounts | None:
        evidence, labels = model.divided(frame)
        if not _sees_above_horizon(evidence):
            return None
        _, _, first = _before_colours(evidence, labels)
        return ColourCounts.of(evidence, first[labels] > CERTAIN_LOG_ODDS, evidence.has_hit)

    total: ColourCounts | None = None
    for name in model.log.cameras:
        frames = model.log.frames_of(name)
        for counts in pool.map(counted, frames[:: max(1, len(frames) // _COLOUR_FRAMES)]):
            if counts is not None:
                total = counts if total is None else total + counts
    return total if total is not None and total.are_enough else None


def _learn_panoramas(model: SkyModel, pool: ThreadPoolExecutor) -> dict[str, SkyPanorama]:
    """Return the observed sky by direction, by name of each camera that moved."""

    def viewed(frame: CameraFrame) -> SkyView | None:
        evidence, labels = model.divided(frame)
        if not _sees_above_horizon(evidence):
            return None
        labels, sky = _classified(evidence, labels, model.colours, None)
        return SkyView(evidence, sky[labels])

    skies: dict[str, CameraSky] = {}
    for name in model.log.cameras:
        found = pool.map(viewed, frames_apart(model.log.frames_of(name)))
        views = [view for view in found if view is not None]
        if views:
            skies[name] = CameraSky.of(views)
    return panoramas(skies)


def _classified(
    evidence: ImageEvidence,
    labels: Int[np.ndarray, "h w"],
    log_colours: ColourCounts | None,
    panorama: SkyPanorama | None,
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, " n"]]:
    """Return regions and their log-odds of being sky, from all evidence."""
    graph, own, first = _before_colours(evidence, labels)
    odds = first[labels]
    colours = ColourCounts.of(evidence, odds > CERTAIN_LOG_ODDS, odds < _SURFACE_LOG_ODDS)
    if panorama is None:
        own = with_colours(labels, evidence, own, colours, log_colours)
    else:
        agreement = panorama.compare(evidence)
        # Regions are divided by kind of agreement before their log-odds are computed anew.
        labels = agreement.split(labels)
        graph = region_graph(labels, evidence.lab, agreement.expected_lab)
        own = region_log_odds(labels, evidence)
        own = with_colours(labels, evidence, own, colours, log_colours, agreement.beside)
        own = agreement.applied_to(labels, own)
    return labels, smoothed_log_odds(graph, own)


def _before_colours(
    evidence: ImageEvidence, labels: Int[np.ndarray, "h w"]
) -> tuple[RegionGraph, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the graph of regions, and their log-odds before and after smoothing over neighbours.

    Colour statistics of the image and the log are not used yet, since they need these log-odds.
    """
    graph = region_graph(labels, evidence.lab)
    own = region_log_odds(labels, evidence)
    return graph, own, smoothed_log_odds(graph, own)


def _sees_above_horizon(evidence: ImageEvidence) -> bool:
    return bool((evidence.elevation_deg > 0.0).any())


def gather_high_points(log: DrivingLog) -> Float32[np.ndarray, "n 3"]:
    """Return static returns of the whole log above the ego's ground, thinned to 0.15 m, in `world`.

    A high wall that exceeds the LiDAR's field of view nearby was often measured from farther away.
    """
    chosen = list(log.sweeps[::_SWEEP_STEP])
    if log.sweeps and chosen[-1] is not log.sweeps[-1]:
        chosen.append(log.sweeps[-1])
    static = [np.zeros((0, 3), np.float32)]
    for lazy in chosen:
        sweep = lazy.load()
        is_high = sweep.points_world[:, 2] > sweep.origins_world[:, 2] - 0.5
        static.append(sweep.points_world[is_high & is_static(sweep, log.actors)])
    points_world = np.concatenate(static)
    cells = np.floor(points_world / 0.15).astype(np.int64)
    # The sum identifies a cell for coordinates within 2^19 cells, 78 km.
    _, first = np.unique(cells @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    return points_world[first]


def _gather(
    srgb8: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
    lidar_points_world: Float[np.ndarray, "n 3"],
    ego_vehicle_mask: Bool[np.ndarray, "h w"] | None,
) -> ImageEvidence:
    """Compute the evidence of each pixel at working width."""
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
        is_silent = in_band & ~_near_hits(hits, small)
    return ImageEvidence(
        lab=rgb2lab(rgb).astype(np.float32),
        directions_world=directions.astype(np.float32),
        elevation_deg=elevation_deg.astype(np.float32),
        has_hit=hits,
        is_scanned=elevation_deg < high,
        is_silent=is_silent,
        is_excluded=is_ego_vehicle | (elevation_deg < 0.0),
    )


def _segment(lab: Float32[np.ndarray, "h w 3"]) -> Int[np.ndarray, "h w"]:
    """Return small regions of even colour (Felzenszwalb and Huttenlocher 2004,
    doi:10.1023/B:VISI.0000022288.19776.77)."""
    from skimage.segmentation import felzenszwalb

    colours = lab.astype(np.float64) / 100.0
    return felzenszwalb(colours, scale=30.0, sigma=0.7, min_size=24, channel_axis=-1)


def _project_hits(
    points_world: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
) -> Bool[np.ndarray, "h w"]:
    """Return True for pixels with a LiDAR return farther than 1 m, that is, not of the ego."""
    hits = np.zeros((camera.height_px, camera.width_px), bool)
    points_camera = world_from_camera.inverse().apply(points_world.astype(np.float64))
    uv, inside = camera.project(points_camera)
    inside &= points_camera[:, 2] > 1.0
    columns, rows = uv[inside].astype(np.int64).T
    hits[rows, columns] = True
    return hits


def _near_hits(hits: Bool[np.ndarray, "h w"], camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
    """Return True for pixels with a return within half a beam gap vertically, 1 pixel sideways."""
    from scipy.ndimage import maximum_filter

    reach_px = int(np.ceil(np.tan(np.radians(_LIDAR_BEAM_GAP_DEG / 2)) * camera.fy))
    return maximum_filter(hits, size=(2 * reach_px + 1, 3))
