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
from lightsim.render.gbuffers import camera_pose, view_rays
from lightsim.render.mitsuba_scene import environment_map, path_traced, rows_at_poles, sun_disc
from lightsim.render.reference.corner_mesh import as_albedo, corner_mesh, mitsuba_mesh
from lightsim.render.reference.renderer import SEED_STEP, Picture, Shot
from lightsim.render.scene import FrameScene, StaticScene

# Paths traced at once: some 100 bytes each in Mitsuba's wavefront variants, 0.4 GB.
_MAX_PATHS = 1 << 22
# Position of rays within a pixel, near its centre. Mitsuba's rays can pass through the common edge
# of two faces, and pixel centres of level cameras over gridded meshes lie on such edges in whole
# rows.
_NEAR_CENTRE_PX = (0.503, 0.498)


class PathTracer:
    """Reference renderer by Mitsuba's `path` integrator (`mitsuba_scene.path_traced`).

    Camera rays are cast by the scene's own caster, and paths start just before the surface they
    meet. Thus inferred meshes remain invisible to cameras, and rolling shutters and principal
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

    def render_shots(
        self,
        scene: FrameScene,
        camera: PinholeCamera,
        view: CameraFrame | RigidTransform,
        shots: Sequence[Shot],
        seed: int,
    ) -> list[Picture]:
        """Return linear radiance of each shot, with the dome behind surfaces.

        `view` is a recorded frame, or the pose world_from_camera of a static camera.

        Raises:
            FrameMismatchError: the pose does not map `camera` to `world`.
        """
        images = []
        with mitsuba_with(self.variant) as mi:
            for number, shot in enumerate(shots):
                bodies = self._bodies(mi, scene, shot.surfaces == "principled")
                world = _world(mi, bodies, shot, camera_pose(view).translation_m)
                job = _Job(mi, world, scene, camera, view, shot, seed + SEED_STEP * number)
                images.append(self._image(job))
        return images

    def _bodies(self, mi: Any, scene: FrameScene, is_principled: bool) -> dict[str, Any]:
        """Return Mitsuba meshes of the scene; those of the static part are cached for later
        frames."""
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
        """Render bands of rows, in passes of at most _MAX_PATHS paths."""
        height, width = job.camera.height_px, job.camera.width_px
        samples = job.shot.samples
        # Bands first, then passes: a band of one row with all samples may still be too large.
        rows = max(1, min(height, _MAX_PATHS // (width * samples)))
        per_pass = max(1, min(samples, _MAX_PATHS // (width * rows)))
        image = np.zeros((height, width, 3), dtype=np.float64)
        for top in range(0, height, rows):
            band = np.arange(top, min(top + rows, height))
            for start in range(0, samples, per_pass):
                count = min(per_pass, samples - start)
                # The seed depends on band and pass, so the image does not depend on their order.
                rng = np.random.default_rng((job.seed, top, start))
                image[band] += count / samples * self._band(job, band, count, rng)
        return image.astype(np.float32)

    def _band(
        self, job: _Job, rows: Int64[np.ndarray, " r"], samples: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "r w 3"]:
        """Return the mean radiance of a band of image rows."""
        width = job.camera.width_px
        is_antialiased = job.shot.is_antialiased
        uv = _pixel_points(rows, width, samples if is_antialiased else 1, is_antialiased, rng)
        repeat = 1 if is_antialiased else samples
        origins, directions = view_rays(job.view, job.camera, uv)
        hits = job.scene.camera_caster.intersect(origins, directions)
        met = np.flatnonzero(hits.is_hit)
        distance = hits.distance_m[met].astype(np.float64)[:, None]
        # Paths start before their surface, by 1 mm and a ten-thousandth of the distance, which is
        # well above float32 rounding.
        start = np.maximum(distance * (1 - 1e-4) - 1e-3, 0.0)
        points = origins[met] + start * directions[met]
        found = self._radiance(
            job,
            np.repeat(points, repeat, axis=0),
            np.repeat(directions[met], repeat, axis=0),
            int(rng.integers(1 << 31)),
        )
        radiance = job.shot.dome.look_up(directions).astype(np.float64)
        radiance[met] = found.reshape(len(met), repeat, 3).mean(axis=1)
        if job.shot.surfaces == "white":
            # The radiance of a diffuse surface is proportional to its base colour.
            radiance[met] /= _base_colour(job.scene, hits, met)
        return radiance.reshape(len(rows), width, -1, 3).mean(axis=2)

    def _radiance(
        self,
        job: _Job,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        seed: int,
    ) -> Float[np.ndarray, "n 3"]:
        """Return radiance along rays, one path each."""
        mi, world = job.mi, job.world
        if len(origins) == 0:
            return np.zeros((0, 3))
        integrator = world.integrator()
        sampler = mi.load_dict({"type": "independent"})
        # Scalar variants trace one ray a call.
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
    """Shot with Mitsuba and its scene."""

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
    """Return Mitsuba meshes by name, without empty ones."""
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


def _pixel_points(
    rows: Int64[np.ndarray, " r"],
    width: int,
    count: int,
    is_distributed: bool,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 2"]:
    """Return (u, v) of `count` points in each pixel of some rows, pixel by pixel.

    They are the pixel's centre, or evenly distributed (R2 sequence, Roberts 2018, with a random
    offset of each pixel).
    """
    shape = (len(rows), width, count)
    within = np.broadcast_to(_NEAR_CENTRE_PX, (*shape, 2)).copy()
    if is_distributed:
        offset = rng.random((len(rows), width, 1, 2))
        steps = (np.arange(count)[:, None] + 0.5) * np.array([0.7548776662, 0.5698402910])
        within = (offset + steps) % 1.0
    within[..., 0] += np.arange(width)[:, None]
    within[..., 1] += rows[:, None, None]
    return within.reshape(-1, 2)


def _base_colour(
    scene: FrameScene, hits: RayHits, rows: Int64[np.ndarray, " k"]
) -> Float[np.ndarray, "k 3"]:
    """Return the base colour of the surfaces that rays meet, as `corner_mesh` passes it to
    Mitsuba."""
    colour = np.ones((len(rows), 3))
    mesh_index = hits.mesh_index[rows]
    for k, mesh in enumerate(scene.camera_meshes):
        own = np.flatnonzero(mesh_index == k)
        hit = rows[own]
        colour[own] = as_albedo(mesh.colour_at(hits.face_index[hit], hits.barycentric[hit]))
    return colour
