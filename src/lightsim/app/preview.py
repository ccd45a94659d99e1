"""Previews while a control is dragged: small pictures by the plain ratio of two lights.

Unlike final pictures, they have no smoothing, no network correction and no reflections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.app.pictures import Pictures, edits_key
from lightsim.app.recent_results import RecentResults
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.resample import resize_area
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.lighting.target_sky import towards_sun, with_edited_sun
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.quick import QuickFrame, quick_frame, quick_relit
from lightsim.relighting.physical.ratio import RelightInputs
from lightsim.render.frame_renderer import TransportFrame
from lightsim.render.image import visible_sky
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.simulation.scene_luminance import log_average_luminance
from lightsim.simulation.skies import clear_sun, parse_sky

# Width of previews, in pixels.
PREVIEW_WIDTH_PX = 480
# Rows of a clear sky in previews: texels of 2.8 degrees, evaluated in 40 ms.
_SKY_HEIGHT_PX = 64
# Rays to the sun for each pixel: penumbrae are dithered while the sun is dragged.
_SUN_RAYS = 1
# Number of traced frames that are cached: some 30 MB each.
_CACHED_FRAMES = 4


@dataclass(frozen=True, eq=False)
class _PreparedFrame:
    """A small frame with its rays."""

    frame: ScenarioFrame
    camera: PinholeCamera
    traced: TransportFrame
    quick: QuickFrame
    source_level: float


class Previews:
    """Makes previews of the frames of `pictures`."""

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures
        self._frames = RecentResults[_PreparedFrame](_CACHED_FRAMES)
        widest = max(camera.width_px for camera in pictures.log.cameras.values())
        work = pictures.workspace
        scale = work.reading.image_scale * min(1.0, PREVIEW_WIDTH_PX / widest)
        self._log = work.log_at(scale)

    def preview(
        self, frame: ScenarioFrame, scenario: Scenario, sky: SkyChoice, exposure_ev: float
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the preview of a frame under a sky; the first one of a frame takes seconds.

        Raises:
            InputError: as `simulation.skies.resolve_sky`.
        """
        ready = self.prepare_frame(frame, scenario)
        cells, is_levelled = self._sky(sky)
        light = ready.traced.light(cells).shaded
        behind = visible_sky(cells, ready.frame, ready.camera)
        if is_levelled:
            # Scaling of --sky-scale auto, measured in this picture instead of the whole log.
            factor = np.float32(
                ready.source_level
                / max(log_average_luminance(light[ready.quick.is_surface]), 1e-12)
            )
            light, behind = light * factor, behind * factor
        radiance = quick_relit(ready.quick, light, behind)
        return camera_image(radiance, self._pictures.gain(frame.camera_name), exposure_ev)

    def prepare_frame(self, frame: ScenarioFrame, scenario: Scenario) -> _PreparedFrame:
        """Trace a frame, unless it is cached."""
        key = (frame.camera_name, frame.stem, edits_key(scenario.edits))
        return self._frames.get(key, lambda: self._made(frame, scenario))

    def _made(self, frame: ScenarioFrame, scenario: Scenario) -> _PreparedFrame:
        pictures = self._pictures
        whole = pictures.prepare_frame(frame, scenario)
        assert whole.traced is not None
        camera, source = self._log.cameras[frame.camera_name], pictures.relighter.source
        with pictures.tracing:
            traced = whole.traced
            if camera != traced.view[1]:
                traced = pictures.relighter.renderer.trace(scenario, frame, camera)
            traced = traced.diffuse_once(_SUN_RAYS)
            own = traced.light(source)
        size = camera.height_px, camera.width_px
        inputs = RelightInputs(
            radiance=_resized(whole.source.radiance, size),
            is_clipped=_resized(whole.source.is_clipped[..., None], size)[..., 0] > 0.5,
            sky_matte=_resized(whole.source.sky_matte[..., None], size)[..., 0],
            buffers=traced.buffers,
            source=own,
            target=own,
            target_sky=np.zeros((*size, 3), np.float32),
            source_sun=source.sun,
            found_visibility=traced.found_visibility(source.sun),
        )
        quick = quick_frame(inputs, pictures.config.ratio)
        return _PreparedFrame(
            frame, camera, traced, quick, log_average_luminance(own.shaded[quick.is_surface])
        )

    def _sky(self, choice: SkyChoice) -> tuple[EnvironmentCells, bool]:
        """Return a prepared sky, and whether its level is still to be matched to the source's."""
        request, geo = parse_sky(choice), self._pictures.log.geo
        sun = clear_sun(request, geo)
        if sun is None:
            return self._edited(choice), False
        direction, _ = towards_sun(sun[0], sun[1], geo)
        dome = clear_sky(direction, sun[2], height_px=_SKY_HEIGHT_PX)
        if isinstance(request.scale, float):
            dome = dome.scaled(request.scale)
        return self._prepared(self._changed(dome, choice), None), request.scale == "auto"

    def _edited(self, choice: SkyChoice) -> EnvironmentCells:
        """Return the source sky or a file: its dome is cached, the edit is applied anew."""
        plain = replace(choice, yaw_deg=0.0, move_sun="", sun_factor=1.0)
        base = self._pictures.target(plain)
        if plain == choice:
            return base.cells
        behind = base.sky.behind
        return self._prepared(
            self._changed(base.sky.dome, choice),
            None if behind is None else behind.rotated(-choice.yaw_deg),
        )

    def _changed(self, dome: SkyDome, choice: SkyChoice) -> SkyDome:
        """Return a dome with the rotation and the edited sun of a choice."""
        if choice.yaw_deg:
            dome = dome.rotated(-choice.yaw_deg)
        if not choice.has_edited_sun:
            return dome
        moved = parse_sky(choice).moved_sun
        direction = None if moved is None else towards_sun(*moved, self._pictures.log.geo)[0]
        return with_edited_sun(dome, direction, choice.sun_factor)

    def _prepared(self, dome: SkyDome, behind: SkyDome | None) -> EnvironmentCells:
        return self._pictures.relighter.renderer.prepare(dome, behind)


def _resized(image: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "h w c"]:
    image = image.astype(np.float32)
    return image if image.shape[:2] == size else resize_area(image, *size)
