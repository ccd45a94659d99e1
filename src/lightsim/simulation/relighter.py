"""Relighting of single frames of a twin under target skies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import ShadowBuffers
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.glare import veiling_glare
from lightsim.relighting.physical.ratio import CameraAndSkies, RatioConfig, RelightInputs
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.image import visible_sky
from lightsim.render.renderers import Renderer, TracedFrame, make_reference
from lightsim.render.transport.matrix import TransportConfig
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight_methods import relight_of
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky
from lightsim.simulation.source_image import SourceImage, SourceImages
from lightsim.simulation.target_sky import TargetSky


@dataclass(frozen=True)
class RelightConfig:
    """Settings of relighting that are not options of every command.

    Args:
        transport: light transport of source and target sky on the twin.
        ratio: relighting of pixels by the ratio of the two lights.
        exposure_s: exposure time for the motion blur of new actors, in seconds.
    """

    transport: TransportConfig = field(default_factory=lambda: TransportConfig(bounces=4))
    ratio: RatioConfig = field(default_factory=RatioConfig)
    exposure_s: float = 0.001


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """One frame under one target sky, with the data that it was made from.

    Args:
        frame: of the scenario.
        image_srgb8: picture of the camera.
        radiance: linear, scene units, before gain and exposure.
        traced: the frame in the scenario; None if no ray was traced.
        inputs: of relighting; None under the source sky, whose pixels are not relit.
        source: the frame under the source sky.
        expected_error: expected absolute error of the picture's sRGB code, in [0, 1]; None if the
            method does not estimate it.
    """

    frame: CameraFrame
    image_srgb8: UInt8[np.ndarray, "h w 3"]
    radiance: Float32[np.ndarray, "h w 3"]
    traced: TransportFrame | None
    inputs: RelightInputs | None
    source: SourceImage
    expected_error: Float32[np.ndarray, "h w"] | None = None

    @property
    def lights(self) -> tuple[ShadowBuffers, ShadowBuffers] | None:
        """Light of the source and of the target sky; None if pixels are not relit."""
        return None if self.inputs is None else (self.inputs.source, self.inputs.target)


@dataclass(frozen=True, eq=False)
class RelightTarget:
    """A target sky prepared for many frames.

    Args:
        sky: the resolved sky.
        cells: sky prepared for the light transport matrix.
        renderer_sky: sky prepared for the renderer that computes the target light.
        level_ratio: irradiance on open level ground, target over source, RGB.
    """

    sky: TargetSky
    cells: EnvironmentCells
    renderer_sky: Any
    level_ratio: Float32[np.ndarray, "3"]


@dataclass(eq=False)
class PreparedFrame:
    """One frame with all data that do not depend on the target sky.

    Args:
        frame, scenario: the frame and its scenario.
        traced: the frame in the scenario; None if only the source sky is requested.
        source: the frame under the source sky.
        lit: the frame as the renderer of light traced it; None before the first sky.
        inputs: of relighting with the source sky as target; None before the first sky.
    """

    frame: ScenarioFrame
    scenario: Scenario
    traced: TransportFrame | None
    source: SourceImage
    lit: TracedFrame | None = None
    inputs: RelightInputs | None = None


class Relighter:
    """Relights single frames of one workspace; a frame is traced once for all target skies.

    `target` prepares a sky, `relit` yields a frame under prepared skies. `prepare_frame` and
    `relit_under` do the same in two steps, for skies that are not known beforehand.

    Args:
        workspace: with the twin.
        log: at the scale of the frames.
        config: settings that are not options.
        options: of the command.
        recorded: the log without edits; None if scenarios have none.
        hidden: stems of frames whose pictures are not used for views from other places.
        renderer: of the same twin, whose static scene is reused; None sets up one.

    Attributes:
        renderer: of the frames.
        source: the source sky, prepared by the renderer.
    """

    def __init__(
        self,
        workspace: Workspace,
        log: DrivingLog,
        config: RelightConfig,
        options: RelightOptions,
        recorded: Scenario | None = None,
        hidden: frozenset[str] = frozenset(),
        renderer: FrameRenderer | None = None,
    ) -> None:
        self.log = log
        self._options = options
        self._relight = relight_of(workspace, options)
        self._workspace = workspace
        self._config = config
        renderer = renderer or SceneLuminance(workspace).renderer
        # Pictures show upper parts and sides of houses that no LiDAR beam reached, so inferred
        # meshes are visible surfaces here.
        self.renderer = renderer.with_tracing(
            config.transport, options.seed, inferred_is_visible=True
        ).with_roofs(workspace.uncertain_roofs)
        # A given source sky replaces the estimate for light; base colours are those of the build.
        self._source_sky = workspace.sky.dome
        if options.source_sky is not None:
            given = SkyChoice(str(options.source_sky), scale="none")
            self._source_sky = resolve_sky(given, workspace).dome
        self.source = self.renderer.prepare(self._source_sky)
        # Edits are always rendered by light transport; the chosen renderer computes only the light
        # by which pixels are relit.
        self._light = self._light_renderer()
        self._light_source = self._prepared(self._source_sky, self.source)
        self._images = SourceImages(
            workspace,
            log,
            recorded,
            self.renderer,
            self.source,
            config.exposure_s,
            options.seed,
            hidden,
        )

    def _light_renderer(self) -> Renderer:
        if self._options.renderer.renderer == "transport":
            return self.renderer
        return make_reference(
            self._options.renderer,
            self._workspace.twin.assets.background,
            self._workspace.unobserved_occluders,
            self._options.seed,
            inferred_is_visible=True,
        )

    def target(self, sky: TargetSky) -> RelightTarget:
        """Prepare a target sky."""
        level = [d.horizontal_irradiance() for d in (self._source_sky, sky.dome)]
        # The lower bound prevents a division by zero under a black source sky.
        ratio = (level[1] / np.maximum(level[0], 1e-9)).astype(np.float32)
        cells = self.renderer.prepare(sky.dome, sky.behind)
        return RelightTarget(sky, cells, self._prepared(sky.dome, cells), ratio)

    def _prepared(self, dome: SkyDome, cells: EnvironmentCells) -> Any:
        """Return a sky prepared for the light renderer: `cells` for the light transport matrix."""
        return cells if self._light is self.renderer else self._light.prepare(dome)

    def relit(
        self, frame: ScenarioFrame, scenario: Scenario, targets: Sequence[RelightTarget]
    ) -> Iterator[RelitFrame]:
        """Yield one frame under each target sky, in their order.

        Under the source sky the result is the source image; a frame without edits is not traced
        for it.
        """
        # Tracing takes most of the time: recorded frames under the source sky do not need it.
        is_traced = self._options.labels or not all(t.sky.is_source for t in targets)
        ready = self.prepare_frame(frame, scenario, is_traced=is_traced)
        for target in targets:
            yield self.relit_under(ready, target)

    def prepare_frame(
        self, frame: ScenarioFrame, scenario: Scenario, *, is_traced: bool = True
    ) -> PreparedFrame:
        """Return a frame with all data that do not depend on the target sky.

        Args:
            is_traced: trace the frame even if its source image does not require it.
        """
        camera = self.log.cameras[frame.camera_name]
        is_traced |= self._images.is_needed(frame, scenario)
        traced = self.renderer.trace(scenario, frame, camera) if is_traced else None
        return PreparedFrame(frame, scenario, traced, self._images.of(frame, scenario, traced))

    def relit_under(self, ready: PreparedFrame, target: RelightTarget) -> RelitFrame:
        """Return a frame under a target sky."""
        frame, traced, source = ready.frame, ready.traced, ready.source
        if target.sky.is_source:
            image = source.srgb8
            # Without a change of exposure the recorded codes are returned bit for bit.
            if self._options.exposure_ev:
                image = self._camera_picture(frame, source.radiance)
            return RelitFrame(frame, image, source.radiance, traced, None, source)
        # Data that depend only on the source sky are computed once, at the first target sky.
        if ready.lit is None or ready.inputs is None:
            assert traced is not None
            ready.lit = self._lit(traced, ready.scenario)
            ready.inputs = self._source_inputs(frame, traced, source, ready.lit)
        inputs = self._inputs(ready.inputs, frame, ready.lit, target)
        return self._relit(ready, inputs, target)

    def _lit(self, traced: TransportFrame, scenario: Scenario) -> TracedFrame:
        """Trace a frame with the renderer of light."""
        if self._light is self.renderer:
            return traced
        return self._light.trace(scenario, *traced.view)

    def _camera_picture(
        self, frame: CameraFrame, radiance: Float32[np.ndarray, "h w 3"]
    ) -> UInt8[np.ndarray, "h w 3"]:
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        return camera_image(radiance, gain, self._options.exposure_ev)

    def _with_glare(
        self,
        traced: TransportFrame,
        radiance: Float32[np.ndarray, "h w 3"],
        sun: Sun | None,
        sign: Literal[-1, 1],
    ) -> Float32[np.ndarray, "h w 3"]:
        """Add (sign 1) or remove (-1) the glare of a sun on the lens; unchanged without --glare."""
        if sun is None or not self._options.glare:
            return radiance
        frame, camera = traced.view
        rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))[1]
        veil = veiling_glare(
            rays.reshape(camera.height_px, camera.width_px, 3),
            frame.world_from_camera.rotation[:, 2],
            sun,
            traced.sun_on_lens(sun),
            self._options.glare,
        )
        return np.maximum(radiance + sign * veil, 0)

    def _source_inputs(
        self,
        frame: ScenarioFrame,
        traced: TransportFrame,
        source: SourceImage,
        lit: TracedFrame,
    ) -> RelightInputs:
        """Return the inputs of relighting with the source sky as target."""
        light = lit.light(self._light_source)
        return RelightInputs(
            # Ratios apply to light from surfaces: glare is removed before and added afterwards.
            radiance=self._with_glare(traced, source.radiance, self.source.sun, -1),
            is_clipped=source.is_clipped,
            sky_matte=source.sky_matte,
            buffers=traced.buffers,
            source=light,
            target=light,
            target_sky=source.radiance,
            source_sun=self.source.sun,
            found_visibility=traced.found_visibility(self.source.sun),
        )

    def _inputs(
        self, known: RelightInputs, frame: ScenarioFrame, lit: TracedFrame, target: RelightTarget
    ) -> RelightInputs:
        """Return a frame's inputs of relighting under a target sky."""
        camera = self.log.cameras[frame.camera_name]
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        skies = self._source_sky, target.sky.dome
        return known.under(
            lit.light(target.renderer_sky),
            visible_sky(target.cells, frame, camera),
            target.cells.sun,
            CameraAndSkies(gain, frame.world_from_camera, *skies),
        )

    def _relit(
        self, ready: PreparedFrame, inputs: RelightInputs, target: RelightTarget
    ) -> RelitFrame:
        frame, traced = ready.frame, ready.traced
        assert traced is not None
        found = self._relight(inputs, self._config.ratio)
        radiance = found.radiance
        # Masks exist only for cameras in which the ego vehicle is visible.
        ego_vehicle = self.log.ego_vehicle_masks.get(frame.camera_name)
        if ego_vehicle is not None:
            # The ego vehicle has no mesh: it is relit like an open level surface.
            radiance[ego_vehicle] = inputs.radiance[ego_vehicle] * target.level_ratio
        radiance = self._with_glare(traced, radiance, target.cells.sun, 1)
        image = self._camera_picture(frame, radiance)
        return RelitFrame(
            frame, image, radiance, traced, inputs, ready.source, found.expected_error
        )
