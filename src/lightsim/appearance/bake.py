"""Colour of every texel from all images that observe it (paper Sec. 3.1: "textured meshes")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8, UInt16

from lightsim.appearance.atlas import (
    choose_resolution,
    edge_lengths_m,
    first_texels,
    pack,
    texels_of,
)
from lightsim.appearance.bake_kernels import (
    code_weight,
    fill_unseen_texels,
    robust_texels,
    sample_texels,
    vertex_sums,
)
from lightsim.appearance.colour import fill_unseen
from lightsim.appearance.config import (
    HIDDEN_REACH_M,
    MIN_FRONT_COSINE,
    MIN_GROUND_NORMAL_Z,
    AssetConfig,
)
from lightsim.appearance.gains import solve_gains
from lightsim.appearance.observe import (
    DEPTH_STEP_PX,
    MAX_VIEW_M,
    PlacedScene,
    SkyMatte,
    View,
    beside_actors,
    cast_view,
    load_images,
    pixel_weights,
    pixels_per_metre,
)
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Texture, TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1).

# Resolution on the surface, in pixels per metre, of weight 1: the centre of the 8-bit codes.
_WEIGHT_UNIT_PX = 30.0

# Size of texels on unobserved ground and fronts, in metres: `hidden_surfaces` completes them later.
_HIDDEN_TEXEL_M = 0.05
# Height above the cameras, in metres, up to which vehicles may hide house fronts.
_FOOT_ABOVE_EYES_M = 2.0
# Least size of a texel; otherwise it is that of the finest pixel on the face.
_TEXEL_M = 0.01
# Most texels along the edge of a face.
_MAX_RESOLUTION = 32
# Number of texels from which the camera gains are estimated.
_GAIN_SAMPLES = 200_000
# Edge, in metres, of the cells of space within which texels have correlated errors in the gains: a
# car, or a window axis. Sensitivity not measured.
_PLACE_M = 2.0


@dataclass(frozen=True, eq=False)
class TexelSamples:
    """Samples of largest weight of every texel, face after face.

    Args:
        colours: 8-bit sRGB codes, gains not divided out.
        codes: weights (bake_kernels.weight_code); 0 where a slot is empty.
        frames: index into the sampled frames.
    """

    colours: UInt8[np.ndarray, "t k 3"]
    codes: UInt8[np.ndarray, "t k"]
    frames: UInt16[np.ndarray, "t k"]


def bake(
    log: DrivingLog,
    background: TriMesh,
    actors: Mapping[str, TriMesh],
    config: AssetConfig,
    *,
    make_caster: MakeCaster,
    progress: Progress,
    sky_matte: SkyMatte | None = None,
) -> tuple[list[TriMesh], Float32[np.ndarray, "c 3"]]:
    """Return the meshes (background first, then actors) with textures of radiance, and the gains.

    The colour of a vertex is the mean of the observed texels around it; without any, it is
    interpolated along the surface. Unobserved texels are interpolated between the vertices."""
    scene = PlacedScene(log, background, actors, make_caster)
    frames = [
        frame for name in log.cameras for frame in log.frames_of(name)[:: config.every_nth_frame]
    ]
    views, footprint_m = _cast_views(scene, frames, log, progress)
    edges = edge_lengths_m(scene.vertices, scene.faces)
    resolution = choose_resolution(edges, footprint_m, _TEXEL_M, _MAX_RESOLUTION, config.max_texels)
    corner = edges.argmax(axis=1).astype(np.int32)
    table = _Table(scene, resolution, corner, first_texels(resolution))
    samples, towards_camera = _collect(table, views, log, config, sky_matte, progress)
    names = list(log.cameras)
    camera_of_frame = np.array([names.index(f.camera_name) for f in frames], dtype=np.int16)
    gains = np.ones((len(names), 3), dtype=np.float32)
    if config.has_camera_gains:
        gains = _gains(samples, table, camera_of_frame, len(names))
    radiance, is_seen = mean_radiance(samples, gains[camera_of_frame], config.outlier_ratio)
    resting = [(track, track.trajectory.start_ns) for track in scene.resting]
    every = np.arange(len(scene.vertices))
    is_under = beside_actors(scene, resting, every, config.contact_margin_m)
    meshes = _finish(table, edges, radiance, is_seen, is_under)
    first = scene.first_vertex
    return [
        replace(mesh, towards_camera=towards_camera[first[k] : first[k + 1]])
        for k, mesh in enumerate(meshes)
    ], gains


@dataclass(frozen=True, eq=False)
class _Table:
    """Table of the texels of all faces of a scene, face after face."""

    scene: PlacedScene
    resolution: np.ndarray
    corner: np.ndarray
    first: Int64[np.ndarray, " m"]

    @property
    def patch(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Resolution, right corner and first texel of each face, as the kernels require."""
        return self.resolution, self.corner, self.first


