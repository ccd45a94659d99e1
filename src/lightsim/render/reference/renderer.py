"""Common part of the reference renderers (Mitsuba, Cycles): shots, and frames made from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions, sample_bilinear, solid_angles_sr
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_sphere
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.render.transport.matrix import TransportConfig, trace_transport
from lightsim.render.transport.sun import unshadowed_sun

Surfaces = Literal["principled", "diffuse", "white"]
Picture = Float32[np.ndarray, "_ _ 3"]
"""Linear radiance of the pixels of a camera."""
# Step of the random seed from shot to shot: a prime, so that shots of close seeds differ.
SEED_STEP = 7919


@dataclass(frozen=True, eq=False)
class Shot:
    """One image for a reference renderer.

    Args:
        dome: the sky. Its sun (`core.dome.split_sun`) is rendered as a separate disc.
        samples: paths per pixel.
        bounces: reflections from surface to surface before the light; 0 is direct light only.
        surfaces: "principled": with roughness and metallic; "diffuse": Lambert everywhere; "white":
            diffuse, and surfaces are white for camera rays, so that the image is irradiance / pi.
        has_sky: the dome without its sun gives light.
        has_sun: its sun gives light.
        is_antialiased: average over the pixel; otherwise all paths start at its centre.
    """

    dome: SkyDome
    samples: int
    bounces: int = 1
    surfaces: Surfaces = "principled"
    has_sky: bool = True
    has_sun: bool = True
    is_antialiased: bool = True


@runtime_checkable
class ReferenceTracer(Protocol):
    """Renderer of shots of a scene: linear radiance, with the sky behind surfaces."""

    def render_shots(
        self,
        scene: FrameScene,
        camera: PinholeCamera,
        view: CameraFrame | RigidTransform,
        shots: Sequence[Shot],
        seed: int,
    ) -> list[Picture]:
        """Return one image per shot, in the same order.

        Args:
            view: a recorded frame, or the pose world_from_camera of a static camera.
        """
        ...


class ReferenceRenderer:
    """Renderer like `frame_renderer.FrameRenderer` that traces light anew for every sky.

    Args:
        background: static mesh.
        inferred: mesh that blocks and reflects light; visible to cameras if `inferred_is_visible`.
        tracer: `render.reference.path_tracer.PathTracer` or `render.reference.cycles.Cycles`.
        samples: paths per pixel.
        bounces: as in `Shot`.
        seed: of the sampling.
    """

    def __init__(
        self,
        background: TriMesh,
        inferred: TriMesh,
        tracer: ReferenceTracer,
        samples: int = 64,
        bounces: int = 4,
        seed: int = 0,
        *,
        inferred_is_visible: bool = False,
    ) -> None:
        self._static = make_static_scene(
            [background],
            [inferred] if len(inferred.faces) else [],
            inferred_is_visible=inferred_is_visible,
        )
        self._tracer = tracer
        self._samples = samples
        self._bounces = bounces
        self._seed = seed

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> SkyDome:
        """Return the sky itself; cameras show it behind surfaces too, instead of `behind`."""
        return sky

    def scene(self, scenario: Scenario, time_ns: int) -> FrameScene:
        """Return the static meshes and the scenario's actors at their poses at `time_ns`."""
        return place(self._static, scenario, time_ns)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Return the geometry buffers (ambient occlusion 1)."""
        return render_gbuffers(self.scene(scenario, frame.time_ns), camera, frame)

    def trace(
        self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera
    ) -> ReferenceFrame:
        """Return the geometry of a frame, ready for any number of skies."""
        scene = self.scene(scenario, frame.time_ns)
        buffers = render_gbuffers(scene, camera, frame)
        # Ambient occlusion needs few rays and no bounce.
        occlusion = TransportConfig(sky_rays=16, face_rays=0)
        table = trace_transport(scene, buffers, occlusion, self._seed)
        buffers = replace(buffers, ambient_occlusion=table.ambient_occlusion)
        return ReferenceFrame(self, scene, frame, camera, buffers)

    def render_shots(self, traced: ReferenceFrame, shots: Sequence[Shot]) -> list[Picture]:
        """Return images of a frame."""
        return self._tracer.render_shots(
            traced.scene, traced.camera, traced.frame, shots, self._seed
        )

    def shot_of_image(self, sky: SkyDome) -> Shot:
        """Return the shot of radiance: Principled surfaces, anti-aliased."""
        return Shot(sky, self._samples, self._bounces)

    def shots_of_light(self, sky: SkyDome) -> list[Shot]:
        """Return the shots of direct sun, direct sky and all light, each on white surfaces."""
        whole = Shot(sky, self._samples, self._bounces, "white", is_antialiased=False)
        # The direct sun has less noise than the sky, so a quarter of the paths is used.
        sun = replace(whole, bounces=0, has_sky=False, samples=max(4, self._samples // 4))
        return [sun, replace(whole, bounces=0, has_sun=False), whole]


@dataclass(frozen=True, eq=False)
class ReferenceFrame:
    """One frame of a `ReferenceRenderer`, ready for any number of skies.

    Args:
        renderer: its renderer.
        scene: at the frame's time.
        frame: to render.
        camera: of the frame.
        buffers: its geometry, with ambient occlusion.
    """

    renderer: ReferenceRenderer
    scene: FrameScene
    frame: CameraFrame
    camera: PinholeCamera
    buffers: GBuffers

    def light(self, sky: SkyDome) -> ShadowBuffers:
        """Return the light of one sky at pixel centres.

        The bounce is a difference of independent renderings: sampling noise can make it slightly
        negative, but its mean is unbiased.
        """
        pictures = self.renderer.render_shots(self, self.renderer.shots_of_light(sky))
        return _shadow_buffers(self.buffers, sky, pictures)

    def image(self, sky: SkyDome) -> Picture:
        """Return radiance under one sky: Principled surfaces, anti-aliased, the sky behind them."""
        return self.renderer.render_shots(self, [self.renderer.shot_of_image(sky)])[0]


def _shadow_buffers(buffers: GBuffers, sky: SkyDome, images: Sequence[Picture]) -> ShadowBuffers:
    """Return the light of one sky from its three shots (`ReferenceRenderer.shots_of_light`)."""
    surface = buffers.has_surface[..., None]
    sun, open_sky, whole = (np.where(surface, image, np.float32(0)) for image in images)
    normals = buffers.normal_world[buffers.has_surface]
    rest, disc = split_sun(sky)
    sun_alone = np.zeros_like(sun)
    if disc is not None:
        sun_alone[buffers.has_surface] = unshadowed_sun(normals, disc)
    open_alone = np.zeros_like(sun)
    open_alone[buffers.has_surface] = open_irradiance_over_pi(rest, normals)
    # Visibility is the ratio of the rendered and the unoccluded sun, 0 on surfaces that face away.
    level = sun_alone.sum(axis=-1)
    fraction = sun.sum(axis=-1) / np.where(level > 0, level, 1)
    visibility = np.where(level > 0, np.clip(fraction, 0, 1), 0)
    return ShadowBuffers(
        visibility.astype(np.float32),
        sun,
        open_sky,
        whole - sun - open_sky,
        whole,
        sun_alone + open_alone,
    )


def open_irradiance_over_pi(
    radiance: Float32[np.ndarray, "a b 3"], normals_world: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Return irradiance / pi of an unoccluded dome on surfaces of any normal."""
    # Irradiance varies slowly with the normal: a table of 2.8 degrees is fine enough.
    rows = 64
    cells = resize_sphere(radiance, rows)
    # The same directions serve as normals and as directions of light: one small matrix product.
    towards = pixel_directions(rows).reshape(-1, 3)
    solid = np.broadcast_to(solid_angles_sr(rows), (rows, 2 * rows)).reshape(-1, 1)
    cosine = np.maximum(towards @ towards.T, 0.0)
    table = cosine @ (cells.reshape(-1, 3) * solid) / np.pi
    return sample_bilinear(table.reshape(cells.shape), normals_world).astype(np.float32)
