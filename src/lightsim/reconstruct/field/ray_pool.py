"""Training rays of a whole log: camera pixels and LiDAR returns, drawn once before training.

A ray stores the distance of the prior's surface, or without a prior the occupied intervals along
it, and the actor boxes that it passes. A training step then only places samples (paper Sec. 3.1;
UniSim Sec. 3.3: LiDAR makes ray marching efficient).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import RayCaster
from lightsim.core.frames import RigidTransform
from lightsim.core.lidar_returns import actor_labels
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import SWEEP_HOLD_S, CameraFrame, LidarSweep
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.reconstruct.field.occupancy import Occupancy
from lightsim.reconstruct.field.prior_kernels import enter_boxes

# Number of actor boxes along a ray; more are rare and are ignored.
SLOTS = 2
# Margin in metres around a labelled box within which samples belong to its actor.
BOX_MARGIN_M = 0.1
# Greatest distance of a prior's surface, in metres: beyond LiDAR range.
_FAR_M = 250.0
SkyMatte = Callable[[CameraFrame], Float32[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class RayPool:
    """Rays in frame `world`, and in the frames of up to two actor boxes.

    Args:
        origin: metres.
        direction: unit vectors.
        slot_actor: numbers of the actors whose boxes the ray passes, in the order of entry; -1:
            none.
        slot_span_m: distances at which the ray enters and leaves each box.
        slot_origin, slot_direction: the ray in the frame of each actor.
        surface_m: distance of the prior's first surface; inf without one.
        occupied_m: intervals of the ray in occupied space outside boxes
            (`Occupancy.stretches_m`); none (k = 0) with a prior.
        colour: sRGB pixel value in [0, 1] (camera rays; else 0).
        camera: index of the camera, -1 for LiDAR.
        sky: sky alpha of the pixel.
        return_m: measured distance (LiDAR rays; else inf).
        label: 0 static, i + 1 for a return in the box of actor i, -1 unknown.
    """

    origin: Float32[np.ndarray, "n 3"]
    direction: Float32[np.ndarray, "n 3"]
    slot_actor: Int32[np.ndarray, "n 2"]
    slot_span_m: Float32[np.ndarray, "n 2 2"]
    slot_origin: Float32[np.ndarray, "n 2 3"]
    slot_direction: Float32[np.ndarray, "n 2 3"]
    surface_m: Float32[np.ndarray, " n"]
    occupied_m: Float32[np.ndarray, "n k 2"]
    colour: Float32[np.ndarray, "n 3"]
    camera: Int32[np.ndarray, " n"]
    sky: Float32[np.ndarray, " n"]
    return_m: Float32[np.ndarray, " n"]
    label: Int32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.origin)

    def rows(self, index: Int64[np.ndarray, " k"] | Bool[np.ndarray, " n"]) -> RayPool:
        """Return the chosen rays."""
        return RayPool(*[getattr(self, f.name)[index] for f in fields(self)])

    @staticmethod
    def joined(pools: Sequence[RayPool]) -> RayPool:
        """Concatenate several pools."""
        return RayPool(
            *[np.concatenate([getattr(p, f.name) for p in pools]) for f in fields(RayPool)]
        )


@dataclass(frozen=True, eq=False)
class PriorSurfaces:
    """Ray casters over the prior's meshes: the static scene, and each actor in its frame."""

    background: RayCaster
    actors: Mapping[str, RayCaster]


Guide = PriorSurfaces | Occupancy
"""Geometry that guides the placement of samples along rays."""