def _cast_views(
    scene: PlacedScene, frames: Sequence[CameraFrame], log: DrivingLog, progress: Progress
) -> tuple[list[View], Float32[np.ndarray, " m"]]:
    """Return the views of all frames, and the size of the finest pixel on each face in metres; inf
    where unobserved. Pixels per metre are not stored: they are a third of the views' memory."""
    views, best = [], np.zeros(len(scene.faces), dtype=np.float32)
    for frame in progress.track(frames, "observe the meshes", len(frames)):
        view, pixels_per_m = cast_view(scene, frame, log.cameras[frame.camera_name])
        best[view.faces] = np.maximum(best[view.faces], pixels_per_m)
        views.append(view)
    footprint_m = np.where(best > 0, 1.0 / np.maximum(best, 1e-9), np.inf)
    footprint_m[_hidden_street(scene, frames, best == 0)] = _HIDDEN_TEXEL_M
    return views, footprint_m.astype(np.float32)


def _hidden_street(
    scene: PlacedScene, frames: Sequence[CameraFrame], is_hidden: Bool[np.ndarray, " m"]
) -> Int64[np.ndarray, " k"]:
    """Return unobserved background faces beside the path: ground, or the lower part of a front."""
    from scipy.spatial import KDTree

    background = scene.meshes[0]
    hidden = np.flatnonzero(is_hidden[: len(background.faces)])
    normals = background.face_normals()[hidden]
    middle = background.vertices[background.faces[hidden]].astype(np.float64).mean(axis=1)
    eyes = np.array([frame.world_from_camera.translation_m for frame in frames])
    away_m, nearest = KDTree(eyes[:, :2]).query(middle[:, :2])
    towards, above_m = eyes[nearest, :2] - middle[:, :2], middle[:, 2] - eyes[nearest, 2]
    is_ground = (normals[:, 2] > MIN_GROUND_NORMAL_Z) & (above_m < 0)
    faces_path = (normals[:, :2] * towards).sum(axis=1) > MIN_FRONT_COSINE * away_m
    is_front = faces_path & (above_m < _FOOT_ABOVE_EYES_M)
    return hidden[(away_m < HIDDEN_REACH_M) & (is_ground | is_front)]


def _collect(
    table: _Table,
    views: list[View],
    log: DrivingLog,
    config: AssetConfig,
    sky_matte: SkyMatte | None,
    progress: Progress,
) -> tuple[TexelSamples, Float32[np.ndarray, "n 3"]]:
    """Return samples of the texels, and the mean direction from each vertex to its cameras.

    Directions are unit vectors in the frames of the vertices' meshes; 0 without a camera.
    """
    scene = table.scene
    shape = (int(table.first[-1]), config.samples_per_texel)
    samples = TexelSamples(
        np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8), np.zeros(shape, np.uint16)
    )
    corners = _Corners.empty(len(scene.vertices))
    towards_camera = np.zeros((len(scene.vertices), 3), dtype=np.float32)
    images = load_images(views, log)
    for index, (view, image) in enumerate(progress.track(images, "bake the textures", len(views))):
        frame = view.frame
        inverse_depth = view.inverse_depth.astype(np.float32)
        alpha = None if sky_matte is None else sky_matte(frame)
        ego_vehicle = log.ego_vehicle_masks.get(frame.camera_name)
        focal_px = log.cameras[frame.camera_name].fx
        hidden = view.beside_moving(focal_px), view.behind_leaves(image, focal_px)
        pixel_weight = pixel_weights(image, ego_vehicle, alpha, inverse_depth, *hidden)
        scene.place(frame, MAX_VIEW_M)
        used = _project(corners, scene, view, log.cameras[frame.camera_name], config)
        _add_directions(towards_camera, used, corners, scene, view, config)
        step, tolerance = float(DEPTH_STEP_PX), config.occlusion_tolerance_m
        sample_texels(
            view.faces,
            table.patch,
            scene.faces,
            corners.uv,
            corners.depth_m,
            corners.weight,
            (image, pixel_weight, inverse_depth, step, tolerance, index),
            (samples.colours, samples.codes, samples.frames),
        )
    length = np.linalg.norm(towards_camera, axis=1, keepdims=True)
    return samples, towards_camera / np.where(length > 0, length, 1.0)


