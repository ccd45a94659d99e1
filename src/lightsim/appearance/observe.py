"""Views: the faces that each image observes, their depth, and the weights of its pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Float64, Int32, Int64, UInt8
from scipy import ndimage

from lightsim.appearance.bake_kernels import touching_faces
from lightsim.core.actors import ActorTrack
from lightsim.core.ahead import mapped_ahead
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster, RayCaster, RayHits
from lightsim.core.colour import CLIPPED_CODE
from lightsim.core.foliage import crown_beside, foliage_faces, leaves_before
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.outline import grown_outline
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError

SkyMatte = Callable[[CameraFrame], Float32[np.ndarray, "h w"]]
"""Sky alpha of a frame at its image's size, 1 = sky."""

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1).

# Second difference of the inverse depth, relative to it, above which a ray is at an outline.
_EDGE_STEP = 0.05
# Distance from an outline, in pixels, within which a pixel may show the other surface.
_EDGE_RADIUS_PX = 4
# Weight of such a pixel.
_EDGE_WEIGHT = 0.1
# Weight of a pixel with leaves in front of the surface or with a clipped channel: it has an effect
# only if no other view observes the surface.
_POOR_WEIGHT = 0.02
# Least cosine between the surface normal and the direction to the camera.
_MIN_COSINE = 0.05
# Width in pixels of the square that one ray of the depth image covers.
DEPTH_STEP_PX = 2
# Greatest distance of a sampled surface from the camera; the background proxy is nearer.
MAX_VIEW_M = 400.0


@dataclass(frozen=True, eq=False)
class View:
    """Geometry of the scene as one image observes it.

    Args:
        inverse_depth: 1 / depth along the optical axis, in 1/m, one ray for `DEPTH_STEP_PX` x
            `DEPTH_STEP_PX` pixels; 0 where the ray has no hit.
        moving_bits: mask of rays that hit a moving actor, packed.
        leaf_bits: mask of rays that hit foliage, packed.
        faces: indices of the scene's faces that are visible or adjacent to a visible face.
    """

    frame: CameraFrame
    inverse_depth: Float16[np.ndarray, "h w"]
    moving_bits: UInt8[np.ndarray, " b"]
    leaf_bits: UInt8[np.ndarray, " b"]
    faces: Int32[np.ndarray, " c"]

    def beside_moving(self, focal_px: float) -> Bool[np.ndarray, "h w"]:
        """Return the mask of rays that pass a moving actor's incomplete mesh but may show it."""
        is_moving = self._unpacked(self.moving_bits)
        grown = grown_outline(is_moving, self._depth_z_m, focal_px / DEPTH_STEP_PX)
        return (grown > 0) & ~is_moving

    def behind_leaves(
        self, image: UInt8[np.ndarray, "hi wi 3"], focal_px: float
    ) -> Bool[np.ndarray, "h w"]:
        """Return the mask of rays whose pixels show leaves that are not reconstructed."""
        is_leaf, focal_px = self._unpacked(self.leaf_bits), focal_px / DEPTH_STEP_PX
        crown_m = crown_beside(is_leaf, self._depth_z_m, focal_px)
        small = image[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]
        return np.isfinite(leaves_before(small, is_leaf, crown_m, focal_px))

    @property
    def _depth_z_m(self) -> Float32[np.ndarray, "h w"]:
        return np.float32(1.0) / np.maximum(self.inverse_depth.astype(np.float32), 1e-6)

    def _unpacked(self, bits: UInt8[np.ndarray, " b"]) -> Bool[np.ndarray, "h w"]:
        shape = self.inverse_depth.shape
        return np.unpackbits(bits, count=self.inverse_depth.size).reshape(shape).astype(bool)


