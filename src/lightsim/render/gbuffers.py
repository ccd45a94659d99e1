"""Geometry buffers of one camera by primary rays through the pixel centres."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int64, Shaped

from lightsim.core.buffers import NO_SURFACE, GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayHits
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError
from lightsim.render.scene import FrameScene

# Primary rays in memory at once. Not measured alone; peaks are in docs/benchmarks/throughput.md.
BAND_RAYS = 1 << 18


def render_gbuffers(
    scene: FrameScene,
    camera: PinholeCamera,
    view: CameraFrame | RigidTransform,
    known: tuple[GBuffers, Int64[np.ndarray, " k"]] | None = None,
) -> GBuffers:
    """Return depth, position, normal, base colour and actor of every pixel (paper, Sec. 4).

    Normals are interpolated between vertices and face the camera. Ambient occlusion is 1:
    `trace_transport` estimates it from its rays.

    Args:
        view: a recorded frame, or the pose world_from_camera of a static camera.
        known: buffers of another scene in the same view, and the (flat) pixels that differ.

    Raises:
        FrameMismatchError: the pose does not map `camera` to `world`.
    """
    height, width = camera.height_px, camera.width_px
    if known is None:
        out, pixels = _empty(height, width), np.arange(height * width)
    else:
        pixels = known[1]
        mask = np.ones((height, width), dtype=bool)
        mask.reshape(-1)[pixels] = False
        # Pixels to cast anew start without a surface: in this scene their rays may meet none.
        out = known[0].within(mask)
    # Allocated only for twins with such estimates.
    if out.found_visibility is None and _is_any_found(scene):
        out = replace(out, found_visibility=np.full((height, width), np.nan, dtype=np.float32))
    centres = camera.pixel_centres().reshape(-1, 2)
    for start in range(0, len(pixels), BAND_RAYS):
        band = pixels[start : start + BAND_RAYS]
        found = cast_primary_rays(scene, camera, view, centres[band])
        index = band[found.rows]
        values = {
            "depth_z_m": found.depth_z_m,
            "position_world": found.position_world,
            "normal_world": found.normal_world,
            "base_colour": found.base_colour,
            "offset_world": found.offset_world,
            "towards_camera_world": found.towards_camera,
            "material": surface_material(scene, found.hits),
            "actor_index": scene.actor_index[found.hits.mesh_index],
        }
        if out.found_visibility is not None:
            values["found_visibility"] = _found_visibility(scene, found.hits)
        for name, value in values.items():
            array = getattr(out, name)
            array.reshape(-1, *array.shape[2:])[index] = value
    return out


def _is_any_found(scene: FrameScene) -> bool:
    return any(mesh.sun_visibility is not None for mesh in scene.camera_meshes)


def _empty(height: int, width: int) -> GBuffers:
    """Return buffers without any surface."""

    def zeros(channels: int) -> Float32[np.ndarray, "h w c"]:
        return np.zeros((height, width, channels), dtype=np.float32)

    return GBuffers(
        np.full((height, width), np.inf, dtype=np.float32),
        zeros(3),
        zeros(3),
        zeros(3),
        np.ones((height, width), dtype=np.float32),
        np.full((height, width), NO_SURFACE, dtype=np.int32),
        zeros(3),
        zeros(3),
        zeros(2),
    )


@dataclass(frozen=True, eq=False)
class PrimaryHits:
    """First surfaces on primary rays.

    Args:
        rows: rays that meet a surface; the other fields hold these rays only.
        hits: the faces.
        offset_world: see core.buffers.GBuffers.
        towards_camera: unit vectors.
    """

    rows: Int64[np.ndarray, " n"]
    hits: RayHits
    depth_z_m: Float32[np.ndarray, " n"]
    position_world: Float32[np.ndarray, "n 3"]
    normal_world: Float32[np.ndarray, "n 3"]
    offset_world: Float32[np.ndarray, "n 3"]
    base_colour: Float32[np.ndarray, "n 3"]
    towards_camera: Float32[np.ndarray, "n 3"]


def cast_primary_rays(
    scene: FrameScene,
    camera: PinholeCamera,
    view: CameraFrame | RigidTransform,
    uv: Float[np.ndarray, "m 2"],
) -> PrimaryHits:
    """Return the surfaces behind points (u, v) of the image."""
    origins, directions = view_rays(view, camera, uv)
    hits = scene.camera_caster.intersect(origins, directions)
    rows = np.flatnonzero(hits.is_hit)
    hits = _select(hits, rows)
    # In double precision, since positions are sums of large coordinates.
    distance = hits.distance_m.astype(np.float64)
    # Depth is along the optical axis, the distance along the ray.
    depth = distance * camera.directions(uv[rows])[:, 2]
    towards = directions[rows]
    position = (origins[rows] + distance[:, None] * towards).astype(np.float32)
    normal, terminator_offset, colour = _surface(scene, hits, towards)
    return PrimaryHits(
        rows,
        hits,
        depth.astype(np.float32),
        position,
        normal,
        position + terminator_offset,
        colour,
        (-towards).astype(np.float32),
    )


def surface_material(scene: FrameScene, hits: RayHits) -> Float32[np.ndarray, "n 2"]:
    """Return roughness and metallic of faces that are visible to cameras."""
    values = np.zeros((len(hits.face_index), 2), dtype=np.float32)
    for k, rows in _rows_by_mesh(scene, hits):
        mesh = scene.camera_meshes[k]
        known = np.array([(m.roughness, m.metallic) for m in mesh.materials], dtype=np.float32)
        if mesh.face_material is None:
            values[rows] = known[0]
        else:
            values[rows] = known[mesh.face_material[hits.face_index[rows]]]
    return values


def _found_visibility(scene: FrameScene, hits: RayHits) -> Float32[np.ndarray, " n"]:
    """Return the sun visibility that the twin stores on its meshes
    (`core.mesh.TriMesh.sun_visibility`)."""
    values = np.full(len(hits.face_index), np.nan, dtype=np.float32)
    for k, rows in _rows_by_mesh(scene, hits):
        mesh = scene.camera_meshes[k]
        values[rows] = mesh.sun_visibility_at(hits.face_index[rows], hits.barycentric[rows])
    return values


def _rows_by_mesh(
    scene: FrameScene, hits: RayHits
) -> Iterator[tuple[int, Int64[np.ndarray, " k"]]]:
    """Yield each camera-visible mesh that has hits: its number and the rows of its hits."""
    count = len(scene.camera_meshes)
    # Sorted once, instead of one mask over all hits for each of many meshes.
    order = np.argsort(hits.mesh_index, kind="stable")
    bounds = np.searchsorted(hits.mesh_index[order], np.arange(count + 1))
    for k in range(count):
        if bounds[k + 1] > bounds[k]:
            yield k, order[bounds[k] : bounds[k + 1]]


def view_rays(
    view: CameraFrame | RigidTransform, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return ray origins and directions, frame `world`, of a frame or of a camera at one pose."""
    if isinstance(view, CameraFrame):
        return view.pixel_rays(camera, uv)
    directions = view.rotate(camera.directions(uv))
    # Broadcasting alone would give a read-only view.
    return np.broadcast_to(camera_pose(view).translation_m, directions.shape).copy(), directions