def _add_directions(
    total: Float32[np.ndarray, "n 3"],
    used: Int64[np.ndarray, " k"],
    corners: _Corners,
    scene: PlacedScene,
    view: View,
    config: AssetConfig,
) -> None:
    """Add the weighted directions from the vertices visible in a view to its camera, in place."""
    height, width = view.inverse_depth.shape
    column, row = np.floor(corners.uv[used] / DEPTH_STEP_PX).astype(np.int64).T
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    is_inside &= corners.depth_m[used] > 0
    used, row, column = used[is_inside], row[is_inside], column[is_inside]
    nearest = view.inverse_depth[row, column].astype(np.float32)
    tolerance = config.occlusion_tolerance_m + 0.01 * corners.depth_m[used]
    is_seen = (corners.depth_m[used] - tolerance) * nearest < 1.0
    used = used[is_seen]
    towards = view.frame.world_from_camera.translation_m - scene.vertices[used]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    own = scene.directions_in_mesh_frames(used, towards)
    total[used] += (corners.weight[used, None] * own).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Corners:
    """Image positions, depths and weights of vertices in one view; valid for its faces alone.

    The arrays cover the whole scene and are reused by every view.
    """

    uv: Float32[np.ndarray, "n 2"]
    depth_m: Float32[np.ndarray, " n"]
    weight: Float32[np.ndarray, " n"]

    @staticmethod
    def empty(count: int) -> _Corners:
        """Return arrays without a projected vertex; their weight is 0."""
        return _Corners(
            np.zeros((count, 2), np.float32),
            np.zeros(count, np.float32),
            np.zeros(count, np.float32),
        )


def _project(
    corners: _Corners, scene: PlacedScene, view: View, camera: PinholeCamera, config: AssetConfig
) -> Int64[np.ndarray, " k"]:
    """Project the vertices of a view's faces, compute their weights, and return their indices."""
    frame = view.frame
    is_used = np.zeros(len(scene.vertices), dtype=bool)
    is_used[scene.faces[view.faces].ravel()] = True
    used = np.flatnonzero(is_used)
    points = scene.vertices[used].astype(np.float64)
    pose = frame.world_from_camera
    corners.uv[used] = frame.project(camera, points)[0]
    corners.depth_m[used] = (points - pose.translation_m) @ pose.rotation[:, 2]
    sharp = pixels_per_metre(scene.vertices[used], scene.normals[used], pose, camera)
    weight = np.square(sharp / _WEIGHT_UNIT_PX)
    moving = [(track, frame.time_ns) for track in scene.moving]
    is_shaded = beside_actors(scene, moving, used, config.shade_margin_m)
    corners.weight[used] = np.where(is_shaded, 0.0, weight)
    return used


