"""Ray-traced light at the vertices of the viewer's meshes: rays are traced once for all skies.

The client of viser renders shadows only within about 20 m of its camera, and its sky light is not
occluded. Its lights are therefore off, and light is stored in the vertex colours of the meshes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt16

from lightsim.app.glb import LitFile
from lightsim.app.meshes import MAX_ASSET_TRIANGLES, ViewMeshes, decimated, static_meshes
from lightsim.build.workspace import Workspace
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress, SilentProgress
from lightsim.render.casters.embree import offset_origins
from lightsim.render.scene import FrameScene, StaticScene, make_static_scene, place
from lightsim.render.transport.faces import (
    TILE_RAYS,
    TransportConfig,
    hashed_shifts,
    hemisphere_directions,
)
from lightsim.render.transport.sky import prepare_sky
from lightsim.render.transport.sun import sun_in_scene, unshadowed_sun
from lightsim.scenario.replay import replay

# Rays to the sky for each point: noise of some percent, which interpolation over faces hides.
# Chosen; sensitivity not measured.
_RAYS = TransportConfig(sky_rays=16)
# Distance from a vertex to its sample point, as a fraction of the distance to the centres of its
# faces: the sample point of a vertex at the foot of a wall is outside the wall. Chosen.
_INSET = 0.25
# Distance of the points from the surface, metres: above the roughness of reconstructed surfaces.
_SURFACE_OFFSET_M = 0.02
# Albedo of the ground below actors without rays: asphalt and concrete have 0.1 to 0.3. Chosen.
_GROUND_ALBEDO = 0.2
# Number of actors whose files are cached, some 0.2 MB each.
_CACHED_ACTORS = 256


@dataclass(frozen=True, eq=False)
class Surface:
    """A shown mesh, and points that represent its vertices, several for a vertex at a crease.

    Args:
        position: metres.
        normal: unit vectors.
        base_colour: linear.
        file: the mesh in its own frame; takes the light of the points.
    """

    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    base_colour: Float32[np.ndarray, "n 3"]
    file: LitFile

    @staticmethod
    def of(mesh: TriMesh) -> Surface:
        """Return one point for each vertex and main axis of its faces.

        Raises:
            InputError: the mesh has no face.
        """
        # Six directions: one number for each pair of vertex and direction.
        pairs = mesh.faces.astype(np.int64) * 6 + _main_axis(mesh)[:, None]
        group, corner = np.unique(pairs, return_inverse=True)
        corner = corner.reshape(-1, 3)
        number = group // 6
        place_m = mesh.vertices[number].astype(np.float64)
        colour = mesh.base_colour[number]
        split = TriMesh(mesh.frame, mesh.vertices[number], corner.astype(np.int32), colour)
        normal = split.vertex_normals().astype(np.float64)
        centres = place_m[corner].mean(axis=1)
        inward = _mean_of_faces(centres, corner, len(group)) - place_m
        # Along the surface: the centres of a curved surface's faces lie below it.
        inward -= np.einsum("nc,nc->n", inward, normal)[:, None] * normal
        position = place_m + _INSET * inward + _SURFACE_OFFSET_M * normal
        return Surface(position, normal, colour, LitFile(mesh, corner))

    def placed(self, world_from_actor: RigidTransform) -> Surface:
        """Return the points in frame `world`, with the same file."""
        position = world_from_actor.apply(self.position)
        return replace(self, position=position, normal=world_from_actor.rotate(self.normal))

    def lit_by_open_sky(self, dome: SkyDome, exposure_ev: float = 0.0) -> bytes:
        """Return the file lit like open level ground: independent of the actor's yaw."""
        level = 2.0**exposure_ev / np.pi * dome.horizontal_irradiance()
        up = 0.5 * (1.0 + self.normal[:, 2:])
        return self.file.glb((level * (up + (1.0 - up) * _GROUND_ALBEDO)).astype(np.float32))


@lru_cache(_CACHED_ACTORS)
def actor_surface(mesh: TriMesh) -> Surface:
    """Return the surface of an actor with at most `MAX_ASSET_TRIANGLES`, frame `actor`."""
    return Surface.of(decimated(mesh, MAX_ASSET_TRIANGLES))


