"""Reference path tracing with Mitsuba 3: Principled surfaces, light sampling, soft sun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayHits
from lightsim.core.dome import split_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.mitsuba_variants import Variant, choose_variant, mitsuba_with
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError
from lightsim.render.mitsuba_scene import environment_map, path_traced, rows_at_poles, sun_disc
from lightsim.render.reference.corner_mesh import as_albedo, corner_mesh, mitsuba_mesh
from lightsim.render.reference.renderer import Picture, Shot
from lightsim.render.scene import FrameScene, StaticScene

_MAX_PATHS = 1 << 22
"""Paths traced at once: some 100 bytes each where Mitsuba works in wavefronts."""
_NEAR_CENTRE_PX = (0.503, 0.498)
"""Mitsuba's rays can slip through where two faces meet: pixel centres of level cameras over
gridded meshes lie on such edges in whole rows."""
_STEP_BACK = 1e-4
_STEP_BACK_M = 1e-3


class PathTracer:
    """Takes shots with Mitsuba's `path` integrator (`mitsuba_scene.path_traced`).

    Camera rays are cast by the scene's own caster and handed to Mitsuba just before the surface
    that they see: so inferred meshes stay invisible to cameras, and rolling shutters and principal
    points are exact.

    Args:
        variant: of Mitsuba; None for the fastest that runs (`core.mitsuba_variants`).
    """

    def __init__(self, variant: Variant | None = None) -> None:
        self.variant: Variant = variant or choose_variant()
        self._static: StaticScene | None = None
        self._static_bodies: dict[bool, dict[str, Any]] = {}
        self._scene: FrameScene | None = None
        self._actor_bodies: dict[bool, dict[str, Any]] = {}

    def shoot(
        self,
        scene: FrameScene,
        camera: PinholeCamera,
        view: CameraFrame | RigidTransform,
        shots: Sequence[Shot],
        seed: int,
    ) -> list[Picture]:
        """Linear radiance of each shot, the dome behind surfaces.

        `view` is a recorded frame, or the pose world_from_camera of a still camera.

        Raises:
            FrameMismatchError: the pose does not map `camera` to `world`.
        """
        images = []
        with mitsuba_with(self.variant) as mi:
            for number, shot in enumerate(shots):
                bodies = self._bodies(mi, scene, shot.surfaces == "principled")
                world = _world(mi, bodies, shot, camera_pose(view).translation_m)
                job = _Job(mi, world, scene, camera, view, shot, seed + 7919 * number)
                images.append(self._image(job))
        return images

    def _bodies(self, mi: Any, scene: FrameScene, is_principled: bool) -> dict[str, Any]:
        """Mitsuba meshes of the scene; those of the static part are kept for later frames."""
        static = scene.static
        if static is not self._static:
            self._static, self._static_bodies = static, {}
        if scene is not self._scene:
            self._scene, self._actor_bodies = scene, {}
        if is_principled not in self._static_bodies:
            self._static_bodies[is_principled] = _converted(
                mi, "static", static.meshes, static.normals, is_principled
            )
        if is_principled not in self._actor_bodies:
            self._actor_bodies[is_principled] = _converted(
                mi, "actor", scene.actors, scene.actor_normals, is_principled
            )
        return self._static_bodies[is_principled] | self._actor_bodies[is_principled]

    def _image(self, job: _Job) -> Float32[np.ndarray, "h w 3"]:
        """Bands of rows, and passes, of at most _MAX_PATHS paths."""
        height, width = job.camera.height_px, job.camera.width_px
        samples = job.shot.samples
        rows = max(1, min(height, _MAX_PATHS // (width * samples)))
        per_pass = max(1, min(samples, _MAX_PATHS // (width * rows)))
        image = np.zeros((height, width, 3), dtype=np.float64)
        for top in range(0, height, rows):
            band = np.arange(top, min(top + rows, height))
            for start in range(0, samples, per_pass):
                count = min(per_pass, samples - start)
                rng = np.random.default_rng((job.seed, top, start))
                image[band] += count / samples * self._band(job, band, count, rng)
        return image.astype(np.float32)

    def _band(
        self, job: _Job, rows: Int64[np.ndarray, " r"], samples: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "r w 3"]:
        """Mean radiance of a band of image rows."""
        width = job.camera.width_px
        is_spread = job.shot.is_antialiased
        uv = _pixel_points(rows, width, samples if is_spread else 1, is_spread, rng)
        repeat = 1 if is_spread else samples
        origins, directions = pixel_rays(job.view, job.camera, uv)
        hits = job.scene.camera_caster.intersect(origins, directions)
        seen = np.flatnonzero(hits.is_hit)
        distance = hits.distance_m[seen].astype(np.float64)[:, None]
        start = np.maximum(distance * (1 - _STEP_BACK) - _STEP_BACK_M, 0.0)
        points = origins[seen] + start * directions[seen]
        found = self._radiance(
            job,
            np.repeat(points, repeat, axis=0),
            np.repeat(directions[seen], repeat, axis=0),
            int(rng.integers(1 << 31)),
        )
        radiance = job.shot.dome.look_up(directions).astype(np.float64)
        radiance[seen] = found.reshape(len(seen), repeat, 3).mean(axis=1)
        if job.shot.surfaces == "white":
            radiance[seen] /= _base_colour(job.scene, hits, seen)
        return radiance.reshape(len(rows), width, -1, 3).mean(axis=2)

    def _radiance(
        self,
        job: _Job,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        seed: int,
    ) -> Float[np.ndarray, "n 3"]:
        """Radiance along rays, one path each."""
        mi, world = job.mi, job.world
        if len(origins) == 0:
            return np.zeros((0, 3))
        integrator = world.integrator()
        sampler = mi.load_dict({"type": "independent"})
        if self.variant.startswith("scalar"):
            sampler.seed(seed)
            found = np.empty((len(origins), 3))
            for k, (origin, direction) in enumerate(
                zip(origins.tolist(), directions.tolist(), strict=True)
            ):
                ray = mi.RayDifferential3f(mi.Point3f(origin), mi.Vector3f(direction))
                found[k] = integrator.sample(world, sampler, ray)[0]
            return found
        sampler.seed(seed, len(origins))
        parts = (np.ascontiguousarray(a.T, dtype=np.float32) for a in (origins, directions))
        ray = mi.RayDifferential3f(*(mi.Point3f(part) for part in parts))
        return np.array(integrator.sample(world, sampler, ray)[0]).T.astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Job:
    """A shot with Mitsuba and the scene it is taken of."""

    mi: Any
    world: Any
    scene: FrameScene
    camera: PinholeCamera
    view: CameraFrame | RigidTransform
    shot: Shot
    seed: int


def _converted(
    mi: Any,
    name: str,
    meshes: Sequence[TriMesh],
    normals: Sequence[Float32[np.ndarray, "_ 3"]],
    is_principled: bool,
) -> dict[str, Any]:
    """Mitsuba meshes by name; empty ones are left out."""
    return {
        f"{name}{k}": mitsuba_mesh(mi, f"{name}{k}", corner_mesh(mesh, n), is_principled)
        for k, (mesh, n) in enumerate(zip(meshes, normals, strict=True))
        if len(mesh.faces)
    }


def _world(mi: Any, bodies: dict[str, Any], shot: Shot, around: Float[np.ndarray, "3"]) -> Any:
    rest, sun = split_sun(shot.dome)
    lights: dict[str, Any] = {}
    if shot.has_sky:
        lights["sky"] = environment_map(mi, rows_at_poles(rest))
    if shot.has_sun and sun is not None:
        lights["sun"] = sun_disc(mi, sun, around)
    return path_traced(mi, bodies | lights, shot.bounces)


def pixel_rays(
    view: CameraFrame | RigidTransform, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and directions of pixels: of a recorded frame, or of a still camera at a pose."""
    if isinstance(view, CameraFrame):
        return view.pixel_rays(camera, uv)
    directions = view.rotate(camera.directions(uv))
    return np.broadcast_to(camera_pose(view).translation_m, directions.shape).copy(), directions