def camera_pose(view: CameraFrame | RigidTransform) -> RigidTransform:
    """Return world_from_camera of a view, at the middle of its readout.

    Raises:
        FrameMismatchError: the pose does not map `camera` to `world`.
    """
    if isinstance(view, CameraFrame):
        return view.world_from_camera
    if (view.dst, view.src) != ("world", "camera"):
        raise FrameMismatchError(
            "the camera pose has the wrong frames",
            got=f"{view.dst}_from_{view.src}",
            expected="world_from_camera",
        )
    return view


def _select(hits: RayHits, rows: Shaped[np.ndarray, " k"]) -> RayHits:
    return RayHits(
        hits.distance_m[rows], hits.mesh_index[rows], hits.face_index[rows], hits.barycentric[rows]
    )


def _surface(
    scene: FrameScene, hits: RayHits, directions_world: Float[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Return the shading normal that faces the ray, the terminator offset and the base colour of
    each hit."""
    from lightsim.render.transport.kernels import shading_normals

    meshes: Sequence[TriMesh] = scene.camera_meshes
    normal = np.zeros((len(hits.distance_m), 3), dtype=np.float32)
    terminator_offset = np.zeros_like(normal)
    colour = np.zeros_like(normal)
    for k, rows in _rows_by_mesh(scene, hits):
        mesh = meshes[k]
        face, barycentric = hits.face_index[rows], hits.barycentric[rows]
        colour[rows] = mesh.colour_at(face, barycentric)
        found = np.empty((2, len(rows), 3), dtype=np.float32)
        shading_normals(
            (mesh.vertices, mesh.faces),
            scene.camera_normals[k],
            face,
            barycentric,
            directions_world[rows],
            found[0],
            found[1],
        )
        normal[rows], terminator_offset[rows] = found
    return normal, terminator_offset, colour
