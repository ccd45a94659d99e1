"""Renderer of frames by the light transport matrix; used by build stages and by relighting."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.found_visibility import with_found_visibility
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.solar import angle_between_deg
from lightsim.core.window import Window
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.coverage import actor_coverage
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.image import scene_image, visible_sky
from lightsim.render.roofs import UncertainRoofs
from lightsim.render.scene import (
    FrameScene,
    make_static_scene,
    place,
    placed_meshes,
    with_dilated_copies,
    without_actors,
)
from lightsim.render.transport.faces import FaceTable
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    TransportMatrix,
    actor_face_table,
    static_face_table,
    trace_transport,
)
from lightsim.render.transport.samples import render_samples, sample_offsets
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky
from lightsim.render.transport.sun import sun_in_scene, sun_visibility
from lightsim.render.window import WindowFrame, window_view

# Maximum position error of cast shadows, in metres: distance of an actor's observed shadow from
# the shadow of its reconstructed mesh. Chosen; sensitivity not measured.
SHADOW_ERROR_M = 0.25


@dataclass(frozen=True, eq=False)
class Tracing:
    """Settings of the rays of frames.

    Args:
        config: numbers of rays and of bounces.
        seed: of the ray directions.
        faces: table of static faces, which grows with every traced frame.
        is_sampled: light is the mean over `config.pixel_samples` points of each pixel, with
            reflections.
        recorded_sun: for this sun the visibility that the twin estimated from images is used. None:
            visibility is rendered for every sun.
    """

    config: TransportConfig
    seed: int
    faces: FaceTable
    is_sampled: bool = False
    recorded_sun: Sun | None = None


class TransportFrame:
    """One frame whose rays are traced once, at the first request for light; each sky then requires
    only sums.

    Args:
        view: the frame and its camera.
        geometry: its buffers, with ambient occlusion 1.
        scene: the scene at the frame's time.
        tracing: settings of the rays.
        is_wanted: pixels to light; `geometry` has no surface elsewhere. None: all pixels.
        actor_faces: face table of the scene's actors, if another frame of the scene has traced one.
    """

    def __init__(
        self,
        view: tuple[CameraFrame, PinholeCamera],
        geometry: GBuffers,
        scene: FrameScene,
        tracing: Tracing,
        is_wanted: Bool[np.ndarray, "h w"] | None = None,
        actor_faces: FaceTable | None = None,
    ) -> None:
        self.geometry = geometry
        self.view = view
        self._scene = scene
        self._tracing = tracing
        self._config = tracing.config
        self._is_wanted = is_wanted
        self._actor_faces = actor_faces or actor_face_table(scene, tracing.config)
        self._matrix: TransportMatrix | None = None
        self._last: tuple[SkyDome | EnvironmentCells, ShadowBuffers] | None = None

    @property
    def _table(self) -> TransportMatrix:
        # A cached property of Python 3.11 would trace one frame at a time: its lock is common to
        # all frames.
        if self._matrix is None:
            self._matrix = self._traced()
        return self._matrix

    def _traced(self) -> TransportMatrix:
        frame, camera = self.view
        samples = None
        if self._tracing.is_sampled:
            samples = render_samples(
                self._scene, camera, frame, self.geometry, self._config, self._is_wanted
            )
        # The ray pattern depends on the position in the whole image, so that a window has the same
        # light as those pixels of the whole image.
        corner_px = frame.corner_px if isinstance(frame, WindowFrame) else (0, 0)
        tracing = self._tracing
        return trace_transport(
            self._scene,
            self.geometry,
            tracing.config,
            tracing.seed,
            tracing.faces,
            samples,
            corner_px,
            self._actor_faces,
        )

    @property
    def buffers(self) -> GBuffers:
        """Geometry buffers with ambient occlusion."""
        return replace(self.geometry, ambient_occlusion=self._table.ambient_occlusion)

    def part(self, window: Window, is_wanted: Bool[np.ndarray, "h w"]) -> TransportFrame:
        """Return some pixels of an image window as a separate frame with separate rays.

        Args:
            is_wanted: pixels to light, within the window.
        """
        geometry = self.geometry.part(window).within(is_wanted)
        view = window_view(*self.view, window)
        return self._with(view, geometry, self._tracing, is_wanted)

    def traced_as(self, tracing: Tracing) -> TransportFrame:
        """Return the same pixels with other ray settings and the same face table of actors."""
        return self._with(self.view, self.geometry, tracing, self._is_wanted)

    def diffuse_once(self, sun_rays: int | None = None) -> TransportFrame:
        """Return the same pixels with one bounce and no reflections: fewer rays, for a preview.

        Args:
            sun_rays: rays to the sun for each pixel; None: as the frame.
        """
        config = replace(self._config, bounces=1, glossy_rays=0)
        if sun_rays is not None:
            config = replace(config, sun_rays=sun_rays)
        return self.traced_as(replace(self._tracing, config=config))

    def _with(
        self,
        view: tuple[CameraFrame, PinholeCamera],
        geometry: GBuffers,
        tracing: Tracing,
        is_wanted: Bool[np.ndarray, "h w"] | None,
    ) -> TransportFrame:
        """Return another view of the scene."""
        faces = self._actor_faces
        return TransportFrame(view, geometry, self._scene, tracing, is_wanted, faces)

    def light(self, sky: SkyDome | EnvironmentCells) -> ShadowBuffers:
        """Return irradiance / pi of the pixels under a sky; the last sky's result is cached."""
        if self._last is None or self._last[0] is not sky:
            # Released before the next sky is computed, so that two results are never in memory.
            self._last = None
            lit = light(self._table, self._scene, self.geometry, sky, self._config)
            if sky.sun is not None and _is_same_sun(sky.sun, self._tracing.recorded_sun):
                # Shadows of the recording are more accurate in its images than in the geometry.
                found = self.found_visibility(sky.sun)
                lit = with_found_visibility(lit, self.geometry, sky.sun, found)
            self._last = (sky, lit)
        return self._last[1]

    def found_visibility(self, sun: Sun | None) -> Float32[np.ndarray, "h w"] | None:
        """Return the recorded sun's estimated visibility, times the shadows of moving actors.

        Args:
            sun: the sun of the recording.

        Returns:
            Visibility in [0, 1], NaN for pixels without an estimate; None if no pixel has one.
        """
        buffers = self.geometry
        if buffers.found_visibility is None or sun is None:
            return None
        # The estimated visibility already includes the shadows of parked actors.
        moving = [mesh for mesh in self._scene.actors if mesh.sun_visibility is None]
        is_known = np.isfinite(buffers.found_visibility)
        # The estimate has no moving actors: their shadows are multiplied. The factor is also 0 on
        # surfaces that face away from the sun.
        found = buffers.found_visibility * self._visibility_with_only(moving, is_known, sun)
        if self._scene.vacated:
            # Behind a removed parked actor no image shows the surface without its shadow, so the
            # rendered visibility is used (NaN).
            vacated = with_dilated_copies(self._scene.vacated, SHADOW_ERROR_M)
            found[self._visibility_with_only(vacated, is_known, sun) < 1] = np.nan
        return found

    def sun_visibility_with_only(
        self, placements: Sequence[ActorPlacement], sun: Sun, grown_m: float = 0.0
    ) -> Float32[np.ndarray, "h w"]:
        """Return the sun visibility of the surfaces if only the given actors occluded the sun.

        Args:
            placements: actors that cast shadows.
            grown_m: metres by which the actors' surfaces are moved outwards, to bound their
                shadows.

        Returns:
            Fraction of the solar disc in [0, 1]; 1 without a surface and on surfaces that face away
            from the sun.
        """
        meshes = placed_meshes(placements, self.view[0].time_ns)
        direction = sun.direction_world.astype(np.float32)
        faces_sun = self.geometry.has_surface & (self.geometry.normal_world @ direction > 0)
        return self._visibility_with_only(
            with_dilated_copies(meshes, grown_m) if grown_m else meshes, faces_sun, sun
        )

    def _visibility_with_only(
        self, meshes: Sequence[TriMesh], is_requested: Bool[np.ndarray, "h w"], sun: Sun
    ) -> Float32[np.ndarray, "h w"]:
        """Return the sun visibility at the requested pixels if only these meshes occluded the sun;
        1 at all others."""
        past = np.ones(is_requested.shape, dtype=np.float32)
        buffers = self.geometry
        points, normals = (
            a[is_requested] for a in (buffers.ray_starts_world, buffers.normal_world)
        )
        # Embree, since uploading a few meshes to a GPU for one call would not pay off.
        caster = make_embree_caster(meshes)
        past[is_requested] = sun_visibility(caster, points, normals, sun, self._config)
        return past

    def sun_on_lens(self, sun: Sun) -> float:
        """Return the fraction of the solar disc visible from the camera, wherever it looks."""
        place = np.asarray(self.view[0].world_from_camera.translation_m, np.float32)[None]
        towards = (sun.direction_world / np.linalg.norm(sun.direction_world)).astype(np.float32)
        return float(sun_in_scene(self._scene, place, towards[None], sun, self._config)[0])

    def coverage(self, numbers: Collection[int]) -> Float32[np.ndarray, "h w"]:
        """Return the fraction of each pixel that shows one of these actors.

        Args:
            numbers: the actors' numbers in the scenario.
        """
        return actor_coverage(self._scene, *self.view, self.geometry, numbers)

    def sampled_coverage(self, numbers: Collection[int]) -> Float32[np.ndarray, "h w"]:
        """Return `coverage` at the sub-pixel samples of which `image` is the mean."""
        offsets = sample_offsets(self._config.pixel_samples)
        return actor_coverage(self._scene, *self.view, self.geometry, numbers, offsets)

    def image(self, sky: EnvironmentCells) -> Float32[np.ndarray, "h w 3"]:
        """Return radiance with the sky behind surfaces.

        It is anti-aliased and has reflections if the renderer samples pixels.
        """
        return scene_image(self.geometry, self.light(sky), visible_sky(sky, *self.view))