def camera_pose(view: CameraFrame | RigidTransform) -> RigidTransform:
    """world_from_camera of a view, at the middle of its readout.

    Raises:
        FrameMismatchError: the pose does not map `camera` to `world`.
    """
    if isinstance(view, CameraFrame):
        return view.world_from_camera
    if (view.dst, view.src) != ("world", "camera"):
        raise FrameMismatchError(
            "the camera pose joins the wrong frames",
            got=f"{view.dst}_from_{view.src}",
            expected="world_from_camera",
        )
    return view


def _pixel_points(
    rows: Int64[np.ndarray, " r"],
    width: int,
    count: int,
    is_spread: bool,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 2"]:
    """(u, v) of `count` points in each pixel of some rows, pixel by pixel: its centre, or evenly
    spread (the golden-ratio sequences of Roberts 2018, turned for each pixel)."""
    shape = (len(rows), width, count)
    within = np.broadcast_to(_NEAR_CENTRE_PX, (*shape, 2)).copy()
    if is_spread:
        turn = rng.random((len(rows), width, 1, 2))
        steps = (np.arange(count)[:, None] + 0.5) * np.array([0.7548776662, 0.5698402910])
        within = (turn + steps) % 1.0
    within[..., 0] += np.arange(width)[:, None]
    within[..., 1] += rows[:, None, None]
    return within.reshape(-1, 2)


def _base_colour(
    scene: FrameScene, hits: RayHits, rows: Int64[np.ndarray, " k"]
) -> Float[np.ndarray, "k 3"]:
    """Base colour of the surfaces that rays meet, as `corner_mesh` gives it to Mitsuba."""
    colour = np.ones((len(rows), 3))
    mesh_index = hits.mesh_index[rows]
    for k, mesh in enumerate(scene.camera_meshes):
        own = np.flatnonzero(mesh_index == k)
        hit = rows[own]
        colour[own] = as_albedo(mesh.colour_at(hits.face_index[hit], hits.barycentric[hit]))
    return colour
