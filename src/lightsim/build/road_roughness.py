"""Roughness of the road, estimated from the sun's reflection in the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from lightsim.appearance.intrinsic.light import LightAt, ObservedPoints
from lightsim.appearance.intrinsic.road_roughness import estimate_roughness
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.dome import Sun
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SceneAssets, parked_actor_meshes
from lightsim.geometry.completion.view_evidence import spaced_views
from lightsim.geometry.materials import ASPHALT
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.transport.lobes import Lobes, normal_reflectance, sun_in_lobes

# All five were chosen; their sensitivity was not measured.

# Least distance between two views, in metres.
_BASELINE_M = 2.0
# Random pixels of each view.
_PIXELS = 2500
# Largest distance of a road point from the camera, in metres.
_REACH_M = 25.0
# Least z component of the normal of level asphalt: 18 degrees.
_LEVEL = 0.95
# Margin around the boxes of actors, in metres: pixels there may show the actor.
_BESIDE_M = 0.5


def with_measured_road(
    log: DrivingLog, assets: SceneAssets, sun: Sun | None, light_at: LightAt, seed: int
) -> tuple[TriMesh, tuple[str, ...]]:
    """Return the background with the estimated roughness of its asphalt, and a note; unchanged if
    the pictures contain no evidence.

    Args:
        assets: meshes coloured with observed radiance.
        light_at: light of the recorded sky, frame `world`.
    """
    background = assets.background
    if sun is None or sun.direction_world[2] <= 0 or ASPHALT not in background.materials:
        return background, ()
    radiance, points = _road_in_pictures(log, assets, np.random.default_rng(seed))
    if len(radiance) == 0:
        return background, ()
    normal, towards = (
        np.asarray(v).astype(np.float32) for v in (points.normal, points.towards_camera)
    )
    half = towards + sun.direction_world / np.linalg.norm(sun.direction_world)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    # Reflectance of a dielectric (metallic 0), which does not depend on the base colour.
    f0 = normal_reflectance(np.zeros_like(normal), np.zeros(len(normal), np.float32))

    def sun_reflection(roughness: float) -> np.ndarray:
        # Start points of rays, the first argument, are not used: nothing is traced here.
        rough = np.full(len(normal), roughness, np.float32)
        return sun_in_lobes(Lobes(normal, normal, towards, rough, f0), sun)

    half_cosine = (half * normal).sum(axis=1).astype(np.float64)
    found = estimate_roughness(radiance, light_at(points), sun_reflection, half_cosine)
    if found is None:
        return background, ("no picture shows the sun's reflection on the road",)
    # Only asphalt: other level materials, such as pavements, were not examined.
    materials = tuple(
        replace(m, roughness=round(found, 3)) if m == ASPHALT else m for m in background.materials
    )
    note = f"roughness of the road from the sun's reflection: {found:.2f}"
    return replace(background, materials=materials), (note,)


def _road_in_pictures(
    log: DrivingLog, assets: SceneAssets, rng: np.random.Generator
) -> tuple[np.ndarray, ObservedPoints]:
    """Return the radiance of points on level asphalt in single pictures, and these points with
    normals and directions to the camera."""
    # Single pictures, since the colours of meshes are means over many views: a reflection that
    # moves with the camera is averaged out there.
    mesh = assets.background
    caster = make_embree_caster([mesh, *parked_actor_meshes(log, assets)])
    normals = mesh.face_normals()
    is_road = normals[:, 2] > _LEVEL
    if mesh.face_material is not None:
        is_road &= mesh.face_material == mesh.materials.index(ASPHALT)
    views = ((frame, log.cameras[frame.camera_name]) for frame in log.frames)
    parts = []
    for frame, camera in spaced_views(views, _BASELINE_M):
        pixel = _own_pixels(log, frame, rng)
        origins, rays = frame.pixel_rays(camera, pixel + 0.5)
        hits = caster.intersect(origins, rays)
        # Mesh 0 is the background; hits on parked actors are no road.
        is_near = (hits.mesh_index == 0) & (hits.distance_m < _REACH_M)
        rows = np.flatnonzero(is_near & is_road[hits.face_index])
        place = origins[rows] + hits.distance_m[rows, None] * rays[rows]
        is_free = np.ones(len(rows), dtype=bool)
        # Moving actors are not in the caster: the road behind them is hit, but they are observed.
        for track in log.actors_at(frame.time_ns):
            is_free &= ~track.contains(place, frame.time_ns, _BESIDE_M)
        rows, place = rows[is_free], place[is_free]
        seen = linear_from_srgb8(frame.load_srgb8()[pixel[rows, 1], pixel[rows, 0]])
        radiance = seen / assets.camera_gains[frame.camera_name]
        parts.append((radiance, place, normals[hits.face_index[rows]], -rays[rows]))
    # concatenate refuses an empty list of parts.
    nothing = (np.zeros((0, 3)),) * 4
    radiance, position, normal, towards = map(np.concatenate, zip(nothing, *parts, strict=True))
    rough = np.full(len(radiance), ASPHALT.roughness)
    return radiance, ObservedPoints(position, normal, towards, rough)


def _own_pixels(
    log: DrivingLog, frame: CameraFrame, rng: np.random.Generator
) -> Int64[np.ndarray, "n 2"]:
    """Return random pixels (column, row) of a frame that do not show the ego vehicle."""
    camera = log.cameras[frame.camera_name]
    size = np.array([camera.width_px, camera.height_px])
    pixel = np.floor(rng.random((_PIXELS, 2)) * size).astype(np.int64)
    own = log.ego_vehicle_masks.get(frame.camera_name)
    return pixel if own is None else pixel[~own[pixel[:, 1], pixel[:, 0]]]