def _is_same_sun(sun: Sun, recorded: Sun | None) -> bool:
    """Return true if two suns differ in direction by less than a tenth of the disc's radius."""
    if recorded is None:
        return False
    angle_deg = angle_between_deg(sun.direction_world, recorded.direction_world)
    return angle_deg < 0.1 * recorded.angular_radius_deg


class FrameRenderer:
    """Renderer of buffers and light of single frames; the static part is prepared once."""

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
        """Build the static scene.

        Args:
            inferred_is_visible: cameras show `inferred` too.
            is_sampled, recorded_sun: see `Tracing`.
        """
        self._static = make_static_scene(
            [background],
            [inferred] if len(inferred.faces) else [],
            inferred_is_visible=inferred_is_visible,
            make_caster=make_caster,
        )
        self._make_caster = make_caster
        faces = static_face_table(without_actors(self._static), transport, seed)
        self._tracing = Tracing(transport, seed, faces, is_sampled, recorded_sun)

    def with_roofs(self, roofs: UncertainRoofs | None) -> FrameRenderer:
        """Return the renderer with uncertain roofs, for suns whose shadows no image shows."""
        other = copy(self)
        other._static = replace(self._static, roofs=roofs)
        return other

    def with_tracing(
        self, transport: TransportConfig, seed: int, *, inferred_is_visible: bool = False
    ) -> FrameRenderer:
        """Return a renderer of the same twin with other tracing settings. It uses the same meshes
        and ray casters of the static scene."""
        other = copy(self)
        other._static = replace(self._static, roofs=None, inferred_is_visible=inferred_is_visible)
        faces = static_face_table(without_actors(other._static), transport, seed)
        other._tracing = Tracing(transport, seed, faces)
        return other

    def sampled(
        self,
        pixel_samples: int,
        recorded_sun: Sun | None,
        *,
        sun_rays: int | None = None,
        glossy_rays: int | None = None,
    ) -> FrameRenderer:
        """Return a renderer of anti-aliased images with the same static scene and faces."""
        other = copy(self)
        # The numbers of face rays do not change, so the face table is reused.
        transport = replace(
            self._tracing.config,
            pixel_samples=pixel_samples,
            sun_rays=sun_rays or self._tracing.config.sun_rays,
            glossy_rays=glossy_rays or self._tracing.config.glossy_rays,
        )
        other._tracing = replace(
            self._tracing, config=transport, is_sampled=True, recorded_sun=recorded_sun
        )
        return other

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> EnvironmentCells:
        """Prepare a sky once for many frames; see `prepare_sky`."""
        return prepare_sky(sky, behind)

    def scene(self, scenario: Scenario, time_ns: int) -> FrameScene:
        """Return the static meshes and the scenario's actors at their poses at `time_ns`."""
        return place(self._static, scenario, time_ns, self._make_caster)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Return the geometry buffers (ambient occlusion 1)."""
        scene = self.scene(scenario, frame.time_ns)
        return render_gbuffers(scene, camera, frame)

    def trace(
        self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera
    ) -> TransportFrame:
        """Return the frame with its geometry; its light transport matrix is traced on first use."""
        scene = self.scene(scenario, frame.time_ns)
        geometry = render_gbuffers(scene, camera, frame)
        return TransportFrame((frame, camera), geometry, scene, self._tracing)

    def trace_changed_pixels(
        self, known: TransportFrame, scenario: Scenario, changed: Sequence[ActorPlacement]
    ) -> TransportFrame:
        """Return a traced frame's view in another scenario; rays are cast only for changed pixels.

        Args:
            known: a frame of the first scenario.
            scenario: the second scenario.
            changed: actors whose pose differs between the two scenarios, with both poses.
        """
        frame, camera = known.view
        scene = self.scene(scenario, frame.time_ns)
        rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
        caster = self._make_caster(placed_meshes(changed, frame.time_ns))
        # Both poses of a changed actor are in `changed`: pixels that it leaves and pixels that it
        # covers.
        differs = np.flatnonzero(caster.is_occluded(*rays))
        geometry = render_gbuffers(scene, camera, frame, (known.geometry, differs))
        return TransportFrame(known.view, geometry, scene, self._tracing)

    def retrace(self, frame: TransportFrame) -> TransportFrame:
        """Return another renderer's frame of the same twin with this renderer's ray settings."""
        return frame.traced_as(self._tracing)
