"""Body of the ego vehicle from LiDAR and the rig: its returns, and its masks without motion.

LiDAR returns of the body keep their place in frame `ego` while the ego moves. While it stands, all
returns do; then the size of vehicles and the labelled boxes bound the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.lidar_returns import EgoBox, is_on_actors, points_on_ego
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LidarSweep
from lightsim.masks.ego_vehicle import enlarged, is_moved_enough

# Sweeps that are examined, evenly distributed over the log; bounds the time.
_SWEEPS = 6
# Fraction of these sweeps with returns at a place of the body; a place of the scene has this only
# while the ego stands.
_PERSISTENT = 0.8
# Half of the greatest width of a vehicle: European and American law allow 2.55 m and 2.6 m.
_HALF_WIDTH_M = 1.3
# Greatest distance of the body's ends from the sensors: the length of a large pickup.
_REACH_M = 4.0
# Length in plan without returns that a body bridges: a windscreen is about 1 m long.
_GAP_M = 1.25
# Height above the ground below which returns are of road and kerbs (up to 0.2 m), not of the body.
_CLEARANCE_M = 0.3
# Length of the bins along the body, and margin of the box around its returns.
_BIN_M = 0.25
# Horizontal distances from the sensors between which the ground is found: outside of the body and
# within the range in which a road is level.
_RING_M = (3.0, 10.0)
# Directions in which the lowest return is taken; their median ignores what stands on the ground.
_DIRECTIONS = 36
# Distance from sensors, in metres, of returns of their mounts, which are no part of the body's
# surface.
_MOUNT_M = 0.5
# Cell of the body's height map, and step along the rays of a camera.
_STEP_M = 0.05
# Width of the reduced masks, in pixels; a pixel is then some 3 cm at 3 m.
_WIDTH_PX = 240
# Largest fraction of an image that a body can cover; more indicates a camera inside of it.
_MOST = 0.5


def with_ego_body(log: DrivingLog, held_out: frozenset[str] = frozenset()) -> DrivingLog:
    """Return the log with the box of the LiDAR returns on the ego vehicle, with masks of it where
    motion finds none, and with a note.

    Args:
        held_out: stems of sweeps that are not examined.
    """
    allowed = [lazy for lazy in log.sweeps if lazy.stem not in held_out]
    chosen = np.unique(np.linspace(0, len(allowed) - 1, _SWEEPS).round().astype(int))
    sweeps = [allowed[i].load() for i in chosen] if allowed else []
    box = find_ego_box(log, sweeps)
    if box is None:
        return log
    surface = np.concatenate([points_on_ego(sweep, log.ego, box)[1] for sweep in sweeps])
    masks = body_masks(log, surface, box)
    length_m, width_m, _ = (box.high_m - box.low_m).tolist()
    note = (
        f"{len(surface) // len(sweeps)} LiDAR returns a sweep lie on the ego vehicle, in a box of "
        f"{length_m:.1f} m x {width_m:.1f} m, and are left out"
    )
    seen = f"; from them, {', '.join(masks)} have a mask of it" if masks else ""
    return replace(
        log,
        ego_box=box,
        ego_vehicle_masks={**log.ego_vehicle_masks, **masks},
        notes=(*log.notes, note + seen),
    )


def find_ego_box(log: DrivingLog, sweeps: Sequence[LidarSweep]) -> EgoBox | None:
    """Return the box of the LiDAR returns on the ego vehicle; None if there are none.

    From the sensors on, the box grows along the vehicle as long as returns within the width of a
    vehicle, outside of labelled boxes and above the ground, are present in most sweeps.
    """
    if not sweeps:
        return None
    rig = _sensors_ego(log, sweeps)
    middle_m, top_m = (rig.min(axis=0) + rig.max(axis=0)) / 2, float(rig[:, 2].max()) + _BIN_M
    sweeps = [s.rows(s.distances_m < 2 * _RING_M[1]) for s in sweeps]
    clouds = [log.ego.to_src(s.points_world, s.times_ns) for s in sweeps]
    low_m = _ground_m(np.concatenate(clouds), middle_m) + _CLEARANCE_M
    near = []
    for sweep, points in zip(sweeps, clouds, strict=True):
        is_near = np.abs(points[:, 1] - middle_m[1]) < _HALF_WIDTH_M
        is_near &= (points[:, 2] > low_m) & (points[:, 2] < top_m)
        near.append(points[is_near & ~is_on_actors(sweep, log.actors)])
    start, end = float(rig[:, 0].min()), float(rig[:, 0].max())
    ahead = _end_of_body([points[:, 0] - end for points in near])
    behind = _end_of_body([start - points[:, 0] for points in near])
    body = np.concatenate(near)
    body = body[(body[:, 0] > start - behind) & (body[:, 0] < end + ahead)]
    if len(body) < len(sweeps):
        return None
    y = body[:, 1]
    return EgoBox(
        np.array([start - behind - _BIN_M, float(y.min()) - _BIN_M, low_m]),
        np.array([end + ahead + _BIN_M, float(y.max()) + _BIN_M, top_m]),
    )


def body_masks(
    log: DrivingLog, surface_ego: Float64[np.ndarray, "n 3"], box: EgoBox
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Return masks at full size of the cameras that see the body and move too little for motion to
    find it.

    Args:
        surface_ego: LiDAR returns of the body.
    """
    masks: dict[str, Bool[np.ndarray, "h w"]] = {}
    still = {
        name: log.frames_of(name)[0]
        for name in log.cameras
        if not is_moved_enough(log.frames_of(name), log.ego)
    }
    if not still:
        return masks
    poses = {
        name: log.ego.held(frame.time_ns).inverse() @ frame.world_from_camera
        for name, frame in still.items()
    }
    sensors = np.stack([pose.translation_m for pose in poses.values()])
    away_m = np.linalg.norm(surface_ego[:, None] - sensors, axis=2).min(axis=1)
    height_at = _height_map(surface_ego[away_m > _MOUNT_M], box)
    if height_at is None:
        return masks
    for name, pose in poses.items():
        camera = log.cameras[name]
        small = camera.scaled(min(1.0, _WIDTH_PX / camera.width_px))
        directions = pose.rotate(small.directions(small.pixel_centres().reshape(-1, 2)))
        is_body = _meets_body(pose.translation_m, directions, height_at, box)
        mask = is_body.reshape(small.height_px, small.width_px)
        if 0.0 < mask.mean() < _MOST:
            masks[name] = enlarged(mask, camera)
    return masks


