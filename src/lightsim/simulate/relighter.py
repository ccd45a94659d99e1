"""Single frames of a twin under one target sky, and what is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.checks import MAX_EXPOSURE_EV, check_image_scale, check_number, check_seed
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.pipeline.workspace import Workspace
from lightsim.relighting.methods import METHODS, Method
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image import sky_image
from lightsim.render.transport.sky import SkyCells
from lightsim.render.transport.table import TransportConfig
from lightsim.simulate.skies import SkyChoice, TargetSky
from lightsim.store.names import is_harmless


@dataclass(frozen=True)
class RelightOptions:
    """What `lightsim relight` is asked for.

    Args:
        name: of the result folder: letters, digits, and . _ - after the first.
        sky: target sky.
        method: of METHODS.
        exposure_ev: exposure of the output, stops.
        cameras: empty for all.
        frames: START:STOP[:STEP] over the log's own frame numbers, empty for all.
        image_scale: factor on the log's image size; None for that of the build.
        is_linear_written: also write linear EXR frames.
        seed: of the sampling of rays.
        is_overwriting: replace a scenario of this name that was made with other settings.
        is_stale_allowed: go on where the recording has changed since the build.

    Raises:
        InputError: the name is not one for a folder, or a number is out of range.
    """

    name: str
    sky: SkyChoice
    method: Method = "physical"
    exposure_ev: float = 0.0
    cameras: tuple[str, ...] = ()
    frames: str = ""
    image_scale: float | None = None
    is_linear_written: bool = False
    seed: int = 0
    is_overwriting: bool = False
    is_stale_allowed: bool = False

    def __post_init__(self) -> None:
        if not is_harmless(self.name):
            raise InputError(
                "the name is not fit for a folder",
                where="--name",
                got=repr(self.name[:40]),
                expected="letters, digits and . _ -, a letter or digit first",
            )
        if self.method not in METHODS:
            raise InputError(
                "there is no such method",
                where="--method",
                got=self.method,
                expected=f"one of {', '.join(METHODS)}",
            )
        check_number("--exposure-ev", self.exposure_ev, -MAX_EXPOSURE_EV, MAX_EXPOSURE_EV)
        if self.image_scale is not None:
            check_image_scale(self.image_scale)
        check_seed(self.seed)

    def settings(self, image_scale: float) -> dict[str, Any]:
        """All that decides the frames besides twin and sky file."""
        return {
            "sky": self.sky.made_from,
            "method": self.method,
            "exposure_ev": self.exposure_ev,
            "cameras": list(self.cameras),
            "frames": self.frames,
            "image_scale": image_scale,
            "is_linear_written": self.is_linear_written,
        }


@dataclass(frozen=True)
class RelightConfig:
    """How frames are relit: settings that no option of the command names."""

    transport: TransportConfig = field(default_factory=TransportConfig)
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
        options: of the scenario that it belongs to.
    """

    sky: TargetSky
    cells: SkyCells
    level_ratio: Float32[np.ndarray, "3"]
    options: RelightOptions


class Relighter:
    """Relights single frames of one workspace; a frame is traced once for all target skies."""

    def __init__(
        self, workspace: Workspace, log: DrivingLog, config: RelightConfig, seed: int
    ) -> None:
        self.log = log
        self._workspace = workspace
        self._config = config
        self._renderer = FrameRenderer(
            workspace.twin.assets.background, workspace.shadow_casters, config.transport, seed
        )
        self._source = self._renderer.prepare(workspace.sky.dome)

    def target(self, sky: TargetSky, options: RelightOptions) -> RelightTarget:
        """A target sky made ready."""
        level = [d.horizontal_irradiance() for d in (self._workspace.sky.dome, sky.dome)]
        ratio = (level[1] / np.maximum(level[0], 1e-9)).astype(np.float32)
        return RelightTarget(sky, self._renderer.prepare(sky.dome), ratio, options)

    def relit(
        self, frame: CameraFrame, scenario: Scenario, targets: Sequence[RelightTarget]
    ) -> Iterator[RelitFrame]:
        """One frame under each target sky, in their order."""
        camera = self.log.cameras[frame.camera_name]
        traced = self._renderer.trace(scenario, frame, camera)
        source = traced.light(self._source)
        source_srgb8 = frame.load_srgb8()
        for target in targets:
            light = (source, traced.light(target.cells))
            yield self._relit(frame, traced.buffers, light, source_srgb8, target)

    def _relit(
        self,
        frame: CameraFrame,
        buffers: GBuffers,
        light: tuple[ShadowBuffers, ShadowBuffers],
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
            target_sky=sky_image(target.sky.dome, camera, frame),
            source_sun=self._source.sun,
            target_sun=target.cells.sun,
        )
        options = target.options
        radiance = METHODS[options.method](inputs, self._config.ratio)
        own_car = self.log.own_car_masks.get(frame.camera_name)
        if own_car is not None:
            # It moves with the camera and has no mesh: lit as a level surface in the open.
            radiance[own_car] = inputs.radiance[own_car] * target.level_ratio
        image = camera_image(radiance, gain, options.exposure_ev)
        return RelitFrame(frame, image, radiance, buffers, *light, source_srgb8)