def _gains(
    samples: TexelSamples, table: _Table, camera_of_frame: np.ndarray, camera_count: int
) -> Float32[np.ndarray, "c 3"]:
    """Estimate camera gains from a regular subset of the texels that several images observe."""
    shared = np.flatnonzero((samples.codes > 0).sum(axis=1) > 1)
    shared = shared[:: max(1, len(shared) // _GAIN_SAMPLES)]
    weight_by_code = np.array([code_weight(code) for code in range(256)], dtype=np.float32)
    return solve_gains(
        linear_from_srgb8(samples.colours[shared]),
        weight_by_code[samples.codes[shared]],
        camera_of_frame[samples.frames[shared]],
        _places(table, shared),
        camera_count,
    )


def _places(table: _Table, texels: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Return the index of the cell of edge `_PLACE_M` that contains each texel's face."""
    face = np.searchsorted(table.first, texels, side="right") - 1
    centres = table.scene.vertices[table.scene.faces[face]].mean(axis=1)
    cells = np.floor(centres / _PLACE_M).astype(np.int64)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)


def mean_radiance(
    samples: TexelSamples, gains: Float32[np.ndarray, "f 3"], outlier_ratio: float
) -> tuple[Float32[np.ndarray, "t 3"], Bool[np.ndarray, " t"]]:
    """Return the robust mean radiance of every texel, and the mask of observed texels.

    Args:
        gains: RGB gain of each frame.
        outlier_ratio: see `AssetConfig`.
    """
    count = len(samples.codes)
    radiance, is_seen = np.zeros((count, 3), np.float32), np.zeros(count, dtype=bool)
    robust_texels(
        (samples.colours, samples.codes, samples.frames),
        linear_from_srgb8(np.arange(256, dtype=np.uint8)),
        1.0 / gains,
        float(np.log(outlier_ratio)),
        radiance,
        is_seen,
    )
    return radiance, is_seen


def _finish(
    table: _Table,
    edges_m: Float32[np.ndarray, "m 3"],
    radiance: Float32[np.ndarray, "t 3"],
    is_seen: Bool[np.ndarray, " t"],
    is_under: Bool[np.ndarray, " n"],
) -> list[TriMesh]:
    """Colour all vertices and unobserved texels, and pack a texture for each mesh.

    Args:
        is_under: vertices at the contact of resting actors, where radiance is no evidence of base
            colour; their confidence becomes 0.
    """
    scene = table.scene
    # Heron's formula.
    half = edges_m.astype(np.float64).sum(axis=1) / 2
    area = np.sqrt(np.maximum(half * np.prod(half[:, None] - edges_m, axis=1), 0.0))
    sums, total = np.zeros((len(scene.vertices), 3)), np.zeros(len(scene.vertices))
    vertex_sums(table.patch, scene.faces, area, radiance, is_seen, sums, total)
    is_known = total > 0
    colour = (sums / np.where(is_known, total, 1.0)[:, None]).astype(np.float32)
    # A mid grey if no image shows any vertex.
    usual = np.median(colour[is_known], axis=0) if is_known.any() else np.full(3, 0.2)
    for k, mesh in enumerate(scene.meshes):
        part = slice(scene.first_vertex[k], scene.first_vertex[k + 1])
        colour[part] = fill_unseen(mesh, colour[part], is_known[part], usual)
    fill_unseen_texels(table.patch, scene.faces, colour, radiance, is_seen)
    return [
        _textured(table, k, edges_m, (colour, is_known & ~is_under), radiance)
        for k in range(len(scene.meshes))
    ]


def _textured(
    table: _Table,
    number: int,
    edges_m: Float32[np.ndarray, "m 3"],
    painted: tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]],
    radiance: Float32[np.ndarray, "t 3"],
) -> TriMesh:
    """Return one mesh with vertex colours and texture; unobserved vertices have confidence 0.

    Args:
        painted: colour of the vertices, and the mask of those with an observed colour.
    """
    scene = table.scene
    mesh = scene.meshes[number]
    faces = slice(scene.first_face[number], scene.first_face[number + 1])
    vertices = slice(scene.first_vertex[number], scene.first_vertex[number + 1])
    patches = pack(table.resolution[faces], edges_m[faces])
    pixel = texels_of(patches).pixel
    image = np.zeros((patches.height_px * patches.width_px, 3), np.float32)
    start = int(table.first[faces.start])
    image[pixel] = radiance[start : start + len(pixel)]
    image = image.reshape(patches.height_px, patches.width_px, 3)
    colour, is_seen = painted
    confidence = is_seen[vertices].astype(np.float32)
    if mesh.confidence is not None:
        confidence *= mesh.confidence
    return replace(
        mesh,
        base_colour=colour[vertices],
        texture=Texture(image, patches.corner_uv()),
        confidence=confidence,
    )