def camera_rays(
    log: DrivingLog,
    count: int,
    guide: Guide,
    sky_matte: SkyMatte,
    rng: np.random.Generator,
    progress: Progress,
) -> RayPool:
    """Draw about `count` random pixels over all frames, except those of the ego vehicle.

    Raises:
        InputError: the log has no frame.
    """
    if not log.frames:
        raise InputError(
            "the log has no camera frame",
            where=log.name,
            remedy="The neural field requires images: choose other frames, or --neural-steps 0.",
        )
    each = max(1, count // len(log.frames))
    pools = []
    for frame in progress.track(log.frames, "draw camera rays", len(log.frames)):
        camera = log.cameras[frame.camera_name]
        image, matte = frame.load_srgb8(), sky_matte(frame)
        pixel = rng.integers(0, camera.width_px * camera.height_px, each)
        ego_vehicle = log.ego_vehicle_masks.get(frame.camera_name)
        if ego_vehicle is not None:
            pixel = pixel[~ego_vehicle.ravel()[pixel]]
        pools.append(
            replace(
                pixel_rays(log, frame, pixel, guide),
                colour=image.reshape(-1, 3)[pixel].astype(np.float32) / np.float32(255),
                sky=matte.ravel()[pixel],
            )
        )
    return RayPool.joined(pools)


def pixel_rays(
    log: DrivingLog, frame: CameraFrame, pixel: Int64[np.ndarray, " n"], guide: Guide
) -> RayPool:
    """Make the rays of some pixels of a frame, numbered row by row, without their colours."""
    camera = log.cameras[frame.camera_name]
    uv = np.stack([pixel % camera.width_px, pixel // camera.width_px], axis=1) + 0.5
    origin, direction = frame.pixel_rays(camera, uv)
    poses = {
        i: actor.world_from_actor(frame.time_ns)
        for i, actor in enumerate(log.actors)
        if actor.is_present(frame.time_ns)
    }
    number = list(log.cameras).index(frame.camera_name)
    return replace(
        _assemble(origin, direction, log.actors, poses, guide),
        camera=np.full(len(pixel), number, dtype=np.int32),
    )


def lidar_rays(
    log: DrivingLog, count: int, guide: Guide, rng: np.random.Generator, progress: Progress
) -> RayPool:
    """Draw about `count` random returns over all sweeps, each at its own time.

    Raises:
        InputError: the log has no sweep.
    """
    if not log.sweeps:
        raise InputError(
            "the log has no LiDAR sweep",
            where=log.name,
            remedy="The neural field requires LiDAR: add the sweeps, or choose other frames.",
        )
    each = max(1, count // len(log.sweeps))
    pools = []
    for lazy in progress.track(log.sweeps, "draw LiDAR rays", len(log.sweeps)):
        sweep = lazy.load()
        chosen = np.sort(rng.permutation(len(sweep.points_world))[:each])
        labels = actor_labels(sweep, log.actors)
        poses = _poses_at_returns(log, sweep, labels)
        origin = sweep.origins_world[chosen].astype(np.float64)
        offset = sweep.points_world[chosen].astype(np.float64) - origin
        distance = np.linalg.norm(offset, axis=1)
        is_good = (distance > 0.5) & np.isfinite(distance)
        chosen, origin, distance = chosen[is_good], origin[is_good], distance[is_good]
        direction = offset[is_good] / distance[:, None]
        pools.append(
            replace(
                _assemble(origin, direction, log.actors, poses, guide),
                return_m=distance.astype(np.float32),
                label=labels[chosen].astype(np.int32),
            )
        )
    return RayPool.joined(pools)


def _poses_at_returns(
    log: DrivingLog, sweep: LidarSweep, labels: Int64[np.ndarray, " n"]
) -> dict[int, RigidTransform]:
    """Pose of each actor at the median time of its returns, by actor number."""
    poses = {}
    for i, actor in enumerate(log.actors):
        if not actor.is_present(sweep.time_ns, SWEEP_HOLD_S):
            continue
        own = sweep.time_offset_s[labels == i + 1]
        offset_s = float(np.median(own)) if len(own) else 0.0
        time_ns = sweep.time_ns + int(offset_s * 1e9)
        is_known = actor.is_present(time_ns, SWEEP_HOLD_S)
        poses[i] = actor.world_from_actor(time_ns if is_known else sweep.time_ns, SWEEP_HOLD_S)
    return poses


def _assemble(
    origin: Float64[np.ndarray, "n 3"],
    direction: Float64[np.ndarray, "n 3"],
    actors: Sequence[ActorTrack],
    poses: Mapping[int, RigidTransform],
    guide: Guide,
) -> RayPool:
    """Rays at one time with their actor boxes and sample guide, without measurements."""
    count = len(origin)
    numbers = np.array(sorted(poses), dtype=np.int64)
    boxes = [(poses[i].inverse(), actors[i].size_lwh_m / 2 + BOX_MARGIN_M) for i in numbers]
    index = np.full((count, SLOTS), -1, dtype=np.int32)
    entry, leave = (np.full((count, SLOTS), np.inf, dtype=np.float32) for _ in range(2))
    if boxes:
        to_box = np.stack([pose.matrix[:3] for pose, _ in boxes])
        half = np.stack([np.asarray(half, dtype=np.float64) for _, half in boxes])
        enter_boxes(origin, direction, to_box, half, index, entry, leave)
    spans = np.stack([entry, leave], axis=2)
    hits = np.full(count, np.inf, dtype=np.float32)
    occupied = np.zeros((count, 0, 2), dtype=np.float32)
    casters: Mapping[str, RayCaster] = {}
    if isinstance(guide, Occupancy):
        occupied = guide.stretches_m(origin, direction, spans)
    else:
        hits = guide.background.intersect(origin, direction).distance_m.astype(np.float32)
        casters = guide.actors
    slot_origin, slot_direction = (np.zeros((count, SLOTS, 3), np.float32) for _ in range(2))
    slot_actor = np.full((count, SLOTS), -1, dtype=np.int32)
    for b in np.unique(index[index >= 0]).tolist():
        number = int(numbers[b])
        row, slot = np.nonzero(index == b)
        local_origin = boxes[b][0].apply(origin[row])
        local_direction = boxes[b][0].rotate(direction[row])
        slot_origin[row, slot], slot_direction[row, slot] = local_origin, local_direction
        slot_actor[row, slot] = number
        caster = casters.get(actors[number].actor_id)
        if caster is not None:
            found = caster.intersect(local_origin, local_direction).distance_m
            hits[row] = np.minimum(hits[row], found.astype(np.float32))
    hits[hits > _FAR_M] = np.inf
    return RayPool(
        origin.astype(np.float32),
        direction.astype(np.float32),
        slot_actor,
        spans,
        slot_origin,
        slot_direction,
        hits,
        occupied,
        colour=np.zeros((count, 3), np.float32),
        camera=np.full(count, -1, dtype=np.int32),
        sky=np.zeros(count, np.float32),
        return_m=np.full(count, np.inf, np.float32),
        label=np.full(count, -1, dtype=np.int32),
    )
