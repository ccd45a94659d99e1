"""Lit and shadowed surface points as the cameras saw them: they tell the sun's strength."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from lightsim.core.casting import MakeCaster, RayCaster, RayHits
from lightsim.core.colour import CLIPPED_CODE, linear_from_srgb8
from lightsim.core.dome import disc_directions
from lightsim.core.equirect import uv_from_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SceneAssets
from lightsim.lighting.sun.surface_samples import LIFT_M
from lightsim.progress import Progress, SilentProgress

# Chosen with streets 0 and 1 and log 002 in view; only what all do together is measured
# (docs/benchmarks/lighting.md).

# Farther points are dropped: a pixel covers too much there.
_MAX_DISTANCE_M = 50.0
# 8-bit codes below this are noise.
_DARKEST_CODE = 4
# Radius about the sun within which visibility must not flip.
_SHADOW_MARGIN_DEG = 2.0
# Shift along the surface within which visibility must not flip.
_SHADOW_MARGIN_M = 0.15
# Cosine-weighted rays that gather the light of the sky and of the surfaces around.
_LIGHT_RAYS = 48


@dataclass(frozen=True)
class EvidenceConfig:
    """How surface points are sampled."""

    sample_count: int = 40000
    """Camera pixels that are cast, over all frames and cameras."""
    frame_count: int = 6
    """Moments of the log that are used, evenly spread."""


@dataclass(frozen=True)
class Surroundings:
    """What stands around the background, frame `world`."""

    parked: Sequence[TriMesh] = ()
    """Actors that never move."""
    occluders: Sequence[TriMesh] = ()
    """Surfaces that cast shadows but are not sampled (inferred roofs)."""


SKY_ROWS = 48
"""Rows of the grid of directions in which open rays are counted."""


@dataclass(frozen=True, eq=False)
class LightEvidence:
    """Surface points in frame `world`.

    Args:
        position_world: metres.
        normal_world: unit, towards the camera.
        radiance: observed linear RGB with the gain divided out, scene units.
        sun_cosine: max(0, normal . sun).
        is_lit: no surface between point and sun, jitter included.
        surface_light: RGB irradiance from the surfaces around, as the cameras saw them shine.
        sky_cells: for each of k cosine-weighted rays the cell of an equirectangular grid of
            `SKY_ROWS` rows where it leaves the scene, or -1 where a surface stops it.
        group: one number per image: only points of one image are compared, because exposures
            may drift.
    """

    position_world: Float[np.ndarray, "n 3"]
    normal_world: Float[np.ndarray, "n 3"]
    radiance: Float32[np.ndarray, "n 3"]
    sun_cosine: Float[np.ndarray, " n"]
    is_lit: Bool[np.ndarray, " n"]
    surface_light: Float[np.ndarray, "n 3"]
    sky_cells: Int[np.ndarray, "n k"]
    group: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.group)

    @property
    def sky_visibility(self) -> Float[np.ndarray, " n"]:
        """Cosine-weighted fraction of the hemisphere that is open."""
        return (self.sky_cells >= 0).mean(axis=1)

    def diffuse_light(self, sky: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 3"]:
        """RGB irradiance without the sun: each point's own part of an (uneven) sky without sun,
        and the measured light of the surfaces around it."""
        cells = _sky_grid(sky)
        cells = np.concatenate([cells, np.zeros((1, 3))])
        return self.surface_light + np.pi * cells[self.sky_cells].mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Points:
    position_world: Float[np.ndarray, "n 3"]
    normal_world: Float[np.ndarray, "n 3"]
    radiance: Float32[np.ndarray, "n 3"]
    mesh_index: Int[np.ndarray, " n"]

    def on_meshes(self, count: int) -> _Points:
        """Those on the first meshes of the caster."""
        keep = self.mesh_index < count
        return _Points(
            self.position_world[keep],
            self.normal_world[keep],
            self.radiance[keep],
            self.mesh_index[keep],
        )


def collect_evidence(
    log: DrivingLog,
    assets: SceneAssets,
    make_caster: MakeCaster,
    sun_direction_world: Float[np.ndarray, "3"],
    config: EvidenceConfig,
    rng: np.random.Generator,
    *,
    around: Surroundings | None = None,
    progress: Progress | None = None,
) -> LightEvidence:
    """Random surface points of the static scene with what they saw of sun and sky.

    Points are dropped that are saturated, dark, far, seen at a grazing angle, on the ego vehicle or
    on a moving actor, or whose sun visibility flips within the margins. Base
    colour of all meshes is observed radiance.
    """
    around = around or Surroundings()
    static = make_caster([assets.background, *around.parked, *around.occluders])
    stems = log.stems
    picks = np.linspace(0, len(stems) - 1, min(config.frame_count, len(stems))).round().astype(int)
    chosen = {stems[i] for i in picks}
    frames = [f for f in log.frames if f.stem in chosen]
    count = max(1, config.sample_count // max(1, len(frames)))
    parts: list[LightEvidence] = []
    for group, frame in enumerate(
        (progress or SilentProgress()).track(frames, "collecting lit and shadowed points")
    ):
        moving = _moving_caster(log, assets, frame.time_ns, make_caster)
        gain = assets.camera_gains[frame.camera_name]
        casters = [static] if moving is None else [static, moving]
        points = _seen_points(log, frame, casters, gain, count, rng)
        points = points.on_meshes(1 + len(around.parked))
        parts.append(_measure(points, casters, sun_direction_world, group, rng))
    return _joined(parts)


def _moving_caster(
    log: DrivingLog, assets: SceneAssets, time_ns: int, make_caster: MakeCaster
) -> RayCaster | None:
    meshes = [
        _placed(assets.actors[a.actor_id].mesh, a.world_from_actor(time_ns))
        for a in log.actors_at(time_ns)
        if a.is_moving and a.actor_id in assets.actors
    ]
    return make_caster(meshes) if meshes else None


def _placed(mesh: TriMesh, world_from_actor: RigidTransform) -> TriMesh:
    return mesh.transformed(RigidTransform("world", mesh.frame, world_from_actor.matrix))


def _seen_points(
    log: DrivingLog,
    frame: CameraFrame,
    casters: Sequence[RayCaster],
    gain: Float32[np.ndarray, "3"],
    count: int,
    rng: np.random.Generator,
) -> _Points:
    camera = log.cameras[frame.camera_name]
    uv = rng.random((count, 2)) * [camera.width_px, camera.height_px]
    column, row = uv.astype(np.int64).T
    srgb8 = frame.load_srgb8()[row, column]
    is_good = (srgb8 >= _DARKEST_CODE).all(1) & (srgb8 < CLIPPED_CODE).all(1)
    if frame.camera_name in log.ego_vehicle_masks:
        is_good &= ~log.ego_vehicle_masks[frame.camera_name][row, column]
    origins, directions = frame.pixel_rays(camera, uv[is_good])
    hits = casters[0].intersect(origins, directions)
    keep = hits.is_hit & (hits.distance_m < _MAX_DISTANCE_M)
    if len(casters) > 1:
        keep &= casters[1].intersect(origins, directions).distance_m > hits.distance_m
    normals = _hit_normals(casters[0], hits)
    facing = np.einsum("ij,ij->i", normals, directions)
    normals = np.where(facing[:, None] > 0, -normals, normals)
    keep &= np.abs(facing) > 0.1
    for actor in log.actors_at(frame.time_ns):
        if actor.is_moving and keep.any():
            points = origins + directions * np.where(keep, hits.distance_m, 0.0)[:, None]
            keep &= ~actor.contains(points, frame.time_ns, 0.5)
    positions = (origins + directions * np.where(keep, hits.distance_m, 0.0)[:, None])[keep]
    radiance = (linear_from_srgb8(srgb8[is_good][keep]) / gain).astype(np.float32)
    return _Points(positions, normals[keep], radiance, hits.mesh_index[keep])


def _hit_normals(caster: RayCaster, hits: RayHits) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the hit faces; zero for misses."""
    normals = np.zeros((len(hits.face_index), 3))
    for index in np.unique(hits.mesh_index[hits.is_hit]):
        chosen = hits.is_hit & (hits.mesh_index == index)
        mesh = caster.meshes[int(index)]
        corners = mesh.vertices[mesh.faces[hits.face_index[chosen]]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normals[chosen] = normal / np.where(length > 0, length, 1.0)
    return normals


def _measure(
    points: _Points,
    casters: Sequence[RayCaster],
    sun: Float[np.ndarray, "3"],
    group: int,
    rng: np.random.Generator,
) -> LightEvidence:
    """Sun and sky visibility; points near a shadow's edge are dropped."""
    start = points.position_world + LIFT_M * points.normal_world
    cosine = points.normal_world @ sun
    hidden = np.stack(
        [
            _occluded(casters, start + shift, direction)
            for direction, shift in _jitters(points.normal_world, sun)
        ]
    )
    is_stable = (hidden.all(0) | ~hidden.any(0)) & (np.abs(cosine) > 0.05)
    is_lit = ~hidden.any(0) & (cosine > 0)
    kept = is_stable
    start, normals = start[kept], points.normal_world[kept]
    cells = np.zeros((len(start), _LIGHT_RAYS), np.int64)
    surface_light = np.zeros((len(start), 3))
    for k in range(_LIGHT_RAYS):
        directions = _cosine_directions(normals, rng)
        radiance, cells[:, k] = _incoming(casters, start, directions)
        surface_light += radiance * (np.pi / _LIGHT_RAYS)
    return LightEvidence(
        points.position_world[kept],
        normals,
        points.radiance[kept],
        np.maximum(cosine, 0.0)[kept],
        is_lit[kept],
        surface_light,
        cells,
        np.full(len(start), group),
    )


def _incoming(
    casters: Sequence[RayCaster],
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Radiance of the nearest surface (0 without one), and the cell of the sky behind (-1 with a
    surface). Below the horizon, where nothing was reconstructed, no light is known."""
    radiance = np.zeros((len(origins), 3))
    nearest_m = np.full(len(origins), np.inf)
    for caster in casters:
        hits = caster.intersect(origins, directions)
        for index in np.unique(hits.mesh_index[hits.is_hit]):
            rows = hits.is_hit & (hits.mesh_index == index) & (hits.distance_m < nearest_m)
            mesh = caster.meshes[int(index)]
            radiance[rows] = mesh.colour_at(hits.face_index[rows], hits.barycentric[rows])
            nearest_m[rows] = hits.distance_m[rows]
    uv = uv_from_directions(directions)
    column = np.minimum((uv[:, 0] * 2 * SKY_ROWS).astype(np.int64), 2 * SKY_ROWS - 1)
    row = np.minimum((uv[:, 1] * SKY_ROWS).astype(np.int64), SKY_ROWS - 1)
    is_open = np.isinf(nearest_m) & (directions[:, 2] > 0)
    return radiance, np.where(is_open, row * 2 * SKY_ROWS + column, -1)


def _sky_grid(sky: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "c 3"]:
    """Mean radiance in the cells of the grid."""
    return resize_area(sky, SKY_ROWS, 2 * SKY_ROWS).reshape(-1, 3).astype(np.float64)


def _jitters(
    normals: Float[np.ndarray, "n 3"], sun: Float[np.ndarray, "3"]
) -> list[tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]]:
    """(direction, shift) of the rays that must agree: the centre, a ring about the sun, and
    four shifts along the surface."""
    still = np.zeros_like(normals)
    centre = np.broadcast_to(sun, normals.shape)
    disc = disc_directions(sun, _SHADOW_MARGIN_DEG, 64)
    ring = disc[np.argsort(disc @ sun)[:16]][::4]
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(normals, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normals, tangent)
    step = _SHADOW_MARGIN_M
    shifts = [step * tangent, -step * tangent, step * other, -step * other]
    found = [(centre, still)]
    found += [(np.broadcast_to(d, normals.shape), still) for d in ring]
    found += [(centre, shift) for shift in shifts]
    return found


def _occluded(
    casters: Sequence[RayCaster],
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, " n"]:
    hidden = np.zeros(len(origins), dtype=bool)
    for caster in casters:
        hidden |= caster.is_occluded(origins, directions)
    return hidden


def _cosine_directions(
    normals: Float[np.ndarray, "n 3"], rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """One cosine-distributed direction about each normal: normal + a point on the sphere."""
    sphere = rng.normal(size=normals.shape)
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = normals + sphere * (1 - 1e-6)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _joined(parts: list[LightEvidence]) -> LightEvidence:
    return LightEvidence(
        np.concatenate([p.position_world for p in parts]),
        np.concatenate([p.normal_world for p in parts]),
        np.concatenate([p.radiance for p in parts]),
        np.concatenate([p.sun_cosine for p in parts]),
        np.concatenate([p.is_lit for p in parts]),
        np.concatenate([p.surface_light for p in parts]),
        np.concatenate([p.sky_cells for p in parts]),
        np.concatenate([p.group for p in parts]),
    )