@dataclass(frozen=True, eq=False)
class TracedLight:
    """Rays from all points of a scene at one time; some 100 bytes a point.

    Args:
        scene: the occluders.
        static: background and, if there are any, unobserved surfaces.
        present: surfaces of the actors at that time, frame `world`, by actor id.
        absent: surfaces of all other actors, frame `actor`.
        points, normals: of `static` and `present`, frame `world`.
        sky_cells: environment cell of each ray, `kernels.BLOCKED` if it meets a surface.
    """

    scene: FrameScene
    static: tuple[Surface, ...]
    present: Mapping[str, Surface]
    absent: Mapping[str, Surface]
    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    sky_cells: UInt16[np.ndarray, "n k"]

    def lit(self, dome: SkyDome, exposure_ev: float = 0.0) -> ViewMeshes:
        """Return the meshes lit by a dome at an exposure. Actors that are absent from the frame
        receive the light of unoccluded ground."""
        surfaces = (*self.static, *self.present.values())
        ends = np.cumsum([len(surface.position) for surface in surfaces])[:-1]
        light = np.split(np.float32(2.0**exposure_ev) * self.irradiance_over_pi(dome), ends)
        glbs = [surface.file.glb(part) for surface, part in zip(surfaces, light, strict=True)]
        actors = dict(zip(self.present, glbs[len(self.static) :], strict=True))
        for actor_id, surface in self.absent.items():
            actors[actor_id] = surface.lit_by_open_sky(dome, exposure_ev)
        return ViewMeshes(glbs[0], glbs[1] if len(self.static) > 1 else None, actors)

    def irradiance_over_pi(self, dome: SkyDome) -> Float32[np.ndarray, "n 3"]:
        """Return the light of the sun and of the open sky at the points, RGB.

        Occluded directions contribute the mean radiance that surfaces reflect.
        """
        from lightsim.render.transport.kernels import BLOCKED, face_light

        cells = prepare_sky(dome)
        direct = np.empty((len(self.points), 3), np.float32)
        face_light(self.sky_cells, cells.radiance, direct)
        if cells.sun is not None:
            seen = sun_in_scene(self.scene, self.points, self.normals, cells.sun, _RAYS)
            direct += unshadowed_sun(self.normals, cells.sun) * seen[:, None]
        surfaces = (*self.static, *self.present.values())
        base_colour = np.concatenate([surface.base_colour for surface in surfaces])
        reflected = (base_colour * direct).mean(axis=0)
        hidden = (self.sky_cells == BLOCKED).mean(axis=1, dtype=np.float32)
        return direct + hidden[:, None] * reflected


class LightTracer:
    """Traces the light on a twin and its actors; the twin is prepared at the first use."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace

    def recorded(self, frames: Sequence[CameraFrame], progress: Progress) -> ViewMeshes:
        """Return the meshes with the light of the recorded sky at the first of some frames.

        Raises:
            ArtefactError: the twin has not been built.
        """
        scenario = replay(self.workspace.twin, "view", frames, "recorded")
        traced = self.traced(scenario, frames[0].time_ns, progress)
        return traced.lit(self.workspace.sky.dome)

    def traced(
        self, scenario: Scenario, time_ns: int, progress: Progress | None = None
    ) -> TracedLight:
        """Return the rays of a scenario at a time; takes seconds."""
        static, surfaces = self._static
        scene = place(static, scenario, time_ns)
        here, elsewhere = dict[str, Surface](), dict[str, Surface]()
        for placement in scenario.placements:
            track, mesh = placement.track, placement.asset.mesh
            if not len(mesh.faces):
                continue
            if track.is_present(time_ns):
                pose = track.world_from_actor(time_ns)
                here[track.actor_id] = actor_surface(mesh).placed(pose)
            else:
                elsewhere[track.actor_id] = actor_surface(mesh)
        lit = (*surfaces, *here.values())
        points = np.concatenate([surface.position for surface in lit]).astype(np.float32)
        normals = np.concatenate([surface.normal for surface in lit]).astype(np.float32)
        cells = _sky_cells(scene, points, normals, progress or SilentProgress())
        return TracedLight(scene, surfaces, here, elsewhere, points, normals, cells)

    @cached_property
    def meshes(self) -> tuple[TriMesh, ...]:
        """Background and, if there are any, unobserved surfaces."""
        return tuple(mesh for mesh in static_meshes(self.workspace) if len(mesh.faces))

    @cached_property
    def _static(self) -> tuple[StaticScene, tuple[Surface, ...]]:
        return make_static_scene(self.meshes), tuple(map(Surface.of, self.meshes))


def _sky_cells(
    scene: FrameScene,
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    progress: Progress,
) -> UInt16[np.ndarray, "n k"]:
    """Return the environment cells of each point's rays, BLOCKED where they meet a surface."""
    from lightsim.render.transport.kernels import BLOCKED

    shifts = hashed_shifts(np.arange(len(points), dtype=np.int64), 0)
    cells = np.empty((len(points), _RAYS.sky_rays), np.uint16)
    caster, tile = scene.caster, TILE_RAYS // _RAYS.sky_rays
    for start in progress.track(range(0, len(points), tile), "light of the 3D view"):
        part = slice(start, start + tile)
        directions, found = hemisphere_directions(normals[part], shifts[part], _RAYS.sky_rays)
        origins = np.repeat(offset_origins(points[part], normals[part]), _RAYS.sky_rays, axis=0)
        is_blocked = caster.is_occluded(origins, directions.reshape(-1, 3))
        cells[part] = np.where(is_blocked.reshape(found.shape), BLOCKED, found)
    return cells


def _main_axis(mesh: TriMesh) -> Int64[np.ndarray, " m"]:
    """Return the index of the axis direction (six) that is nearest to the normal of each face.

    Faces of two directions have no common point, so that edges of 90 degrees remain sharp.
    """
    normals = mesh.face_normals()
    axis = np.abs(normals).argmax(axis=1)
    is_positive = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    return 2 * axis + is_positive


def _mean_of_faces(
    values: Float64[np.ndarray, "m 3"], corner: Int64[np.ndarray, "m 3"], count: int
) -> Float64[np.ndarray, "n 3"]:
    """Return the mean of a value over the faces around each point."""
    number = corner.reshape(-1)
    sums = [np.bincount(number, np.repeat(values[:, k], 3), count) for k in range(3)]
    return np.stack(sums, axis=1) / np.bincount(number, minlength=count)[:, None]
