"""What the cameras saw at each vertex: visible samples, weighted by how well they see it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int16, Int64, UInt8

from lightsim.assets.colour_kernels import insert_samples
from lightsim.assets.config import AssetConfig
from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.progress import Progress

_HOLD_S = 0.1
_MIN_COSINE = 0.08
_CLIPPED_WEIGHT = 0.02
_BORDER_PX = 2.0


@dataclass(frozen=True, eq=False)
class Samples:
    """The best samples of every vertex of all meshes, in one table.

    Args:
        colours: linear pixel values, gains not divided out.
        weights: 0 where a slot is empty.
        cameras: index into the log's cameras.
    """

    colours: Float32[np.ndarray, "n k 3"]
    weights: Float32[np.ndarray, "n k"]
    cameras: Int16[np.ndarray, "n k"]


@dataclass(frozen=True, eq=False)
class _Part:
    """Vertices placed in frame `world` at one time, and their rows of the table."""

    rows: Int64[np.ndarray, " n"]
    vertices: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]


def collect_samples(
    log: DrivingLog,
    background: TriMesh,
    actors: Mapping[str, TriMesh],
    config: AssetConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
) -> Samples:
    """Sample every vertex in every image that sees it; the table holds the background first,
    then the actors in their order.

    Actors stand where they were when each image was taken, and hide what lies behind them.
    """
    count = len(background.vertices) + sum(len(mesh.vertices) for mesh in actors.values())
    shape = (count, config.samples_per_vertex)
    samples = Samples(
        np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.int16)
    )
    scene = _Scene(log, background, actors, make_caster)
    frames = [
        frame for name in log.cameras for frame in log.frames_of(name)[:: config.every_nth_frame]
    ]
    names = list(log.cameras)
    for frame in progress.track(frames, "colour the meshes", len(frames)):
        camera = log.cameras[frame.camera_name]
        image = _load(frame, camera)
        weight_map = _weight_map(image, log.own_car_masks.get(frame.camera_name), config)
        parts, moving = scene.at(frame, config.max_view_m)
        index = names.index(frame.camera_name)
        for part in parts:
            _sample_part(
                part,
                frame,
                camera,
                (image, weight_map),
                (scene.fixed, moving),
                index,
                config,
                samples,
            )
    return samples


class _Scene:
    """The static caster, and the placed actors of a frame."""

    def __init__(
        self,
        log: DrivingLog,
        background: TriMesh,
        actors: Mapping[str, TriMesh],
        make_caster: MakeCaster,
    ) -> None:
        self._make_caster = make_caster
        tracks = [track for track in log.actors if track.actor_id in actors]
        first_by_id, first = {}, len(background.vertices)
        for actor_id, mesh in actors.items():
            first_by_id[actor_id] = first
            first += len(mesh.vertices)
        self._moving = [
            (track, actors[track.actor_id], first_by_id[track.actor_id])
            for track in tracks
            if track.is_moving
        ]
        self._normals = [mesh.vertex_normals() for _, mesh, _ in self._moving]
        self._fixed_parts = [_part(background, np.arange(len(background.vertices), dtype=np.int64))]
        meshes = [background]
        for track in tracks:
            if not track.is_moving:
                mesh = actors[track.actor_id].moved(_pose(track, track.trajectory.start_ns))
                index = first_by_id[track.actor_id] + np.arange(len(mesh.vertices))
                meshes.append(mesh)
                self._fixed_parts.append(_part(mesh, index.astype(np.int64)))
        self.fixed: RayCaster = make_caster(meshes)
        self._fixed_parts = [_joined(self._fixed_parts)]

    def at(self, frame: CameraFrame, max_view_m: float) -> tuple[list[_Part], RayCaster]:
        """Parts to colour in an image, and the caster of what moves in it."""
        parts, moving = list(self._fixed_parts), []
        for (track, mesh, first), normals in zip(self._moving, self._normals, strict=True):
            if not track.is_present(frame.time_ns, _HOLD_S):
                continue
            pose = _pose(track, frame.time_ns)
            reach = float(np.linalg.norm(track.size_lwh_m))
            if not _is_ahead(frame, pose.translation_m, reach, max_view_m):
                continue
            placed = mesh.moved(pose)
            moving.append(placed)
            turned = pose.rotate(normals.astype(np.float64)).astype(np.float32)
            index = first + np.arange(len(mesh.vertices))
            parts.append(_Part(index.astype(np.int64), placed.vertices, turned))
        return parts, self._make_caster(moving)


def _part(mesh: TriMesh, rows: Int64[np.ndarray, " n"]) -> _Part:
    return _Part(rows, mesh.vertices, mesh.vertex_normals())


def _joined(parts: Sequence[_Part]) -> _Part:
    return _Part(
        np.concatenate([p.rows for p in parts]),
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.normals for p in parts]),
    )


def _pose(track: ActorTrack, time_ns: int) -> RigidTransform:
    return track.world_from_actor(
        time_ns if track.is_moving else track.trajectory.start_ns, _HOLD_S
    )


def _is_ahead(
    frame: CameraFrame, centre_world: Float[np.ndarray, "3"], reach_m: float, max_view_m: float
) -> bool:
    camera_from_world = frame.world_from_camera.inverse()
    centre = camera_from_world.apply(np.asarray(centre_world, dtype=np.float64))
    return bool(centre[2] > -reach_m and np.linalg.norm(centre) < max_view_m + reach_m)


def _load(frame: CameraFrame, camera: PinholeCamera) -> UInt8[np.ndarray, "h w 3"]:
    image = frame.load_srgb8()
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            "the image is not as large as its camera says",
            where=f"{frame.camera_name}/{frame.stem}",
            got=f"{image.shape[1]}x{image.shape[0]} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )
    return image


def _weight_map(
    image: UInt8[np.ndarray, "h w 3"],
    own_car: Bool[np.ndarray, "h w"] | None,
    config: AssetConfig,
) -> Float32[np.ndarray, "h w"]:
    """Little where a channel is clipped, nothing on the recording car."""
    is_clipped = image.max(axis=2) >= config.clipped_code
    weight = np.where(is_clipped, _CLIPPED_WEIGHT, 1.0).astype(np.float32)
    if own_car is not None:
        weight[own_car] = 0.0
    return weight


def _sample_part(
    part: _Part,
    frame: CameraFrame,
    camera: PinholeCamera,
    images: tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]],
    casters: Sequence[RayCaster],
    camera_index: int,
    config: AssetConfig,
    samples: Samples,
) -> None:
    origin = frame.world_from_camera.translation_m
    chosen, uv, weight, rays, distance = _candidates(part, frame, camera, config)
    is_open = np.ones(len(chosen), dtype=bool)
    limit = distance * 0.99 - config.occlusion_tolerance_m
    for caster in casters:
        test = np.flatnonzero(is_open)
        origins = np.broadcast_to(origin, (len(test), 3)).copy()
        is_open[test] = caster.intersect(origins, rays[test]).distance_m >= limit[test]
    chosen, uv, weight = chosen[is_open], uv[is_open], weight[is_open]
    colour, mask = sample_pixels(images[0], images[1], uv)
    insert_samples(
        part.rows[chosen],
        colour,
        (weight * mask).astype(np.float32),
        camera_index,
        samples.colours,
        samples.weights,
        samples.cameras,
    )


def _candidates(
    part: _Part, frame: CameraFrame, camera: PinholeCamera, config: AssetConfig
) -> tuple[
    Int64[np.ndarray, " n"],
    Float64[np.ndarray, "n 2"],
    Float64[np.ndarray, " n"],
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, " n"],
]:
    """Vertices in the image that face it: index, (u, v), weight, ray and distance.

    The weight is the area of the image that a unit of surface covers: near, frontal and tele
    views count most.
    """
    points = frame.world_from_camera.inverse().apply(part.vertices.astype(np.float64))
    uv, is_inside = camera.project(points)
    border = _BORDER_PX
    is_inside &= (uv >= border).all(axis=1) & (uv[:, 0] < camera.width_px - border)
    is_inside &= uv[:, 1] < camera.height_px - border
    chosen = np.flatnonzero(is_inside)
    rays = part.vertices[chosen].astype(np.float64) - frame.world_from_camera.translation_m
    distance = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(distance, 1e-6)[:, None]
    cosine = -(rays * part.normals[chosen]).sum(axis=1)
    is_good = (cosine > _MIN_COSINE) & (distance < config.max_view_m) & (distance > 0.5)
    weight = camera.fx**2 * 1e-4 * cosine**2 / np.maximum(distance, 1.0) ** 2
    return chosen[is_good], uv[chosen[is_good]], weight[is_good], rays[is_good], distance[is_good]


def sample_pixels(
    image: UInt8[np.ndarray, "h w 3"],
    weight_map: Float32[np.ndarray, "h w"],
    uv: Float64[np.ndarray, "n 2"],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
    """Linear colour, bilinear between pixel centres, and the least weight of the four pixels."""
    height, width = weight_map.shape
    x = np.clip(uv[:, 0] - 0.5, 0, width - 1)
    y = np.clip(uv[:, 1] - 0.5, 0, height - 1)
    j, i = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    fx, fy = (x - j).astype(np.float32), (y - i).astype(np.float32)
    colour = np.zeros((len(uv), 3), dtype=np.float32)
    weight = np.full(len(uv), np.inf, dtype=np.float32)
    for di, dj, share in (
        (0, 0, (1 - fx) * (1 - fy)),
        (0, 1, fx * (1 - fy)),
        (1, 0, (1 - fx) * fy),
        (1, 1, fx * fy),
    ):
        colour += share[:, None] * linear_from_srgb8(image[i + di, j + dj])
        weight = np.minimum(weight, weight_map[i + di, j + dj])
    return colour, weight