class PlacedScene:
    """All meshes in one table of vertices and faces, posed at one time.

    The background comes first, then the actors in their order. `vertices` and `normals` are in
    frame `world`. `moving` holds the tracks of the moving actors near the camera. All three are
    updated by `place`. `resting` holds the tracks of actors that never move.
    """

    def __init__(
        self,
        log: DrivingLog,
        background: TriMesh,
        actors: Mapping[str, TriMesh],
        make_caster: MakeCaster,
    ) -> None:
        self._make_caster = make_caster
        self.meshes = [background, *actors.values()]
        self.first_vertex = np.cumsum([0] + [len(m.vertices) for m in self.meshes]).tolist()
        self.first_face = np.cumsum([0] + [len(m.faces) for m in self.meshes]).tolist()
        self._own_normals = [m.vertex_normals() for m in self.meshes]
        self.vertices = np.concatenate([m.vertices for m in self.meshes])
        self.normals = np.concatenate(self._own_normals)
        self.faces = np.concatenate(
            [m.faces + np.int32(o) for m, o in zip(self.meshes, self.first_vertex, strict=False)]
        ).astype(np.int32)
        self.is_foliage = np.concatenate([foliage_faces(mesh) for mesh in self.meshes])
        number = {actor_id: k + 1 for k, actor_id in enumerate(actors)}
        tracks = [track for track in log.actors if track.actor_id in number]
        self._movable = [(track, number[track.actor_id]) for track in tracks if track.is_moving]
        self.moving: list[ActorTrack] = []
        self._rotations: dict[int, Float64[np.ndarray, "3 3"]] = {}
        self.resting: list[ActorTrack] = []
        fixed, self._fixed_numbers = [background], [0]
        for track in tracks:
            if not track.is_moving:
                fixed.append(
                    self._pose_mesh(track, number[track.actor_id], track.trajectory.start_ns)
                )
                self._fixed_numbers.append(number[track.actor_id])
                self.resting.append(track)
        self._fixed: RayCaster = make_caster(fixed)

    def directions_in_mesh_frames(
        self, rows: Int64[np.ndarray, " n"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Rotate directions at vertices `rows` (ascending) to the frames of their meshes."""
        own = directions_world.copy()
        for number, rotation in self._rotations.items():
            part = self._vertices_of(number)
            chosen = slice(*np.searchsorted(rows, (part.start, part.stop)))
            own[chosen] = directions_world[chosen] @ rotation
        return own

    def place(self, frame: CameraFrame, max_view_m: float) -> list[tuple[TriMesh, int]]:
        """Pose the moving actors at a frame's time; return their meshes and mesh numbers."""
        placed: list[tuple[TriMesh, int]] = []
        self.moving = []
        for track, number in self._movable:
            if not track.is_present(frame.time_ns):
                continue
            centre = track.world_from_actor(frame.time_ns).translation_m
            reach = float(np.linalg.norm(track.size_lwh_m))
            if _is_ahead(frame, centre, reach, max_view_m):
                placed.append((self._pose_mesh(track, number, frame.time_ns), number))
                self.moving.append(track)
        return placed

    def casters(self, frame: CameraFrame, max_view_m: float) -> list[tuple[RayCaster, list[int]]]:
        """Call `place`; return the ray casters of resting and of moving meshes, with the mesh
        numbers of each."""
        placed = self.place(frame, max_view_m)
        moving = self._make_caster([mesh for mesh, _ in placed])
        return [(self._fixed, self._fixed_numbers), (moving, [number for _, number in placed])]

    def _vertices_of(self, number: int) -> slice:
        return slice(self.first_vertex[number], self.first_vertex[number + 1])

    def _pose_mesh(self, track: ActorTrack, number: int, time_ns: int) -> TriMesh:
        pose = track.world_from_actor(time_ns)
        mesh = self.meshes[number].transformed(pose)
        part = self._vertices_of(number)
        self._rotations[number] = pose.rotation
        self.vertices[part] = mesh.vertices
        self.normals[part] = pose.rotate(self._own_normals[number].astype(np.float64))
        return mesh


def cast_view(
    scene: PlacedScene, frame: CameraFrame, camera: PinholeCamera
) -> tuple[View, Float32[np.ndarray, " c"]]:
    """Cast the rays of one view.

    Returns:
        The view, and `pixels_per_metre` of each of its faces.
    """
    step = DEPTH_STEP_PX
    shape = (-(-camera.height_px // step), -(-camera.width_px // step))
    v, u = np.indices(shape).reshape(2, -1)
    origins, directions = frame.pixel_rays(camera, (np.stack([u, v], axis=1) + 0.5) * step)
    distance = np.full(len(origins), np.inf, dtype=np.float32)
    face = np.full(len(origins), -1, dtype=np.int32)
    is_moving = np.zeros(len(origins), dtype=bool)
    for movable, (caster, numbers) in enumerate(scene.casters(frame, MAX_VIEW_M)):
        hits = caster.intersect(origins, directions)
        is_nearer = hits.is_hit & (hits.distance_m < distance)
        distance[is_nearer] = hits.distance_m[is_nearer]
        face[is_nearer] = _scene_faces(scene, numbers, hits, is_nearer)
        is_moving[is_nearer] = bool(movable)
    depth = distance * np.maximum(directions @ frame.world_from_camera.rotation[:, 2], 1e-6)
    inverse = np.where(face >= 0, 1.0 / np.maximum(depth, 1e-3), 0.0)
    is_leaf = (face >= 0) & scene.is_foliage[face]
    face[distance >= MAX_VIEW_M] = -1
    faces = np.flatnonzero(touching_faces(scene.faces, face, len(scene.vertices)))
    corners = scene.vertices[scene.faces[faces]].mean(axis=1)
    normals = scene.normals[scene.faces[faces]].mean(axis=1)
    sharp = pixels_per_metre(corners, normals, frame.world_from_camera, camera)
    inverse = inverse.astype(np.float16).reshape(shape)
    view = View(
        frame, inverse, np.packbits(is_moving), np.packbits(is_leaf), faces.astype(np.int32)
    )
    return view, sharp


def _scene_faces(
    scene: PlacedScene, numbers: Sequence[int], hits: RayHits, chosen: Bool[np.ndarray, " n"]
) -> Int32[np.ndarray, " k"]:
    first = np.array([scene.first_face[k] for k in numbers], dtype=np.int64)
    return (first[hits.mesh_index[chosen]] + hits.face_index[chosen]).astype(np.int32)


def _is_ahead(
    frame: CameraFrame, centre_world: Float[np.ndarray, "3"], reach_m: float, max_view_m: float
) -> bool:
    camera_from_world = frame.world_from_camera.inverse()
    centre = camera_from_world.apply(np.asarray(centre_world, dtype=np.float64))
    return bool(centre[2] > -reach_m and np.linalg.norm(centre) < max_view_m + reach_m)


def pixels_per_metre(
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    world_from_camera: RigidTransform,
    camera: PinholeCamera,
) -> Float32[np.ndarray, " n"]:
    """Return the square root of the pixels per square metre of surface; 0 where it faces away."""
    ray = points_world - world_from_camera.translation_m.astype(np.float32)
    distance = np.maximum(np.linalg.norm(ray, axis=1), 0.1)
    cosine = -(ray * normals_world).sum(axis=1) / distance
    return np.where(
        cosine > _MIN_COSINE, camera.fx * np.sqrt(np.maximum(cosine, 0)) / distance, 0
    ).astype(np.float32)


def beside_actors(
    scene: PlacedScene,
    placed: Iterable[tuple[ActorTrack, int]],
    vertices: Int64[np.ndarray, " n"],
    margin_m: float,
) -> Bool[np.ndarray, " n"]:
    """Return the mask of background vertices within a margin of actors' boxes.

    Args:
        placed: actors, each with the time of its box, in nanoseconds.
        vertices: indices of the vertices to test.
    """
    is_near = np.zeros(len(vertices), dtype=bool)
    points = scene.vertices[vertices].astype(np.float64)
    for track, time_ns in placed:
        # A square around the box rejects most vertices before the exact test.
        centre = track.world_from_actor(time_ns).translation_m
        reach = float(np.linalg.norm(track.size_lwh_m)) / 2 + 2 * margin_m
        is_close = np.abs(points[:, 0] - centre[0]) < reach
        is_close &= np.abs(points[:, 1] - centre[1]) < reach
        close = np.flatnonzero(is_close)
        is_near[close] |= track.contains(points[close], time_ns, margin_m)
    return is_near & (vertices < scene.first_vertex[1])


def load_images(
    views: Sequence[View], log: DrivingLog
) -> Iterator[tuple[View, UInt8[np.ndarray, "h w 3"]]]:
    """Yield each view with its image; a thread prefetches the next image."""

    def load(view: View) -> UInt8[np.ndarray, "h w 3"]:
        return load_image(view.frame, log.cameras[view.frame.camera_name])

    yield from zip(views, mapped_ahead(load, views), strict=True)


def load_image(frame: CameraFrame, camera: PinholeCamera) -> UInt8[np.ndarray, "h w 3"]:
    """Read the frame's image, 8-bit sRGB.

    Raises:
        InputError: the image's size differs from its camera's.
    """
    image = frame.load_srgb8()
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            "the size of the image differs from its camera's",
            where=f"{frame.camera_name}/{frame.stem}",
            got=f"{image.shape[1]}x{image.shape[0]} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )
    return image


def pixel_weights(
    image: UInt8[np.ndarray, "h w 3"],
    ego_vehicle: Bool[np.ndarray, "h w"] | None,
    sky_alpha: Float32[np.ndarray, "h w"] | None,
    inverse_depth: Float32[np.ndarray, "h2 w2"],
    beside_moving: Bool[np.ndarray, "h2 w2"],
    behind_leaves: Bool[np.ndarray, "h2 w2"],
) -> Float32[np.ndarray, "h w"]:
    """Return the weight of each pixel as a colour sample.

    Weights are small at clipped pixels, near outlines and behind leaves. They are 0 on the ego
    vehicle, on the sky, and beside moving actors, because other frames show the background there.
    """
    weight = np.where(image.max(axis=2) >= CLIPPED_CODE, _POOR_WEIGHT, 1.0)
    step = DEPTH_STEP_PX
    is_outline = outlines(inverse_depth, _EDGE_STEP, _EDGE_RADIUS_PX / step)
    rays = np.where(is_outline, _EDGE_WEIGHT, 1.0)
    rays[behind_leaves] = _POOR_WEIGHT
    rays[beside_moving] = 0.0
    rays = rays.repeat(step, axis=0).repeat(step, axis=1)
    weight *= rays[: len(weight), : weight.shape[1]]
    if ego_vehicle is not None:
        weight[ego_vehicle] = 0.0
    if sky_alpha is not None:
        weight[sky_alpha > 0.5] = 0.0
    return weight.astype(np.float32)


def outlines(
    inverse_depth: Float32[np.ndarray, "h w"], step: float, radius: float
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of rays near a depth discontinuity, grown by `radius` rays.

    The inverse depth of a plane is linear in the image, so its second difference is 0 at any slant.
    """
    bend = np.zeros_like(inverse_depth)
    for axis in (0, 1):
        middle = np.abs(np.diff(inverse_depth, n=2, axis=axis))
        inner = [slice(None), slice(None)]
        inner[axis] = slice(1, -1)
        bend[tuple(inner)] = np.maximum(bend[tuple(inner)], middle)
    is_edge = bend > step * np.maximum(ndimage.maximum_filter(inverse_depth, 3), 1e-4)
    size = 2 * round(radius) + 1
    return np.asarray(ndimage.maximum_filter(is_edge, size))
