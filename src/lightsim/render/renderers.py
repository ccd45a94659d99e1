"""What `lightsim render` and relighting ask of a renderer, and the choice among them."""

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

_PATHS = 64
_PATH_BOUNCES = 4


@runtime_checkable
class TracedFrame(Protocol):
    """One frame, ready for any number of skies."""

    @property
    def buffers(self) -> GBuffers:
        """Geometry, with ambient occlusion."""
        ...

    def light(self, sky: Any) -> ShadowBuffers:
        """Light under a sky that `Renderer.prepare` made ready."""
        ...

    def image(self, sky: Any) -> Float32[np.ndarray, "h w 3"]:
        """Radiance that the camera sees under it, the sky behind."""
        ...


@runtime_checkable
class Renderer(Protocol):
    """Renders frames of one twin."""

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> Any:
        """A sky made ready once for many frames.

        Args:
            behind: what the camera sees of it; the reference renderers show the dome itself.
        """
        ...

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Geometry alone, ambient occlusion 1."""
        ...

    def trace(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> TracedFrame:
        """All of a frame that does not depend on the sky."""
        ...


def renderer_settings(choice: RendererChoice) -> dict[str, Any]:
    """What decides the pictures but for noise; the backend does not."""
    more: dict[str, Any] = {"bounces": choice.bounces, "is_denoised": choice.denoise}
    if choice.renderer == "transport":
        pixels = TransportConfig(pixel_samples=choice.pixel_samples)
        more["transport"] = asdict(transport_as_chosen(choice, pixels))
    return {"renderer": choice.renderer, "rays": choice.rays, **more}


def transport_as_chosen(choice: LightChoice, config: TransportConfig) -> TransportConfig:
    """The light transport matrix with the rays and bounces that the user chose."""
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
    """The renderer that the user chose.

    Args:
        has_images: whether images are asked for, which takes rays for reflections.
        recorded_sun: where light transport renders this sun, its shadows fall as the twin found
            them in the pictures; the reference renderers trace them.
        roofs: how else what is inferred may be; the reference renderers take it as it is.

    Raises:
        InputError: its backend is not available here.
        MissingDependencyError: its package is not installed.
    """
    if choice.denoise and has_images:
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
        config = replace(config, glossy_rays=0)
    backend = resolve_backend(choice.backend)
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
    """That the chosen renderer can be used here; starts nothing.

    Raises:
        MissingDependencyError: its package is not installed.
    """
    if choice.renderer == "cycles":
        from lightsim.render.reference.cycles import find_bpy

        find_bpy(choice.blender_python)


def make_reference(
    choice: LightChoice,
    background: TriMesh,
    inferred: TriMesh,
    seed: int,
    *,
    inferred_is_visible: bool = False,
) -> Renderer:
    """A renderer that traces light anew for every sky.

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
    bounces = choice.bounces or _PATH_BOUNCES
    return ReferenceRenderer(
        background,
        inferred,
        tracer,
        choice.rays or _PATHS,
        bounces=bounces,
        seed=seed,
        inferred_is_visible=inferred_is_visible,
    )


@dataclass(frozen=True, eq=False)
class _Denoised:
    """A renderer whose images pass Open Image Denoise; buffers and light stay as they are."""

    renderer: Renderer

    def prepare(self, sky: SkyDome, behind: SkyDome | None = None) -> Any:
        """As the renderer's."""
        return self.renderer.prepare(sky, behind)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """As the renderer's."""
        return self.renderer.geometry(scenario, frame, camera)

    def trace(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> TracedFrame:
        """As the renderer's, with images denoised."""
        return _DenoisedFrame(self.renderer.trace(scenario, frame, camera))


@dataclass(frozen=True, eq=False)
class _DenoisedFrame:
    traced: TracedFrame

    @property
    def buffers(self) -> GBuffers:
        """As traced."""
        return self.traced.buffers

    def light(self, sky: Any) -> ShadowBuffers:
        """As traced."""
        return self.traced.light(sky)

    def image(self, sky: Any) -> Float32[np.ndarray, "h w 3"]:
        """Traced radiance, denoised with base colour and normals as guides."""
        from lightsim.render.denoise import denoise

        buffers = self.buffers
        return denoise(self.traced.image(sky), buffers.base_colour, buffers.normal_world)
