"""Single frames of a twin under one target sky, and what is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.pipeline.workspace import Workspace
from lightsim.relighting.methods import METHODS
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image import sky_image
from lightsim.render.transport.matrix import TransportConfig
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.simulate.options import RelightOptions
from lightsim.simulate.skies import TargetSky


@dataclass(frozen=True)
class RelightConfig:
    """How frames are relit: settings that no option of the command names."""

    transport: TransportConfig = field(default_factory=lambda: TransportConfig(bounces=2))
    """Light of source and target sky on the twin."""
    ratio: RatioConfig = field(default_factory=RatioConfig)
    """From the two lights to the relit pixels."""


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """One relit frame and what it was made of.

    Args:
        frame: of the log.
        image_srgb8: as the camera would have recorded it.
        radiance: linear, scene units, before gain and exposure.
        buffers: geometry.
        source: light of the source sky.
        target: light of the target sky.
        source_srgb8: the recorded image.
    """

    frame: CameraFrame
    image_srgb8: UInt8[np.ndarray, "h w 3"]
    radiance: Float32[np.ndarray, "h w 3"]
    buffers: GBuffers
    source: ShadowBuffers
    target: ShadowBuffers
    source_srgb8: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class RelightTarget:
    """A target sky made ready for many frames.

    Args:
        sky: as it was resolved.
        cells: for sums of light.
        level_ratio: light on level ground in the open, target over source.
    """

    sky: TargetSky
    cells: EnvironmentCells
    level_ratio: Float32[np.ndarray, "3"]


class Relighter:
    """Relights single frames of one workspace; a frame is traced once for all target skies."""

    def __init__(
        self, workspace: Workspace, log: DrivingLog, config: RelightConfig, options: RelightOptions
    ) -> None:
        self.log = log
        self._options = options
        self._workspace = workspace
        self._config = config
        self._renderer = FrameRenderer(
            workspace.twin.assets.background,
            workspace.unobserved_occluders,
            config.transport,
            options.seed,
        )
        self._source = self._renderer.prepare(workspace.sky.dome)

    def target(self, sky: TargetSky) -> RelightTarget:
        """A target sky made ready."""
        level = [d.horizontal_irradiance() for d in (self._workspace.sky.dome, sky.dome)]
        ratio = (level[1] / np.maximum(level[0], 1e-9)).astype(np.float32)
        return RelightTarget(sky, self._renderer.prepare(sky.dome), ratio)

    def relit(
        self, frame: CameraFrame, scenario: Scenario, targets: Sequence[RelightTarget]
    ) -> Iterator[RelitFrame]:
        """One frame under each target sky, in their order."""
        camera = self.log.cameras[frame.camera_name]
        traced = self._renderer.trace(scenario, frame, camera)
        source = traced.light(self._source)
        found = traced.found_visibility(self._source.sun)
        source_srgb8 = frame.load_srgb8()
        for target in targets:
            light = (source, traced.light(target.cells))
            yield self._relit(frame, traced.buffers, light, found, source_srgb8, target)

    def _relit(
        self,
        frame: CameraFrame,
        buffers: GBuffers,
        light: tuple[ShadowBuffers, ShadowBuffers],
        found_visibility: Float32[np.ndarray, "h w"] | None,
        source_srgb8: UInt8[np.ndarray, "h w 3"],
        target: RelightTarget,
    ) -> RelitFrame:
        camera = self.log.cameras[frame.camera_name]
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        matte = resize_area(
            self._workspace.sky_matte(frame)[..., None], camera.height_px, camera.width_px
        )[..., 0]
        inputs = RelightInputs(
            radiance=(linear_from_srgb8(source_srgb8) / gain).astype(np.float32),
            is_clipped=np.any(source_srgb8 >= 254, axis=-1),
            sky_matte=matte,
            buffers=buffers,
            source=light[0],
            target=light[1],
            target_sky=sky_image(target.sky.behind or target.sky.dome, camera, frame),
            source_sun=self._source.sun,
            target_sun=target.cells.sun,
            found_visibility=found_visibility,
        )
        radiance = METHODS[self._options.method](inputs, self._config.ratio)
        ego_vehicle = self.log.ego_vehicle_masks.get(frame.camera_name)
        if ego_vehicle is not None:
            # It moves with the camera and has no mesh: lit as a level surface in the open.
            radiance[ego_vehicle] = inputs.radiance[ego_vehicle] * target.level_ratio
        image = camera_image(radiance, gain, self._options.exposure_ev)
        return RelitFrame(frame, image, radiance, buffers, *light, source_srgb8)
