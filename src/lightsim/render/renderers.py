"""Interface between renderers and `lightsim render` or relighting, and the choice of a renderer."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.render.casters.choice import choose_caster, resolve_backend
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.options import LightChoice, RendererChoice
from lightsim.render.roofs import UncertainRoofs
from lightsim.render.transport.matrix import TransportConfig
from lightsim.render.transport.matrix_torch import has_torch_cuda


@runtime_checkable
class TracedFrame(Protocol):
    """One frame, ready for any number of skies."""

    @property
    def buffers(self) -> GBuffers:
        """Geometry buffers with ambient occlusion."""
        ...

    def light(self, sky: Any) -> ShadowBuffers:
        """Return the light under a sky prepared by `Renderer.prepare`."""
        ...

    def image(self, sky: Any) -> Float32[np.ndarray, "h w 3"]:
        """Return the radiance in the camera under such a sky, with the sky behind surfaces."""
        ...


@runtime_checkable
class Renderer(Protocol):
    """Renderer of frames of one twin."""

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> Any:
        """Prepare a sky once for many frames.

        Args:
            behind: the dome that cameras show behind surfaces, if another one; the reference
                renderers always show `sky`.
        """
        ...

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Return the geometry buffers, with ambient occlusion 1."""
        ...

    def trace(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> TracedFrame:
        """Return the part of a frame that does not depend on the sky."""
        ...


def renderer_settings(choice: RendererChoice) -> dict[str, Any]:
    """Return the settings that determine the images, apart from noise, without the backend."""
    # The backend is left out, because the casters agree to rounding.
    more: dict[str, Any] = {"bounces": choice.bounces, "is_denoised": choice.denoise}
    if choice.renderer == "transport":
        pixels = TransportConfig(pixel_samples=choice.pixel_samples)
        more["transport"] = asdict(transport_as_chosen(choice, pixels))
    return {"renderer": choice.renderer, "rays": choice.rays, **more}


def transport_as_chosen(choice: LightChoice, config: TransportConfig) -> TransportConfig:
    """Return the light transport config with the user's numbers of rays and bounces."""
    if choice.bounces is not None:
        config = replace(config, bounces=choice.bounces)
    return config if choice.rays is None else replace(config, sky_rays=choice.rays)


def make_renderer(
    choice: RendererChoice,
    background: TriMesh,
    inferred: TriMesh,
    seed: int,
    *,
    has_images: bool,
    recorded_sun: Sun | None = None,
    roofs: UncertainRoofs | None = None,
) -> Renderer:
    """Return the renderer that the user chose.

    Args:
        has_images: images are rendered too, which requires rays for reflections.
        recorded_sun: for this sun light transport uses the visibility estimated from images; the
            reference renderers trace its shadows.
        roofs: uncertain shapes of `inferred`; the reference renderers use `inferred` as it is.

    Raises:
        InputError: its backend is not available here.
        MissingDependencyError: its package is not installed.
    """
    if choice.denoise and has_images:
        # Imported only if chosen: the package is an optional extra.
        from lightsim.render import denoise

        denoise.check_installed()
        noisy = replace(choice, denoise=False)
        renderer = make_renderer(
            noisy, background, inferred, seed, has_images=True, recorded_sun=recorded_sun,
            roofs=roofs,
        )  # fmt: skip
        return _Denoised(renderer)
    if choice.renderer != "transport":
        return make_reference(choice, background, inferred, seed)
    config = transport_as_chosen(choice, TransportConfig(pixel_samples=choice.pixel_samples))
    if not has_images:
        # Light buffers have no reflections, so their rays would be wasted.
        config = replace(config, glossy_rays=0)
    backend = resolve_backend(choice.backend)
    # The sums run on the device of the rays only if torch can use it as well.
    if backend == "mitsuba-cuda" and has_torch_cuda():
        config = replace(config, device="cuda")
    make_caster = choose_caster(backend)
    return FrameRenderer(
        background,
        inferred,
        config,
        seed,
        make_caster=make_caster,
        is_sampled=True,
        recorded_sun=recorded_sun,
    ).with_roofs(roofs)


def check_installed(choice: LightChoice) -> None:
    """Check that the chosen renderer can be used here, without starting it.

    Raises:
        MissingDependencyError: its package is not installed.
    """
    if choice.renderer == "cycles":
        from lightsim.render.reference.blender import find_bpy

        find_bpy(choice.blender_python)


def make_reference(
    choice: LightChoice,
    background: TriMesh,
    inferred: TriMesh,
    seed: int,
    *,
    inferred_is_visible: bool = False,
) -> Renderer:
    """Return a renderer that traces light anew for every sky.

    Raises:
        MissingDependencyError: its package is not installed.
    """
    from lightsim.render.reference.renderer import ReferenceRenderer

    if choice.renderer == "path":
        from lightsim.render.reference.path_tracer import PathTracer

        tracer = PathTracer()
    else:
        from lightsim.render.reference.cycles import Cycles

        tracer = Cycles(choice.blender_python)
    # Defaults of 64 paths a pixel and 4 bounces: chosen as a compromise between noise and time;
    # sensitivity not measured.
    return ReferenceRenderer(
        background,
        inferred,
        tracer,
        choice.rays or 64,
        bounces=choice.bounces or 4,
        seed=seed,
        inferred_is_visible=inferred_is_visible,
    )


@dataclass(frozen=True, eq=False)
class _Denoised:
    """Renderer whose images are denoised with Open Image Denoise; buffers and light are not."""

    renderer: Renderer

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> Any:
        """Return the renderer's prepared sky."""
        return self.renderer.prepare(sky, behind)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Return the renderer's geometry buffers."""
        return self.renderer.geometry(scenario, frame, camera)

    def trace(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> TracedFrame:
        """Return the renderer's frame, with denoised images."""
        return _DenoisedFrame(self.renderer.trace(scenario, frame, camera))


@dataclass(frozen=True, eq=False)
class _DenoisedFrame:
    traced: TracedFrame

    @property
    def buffers(self) -> GBuffers:
        """Geometry buffers of the traced frame."""
        return self.traced.buffers

    def light(self, sky: Any) -> ShadowBuffers:
        """Return the light of the traced frame."""
        return self.traced.light(sky)

    def image(self, sky: Any) -> Float32[np.ndarray, "h w 3"]:
        """Return denoised radiance, with base colour and normals as guides."""
        from lightsim.render.denoise import denoise

        buffers = self.buffers
        # Guides without noise keep texture and edges sharp.
        return denoise(self.traced.image(sky), buffers.base_colour, buffers.normal_world)
