"""What `lightsim render` asks of a renderer, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.render.backends import Backend, choose_caster
from lightsim.render.transport import TransportConfig
from lightsim.scene_setup import FrameRenderer

RendererName = Literal["transport", "path", "cycles"]


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


@runtime_checkable
class Renderer(Protocol):
    """Renders frames of one twin."""

    def prepare(self, sky: SkyDome) -> Any:
        """A sky made ready once for many frames."""
        ...

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Geometry alone, ambient occlusion 1."""
        ...

    def trace(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> TracedFrame:
        """All of a frame that does not depend on the sky."""
        ...


@dataclass(frozen=True)
class RendererChoice:
    """How light is computed.

    Args:
        name: "transport" is the ray table.
        backend: what casts the rays of the ray table.
        rays: per traced pixel over the hemisphere; None for the renderer's own number.
    """

    name: RendererName = "transport"
    backend: Backend = "auto"
    rays: int | None = None

    def __post_init__(self) -> None:
        if self.rays is not None and self.rays < 1:
            raise InputError("there must be rays", where="--rays", got=self.rays)

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the pictures but for noise; the backend does not."""
        return {"renderer": self.name, "rays": self.rays}


def make_renderer(
    choice: RendererChoice, background: TriMesh, inferred: TriMesh, seed: int
) -> Renderer:
    """The renderer that the user chose.

    Raises:
        InputError: it is not available here.
    """
    if choice.name != "transport":
        raise InputError(
            "this renderer is not available",
            where=f"--renderer {choice.name}",
            expected="transport",
        )
    config = TransportConfig()
    if choice.rays is not None:
        config = replace(config, sky_rays=choice.rays)
    make_caster = choose_caster(choice.backend)
    return FrameRenderer(background, inferred, config, seed, make_caster=make_caster)