def _sensors_ego(log: DrivingLog, sweeps: Sequence[LidarSweep]) -> Float64[np.ndarray, "k 3"]:
    """Return positions of LiDARs and cameras, frame `ego`."""
    places = [log.ego.to_src(s.origins_world, s.times_ns) for s in sweeps]
    cameras = [log.frames_of(name)[0] for name in log.cameras]
    times_ns = np.array([frame.time_ns for frame in cameras], dtype=np.int64)
    positions = np.array([f.world_from_camera.translation_m for f in cameras]).reshape(-1, 3)
    if len(cameras):
        places.append(log.ego.to_src(positions, times_ns))
    return np.concatenate(places)


def _ground_m(points_ego: Float[np.ndarray, "n 3"], middle_m: Float[np.ndarray, "3"]) -> float:
    """Return the height of the ground around the ego vehicle: the median over directions of the
    lowest return."""
    x, y = (points_ego[:, :2] - middle_m[:2]).T
    is_ring = (np.hypot(x, y) > _RING_M[0]) & (np.hypot(x, y) < _RING_M[1])
    turn = np.arctan2(y[is_ring], x[is_ring]) / (2 * np.pi) + 0.5
    direction = np.minimum((turn * _DIRECTIONS).astype(np.int64), _DIRECTIONS - 1)
    lowest = np.full(_DIRECTIONS, np.inf)
    np.minimum.at(lowest, direction, points_ego[is_ring, 2])
    lowest = lowest[np.isfinite(lowest)]
    # Without a return around it the vehicle has no ground, and hence no box.
    return float(np.median(lowest)) if len(lowest) else np.inf


def _end_of_body(ways_m: Sequence[Float64[np.ndarray, " _n"]]) -> float:
    """Return how far the body reaches beyond the outermost sensor, in metres.

    Args:
        ways_m: distances of the returns of each sweep in this direction; negative: between the
            sensors.
    """
    edges = np.arange(0.0, _REACH_M + _BIN_M / 2, _BIN_M)
    present = np.stack([np.histogram(way, edges)[0] > 0 for way in ways_m])
    end_m = 0.0
    for start_m in edges[:-1][present.mean(axis=0) >= _PERSISTENT].tolist():
        if start_m - end_m > _GAP_M:
            break
        end_m = start_m + _BIN_M
    return end_m


_HeightMap = Callable[[Float64[np.ndarray, "n 2"]], Float64[np.ndarray, " n"]]


def _height_map(surface_ego: Float64[np.ndarray, "n 3"], box: EgoBox) -> _HeightMap | None:
    """Return a function from (x, y) to the body's upper surface, -inf beside it; None without a
    surface."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    # One return a cell, the highest: they are dense along the beams.
    cell = np.floor((surface_ego[:, :2] - box.low_m[:2]) / (2 * _STEP_M)).astype(np.int64)
    order = np.argsort(-surface_ego[:, 2], kind="stable")
    _, first = np.unique(cell[order], axis=0, return_index=True)
    points = surface_ego[order[first]]
    try:
        between = LinearNDInterpolator(points[:, :2], points[:, 2], fill_value=-np.inf)
    except (QhullError, ValueError):
        return None
    x, y = (np.arange(box.low_m[k], box.high_m[k] + _STEP_M, _STEP_M) for k in range(2))
    heights = between(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))

    def height_at(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
        i, j = np.floor((xy - box.low_m[:2]) / _STEP_M + 0.5).astype(np.int64).T
        is_in = (i >= 0) & (i < len(x)) & (j >= 0) & (j < len(y))
        return np.where(is_in, heights[np.where(is_in, i, 0), np.where(is_in, j, 0)], -np.inf)

    return height_at


def _meets_body(
    origin: Float[np.ndarray, "3"],
    directions: Float64[np.ndarray, "n 3"],
    height_at: _HeightMap,
    box: EgoBox,
) -> Bool[np.ndarray, " n"]:
    """Return True for rays that pass below the body's upper surface, above the ground."""
    reach_m = float(np.linalg.norm(box.high_m - box.low_m))
    is_body = np.zeros(len(directions), dtype=bool)
    for distance_m in np.arange(_STEP_M, reach_m, _STEP_M).tolist():
        rest = np.flatnonzero(~is_body)
        points = origin + distance_m * directions[rest]
        is_low = (points[:, 2] < height_at(points[:, :2])) & (points[:, 2] > box.low_m[2])
        is_body[rest[is_low]] = True
    return is_body
