"""How a twin's parts become a scene that can be rendered; used by stages and by relighting."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.equirect import sample_bilinear
from lightsim.core.found_visibility import with_found_visibility
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.solar import angle_between_deg
from lightsim.core.twin import SceneAssets
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.coverage import actor_coverage
from lightsim.render.gbuffers import render_gbuffers, with_ambient_occlusion
from lightsim.render.image import scene_image
from lightsim.render.scene import (
    FrameScene,
    grown,
    make_static_scene,
    place,
    placed_meshes,
    without_actors,
)
from lightsim.render.transport.faces import FaceTable
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    TransportMatrix,
    static_face_table,
    trace_transport,
)
from lightsim.render.transport.samples import render_samples, sample_offsets
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky
from lightsim.render.transport.sun import sun_visibility

SHADOW_ERROR_M = 0.25
"""Shadows that pictures show lie this close to where a reconstructed actor casts them."""


def parked_actor_meshes(log: DrivingLog, assets: SceneAssets) -> list[TriMesh]:
    """Meshes of the actors that never move, in frame `world`."""
    return [
        assets.actors[track.actor_id].mesh.transformed(
            track.trajectory.at(track.trajectory.start_ns)
        )
        for track in log.actors
        if not track.is_moving and track.actor_id in assets.actors
    ]


class TransportFrame:
    """A frame whose rays are traced: light under any sky is a few sums away.

    Args:
        view: the frame and its camera.
        buffers: geometry, with ambient occlusion.
        scene: the scene at the frame's time.
        table: its rays.
        config: of the rays.
        recorded_sun: light of this sun takes its visibility as the twin found it; None: every
            sun's is rendered.
    """

    def __init__(
        self,
        view: tuple[CameraFrame, PinholeCamera],
        buffers: GBuffers,
        scene: FrameScene,
        table: TransportMatrix,
        config: TransportConfig,
        recorded_sun: Sun | None = None,
    ) -> None:
        self.buffers = buffers
        self._view = view
        self._scene = scene
        self._table = table
        self._config = config
        self._recorded_sun = recorded_sun
        self._last: tuple[SkyDome | EnvironmentCells, ShadowBuffers] | None = None

    def light(self, sky: SkyDome | EnvironmentCells) -> ShadowBuffers:
        """Irradiance / pi of the pixels under a sky; that of the last sky object is kept."""
        if self._last is None or self._last[0] is not sky:
            self._last = None
            lit = light(self._table, self._scene, self.buffers, sky, self._config)
            if sky.sun is not None and _is_same_sun(sky.sun, self._recorded_sun):
                found = self.found_visibility(sky.sun)
                lit = with_found_visibility(lit, self.buffers, sky.sun, found)
            self._last = (sky, lit)
        return self._last[1]

    def found_visibility(self, sun: Sun | None) -> Float32[np.ndarray, "h w"] | None:
        """Visibility of the recorded sun as the twin found it in the pictures, behind the moving
        actors' shadows; NaN where it found none. None: nowhere.

        Args:
            sun: under which the log was recorded.
        """
        buffers = self.buffers
        if buffers.found_visibility is None or sun is None:
            return None
        # What never moves casts its shadow in the visibility already.
        moving = [mesh for mesh in self._scene.actors if mesh.sun_visibility is None]
        rows = np.flatnonzero(np.isfinite(buffers.found_visibility))
        points = buffers.ray_starts_world.reshape(-1, 3)[rows]
        normals = buffers.normal_world.reshape(-1, 3)[rows]
        found = buffers.found_visibility.copy()
        # Zero behind the surface's own horizon, too.
        found.reshape(-1)[rows] *= sun_visibility(
            make_embree_caster(moving), points, normals, sun, self._config
        )
        if self._scene.vacated:
            # Nobody saw these places without the parked actor's shadow: they are as rendered.
            caster = make_embree_caster(grown(self._scene.vacated, SHADOW_ERROR_M))
            past = sun_visibility(caster, points, normals, sun, self._config)
            found.reshape(-1)[rows[past < 1]] = np.nan
        return found

    def sun_past(
        self, placements: Sequence[ActorPlacement], sun: Sun, grown_m: float = 0.0
    ) -> Float32[np.ndarray, "h w"]:
        """Fraction of the sun's disc that the surfaces would see if only these actors stood before
        it; 1 where there is no surface, or where it turns away from the sun."""
        buffers = self.buffers
        past = np.ones(buffers.depth_z_m.shape, dtype=np.float32)
        meshes = placed_meshes(placements, self._view[0].time_ns)
        if not meshes:
            return past
        caster = make_embree_caster(grown(meshes, grown_m) if grown_m else meshes)
        direction = sun.direction_world.astype(np.float32)
        faces_sun = buffers.has_surface & (buffers.normal_world @ direction > 0)
        points, normals = (a[faces_sun] for a in (buffers.ray_starts_world, buffers.normal_world))
        past[faces_sun] = sun_visibility(caster, points, normals, sun, self._config)
        return past

    def coverage(self, numbers: Collection[int]) -> Float32[np.ndarray, "h w"]:
        """Fraction of each pixel that shows one of these actors, by their numbers."""
        return actor_coverage(self._scene, *self._view, self.buffers, numbers)

    def sampled_coverage(self, numbers: Collection[int]) -> Float32[np.ndarray, "h w"]:
        """The same by the samples of which `image` is the mean."""
        offsets = sample_offsets(self._config.pixel_samples)
        return actor_coverage(self._scene, *self._view, self.buffers, numbers, offsets)

    def image(self, sky: EnvironmentCells) -> Float32[np.ndarray, "h w 3"]:
        """Radiance: anti-aliased and with reflections where the renderer looks at samples of
        pixels; the sky behind."""
        return scene_image(self.buffers, self.light(sky), visible_sky(sky, *self._view))


def _is_same_sun(sun: Sun, recorded: Sun | None) -> bool:
    """Whether a sun stands where the recorded one stood, to a tenth of its disc."""
    if recorded is None:
        return False
    angle_deg = angle_between_deg(sun.direction_world, recorded.direction_world)
    return angle_deg < 0.1 * recorded.angular_radius_deg


def visible_sky(
    sky: EnvironmentCells, frame: CameraFrame, camera: PinholeCamera
) -> Float32[np.ndarray, "h w 3"]:
    """The sky as a camera sees it, with a sharp solar disc."""
    assert sky.behind is not None
    rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))[1]
    seen = sample_bilinear(sky.behind, rays).astype(np.float32)
    if sky.sun is not None:
        radius_rad = np.radians(sky.sun.angular_radius_deg)
        axis = sky.sun.direction_world / np.linalg.norm(sky.sun.direction_world)
        in_disc = rays @ axis > np.cos(radius_rad)
        solid_angle_sr = 2 * np.pi * (1 - np.cos(radius_rad))
        seen[in_disc] += (sky.sun.irradiance / solid_angle_sr).astype(np.float32)
    return seen.reshape(camera.height_px, camera.width_px, 3)


class FrameRenderer:
    """Buffers and light of single frames; what is static is prepared once."""

    def __init__(
        self,
        background: TriMesh,
        inferred: TriMesh,
        transport: TransportConfig,
        seed: int,
        *,
        inferred_is_visible: bool = False,
        make_caster: MakeCaster = make_embree_caster,
        is_sampled: bool = False,
        recorded_sun: Sun | None = None,
    ) -> None:
        """`is_sampled`: light is the mean over `transport.pixel_samples` points of each pixel,
        with reflections. `recorded_sun`: its shadows fall where the twin found them."""
        shadow_only = [inferred] if len(inferred.faces) else []
        self._static = make_static_scene(
            [background],
            shadow_only,
            inferred_is_visible=inferred_is_visible,
            make_caster=make_caster,
        )
        self._make_caster = make_caster
        self._is_sampled = is_sampled
        self._transport = transport
        self._seed = seed
        self._recorded_sun = recorded_sun
        self._faces: FaceTable = static_face_table(without_actors(self._static), transport, seed)

    def sampled(
        self,
        pixel_samples: int,
        recorded_sun: Sun | None,
        *,
        sun_rays: int | None = None,
        glossy_rays: int | None = None,
    ) -> FrameRenderer:
        """A renderer of anti-aliased images of the same twin, which shares all that is static."""
        other = copy(self)
        other._is_sampled = True
        other._transport = replace(
            self._transport,
            pixel_samples=pixel_samples,
            sun_rays=sun_rays or self._transport.sun_rays,
            glossy_rays=glossy_rays or self._transport.glossy_rays,
        )
        other._recorded_sun = recorded_sun
        return other

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> EnvironmentCells:
        """A sky made ready once for many frames; see `prepare_sky`."""
        return prepare_sky(sky, behind)

    def scene(self, scenario: Scenario, time_ns: int) -> FrameScene:
        """The static meshes and the scenario's actors where they are at `time_ns`."""
        return place(self._static, scenario, time_ns, self._make_caster)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Geometry buffers alone (ambient occlusion 1)."""
        scene = self.scene(scenario, frame.time_ns)
        return render_gbuffers(scene, camera, frame)

    def trace(
        self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera
    ) -> TransportFrame:
        """Geometry and the light transport matrix of a frame: all that does not depend on the
        sky."""
        scene = self.scene(scenario, frame.time_ns)
        buffers = render_gbuffers(scene, camera, frame)
        config = self._transport
        samples = (
            render_samples(scene, camera, frame, buffers, config) if self._is_sampled else None
        )
        table = trace_transport(scene, buffers, config, self._seed, self._faces, samples)
        buffers = with_ambient_occlusion(buffers, table.ambient_occlusion)
        view = (frame, camera)
        return TransportFrame(view, buffers, scene, table, config, self._recorded_sun)
