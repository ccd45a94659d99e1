"""What a frame shows under the source sky before it is relit: the recorded picture, the picture
with edits in it, or what the pictures tell of the view from a place where no camera stood."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.ndimage import binary_dilation

from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8, luminance, srgb8_from_linear
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.scenario import (
    ActorPlacement,
    Scenario,
    ScenarioFrame,
    changed_placements,
)
from lightsim.core.sensors import CameraFrame
from lightsim.core.window import Window, window_around
from lightsim.relighting.physical.actor_layer import (
    ActorLayer,
    cut_out,
    empty_layer,
    photographed,
)
from lightsim.relighting.physical.camera_look import noise_like
from lightsim.relighting.physical.edited import EditedImage, EditInputs, edited_image
from lightsim.relighting.physical.occlusion import hidden_by_picture
from lightsim.relighting.physical.ratio import RelightInputs
from lightsim.render.frame_renderer import (
    SHADOW_ERROR_M,
    FrameRenderer,
    TransportFrame,
    visible_sky,
)
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.render.window import seen_through
from lightsim.simulation.camera_looks import CameraLooks, motion_in_picture
from lightsim.simulation.edit_window import edit_window, put_into
from lightsim.simulation.novel_views import NovelViews

_PIXEL_SAMPLES = 16
"""Of rendered actors: with 4, panes that mirror a street at a grazing angle are black and white
dots once a camera that sharpens has seen them. For 16 the actors' window takes a twentieth more
time and 0.4 kB more of each pixel."""
_SUN_RAYS = 64
"""Of their pixels: with 4 the edge of a shadow that falls from far away is black and white dots."""
_GLOSSY_RAYS = 32
"""A pixel, of their reflections: with 8, dark panes of a car had grain of 2.3 codes (standard
deviation beside the neighbours) where the camera sharpens, with these 1.0, for a fifth more time
of the actors."""
_CLIPPED = 254
_MARGIN_PX = 4
"""Around new actors: what is behind them is known from there."""
_REACH_M = 3.0
"""Farther than this from an actor, what it takes of the sky's light is not seen."""


@dataclass(frozen=True, eq=False)
class SourceImage:
    """One frame under the source sky.

    Args:
        srgb8: as its camera would have recorded it; the recorded bytes where nothing is edited.
        radiance: the same, linear, scene units.
        is_clipped: at least one channel is saturated.
        sky_matte: fraction of each pixel that is sky.
        is_edited: pixels that differ from the recorded picture.
        is_observed: of a frame from where no camera stood, what recorded pictures show; None where
            a camera stood.
    """

    srgb8: UInt8[np.ndarray, "h w 3"]
    radiance: Float32[np.ndarray, "h w 3"]
    is_clipped: Bool[np.ndarray, "h w"]
    sky_matte: Float32[np.ndarray, "h w"]
    is_edited: Bool[np.ndarray, "h w"]
    is_observed: Bool[np.ndarray, "h w"] | None = None


_Changed = tuple[tuple[ActorPlacement, ...], tuple[ActorPlacement, ...]]
"""Actors that are gone and actors that are new."""


class SourceImages:
    """Makes source images of one workspace.

    Args:
        recorded: the log as it was, from which scenarios were made by edits; None: there are none.
        renderer: of the frames.
        sky: the source's, made ready by it.
        exposure_s: how long shutters are open.
        seed: of the cameras' noise.
        hidden: stems of frames whose pictures do not help to show a view from elsewhere.
    """

    def __init__(
        self,
        workspace: Workspace,
        log: DrivingLog,
        recorded: Scenario | None,
        renderer: FrameRenderer,
        sky: EnvironmentCells,
        exposure_s: float,
        seed: int,
        hidden: frozenset[str] = frozenset(),
    ) -> None:
        self._workspace = workspace
        self._log = log
        self._recorded = recorded
        self._renderer = renderer
        self._sky = sky
        self._novel = None
        if recorded is not None:
            self._novel = NovelViews(workspace, log, recorded, renderer, hidden)
        self._hidden = hidden
        self._actors = renderer.sampled(
            _PIXEL_SAMPLES, sky.sun, sun_rays=_SUN_RAYS, glossy_rays=_GLOSSY_RAYS
        )
        self._looks = CameraLooks(log)
        self._exposure_s = exposure_s
        self._seed = seed

    def is_needed(self, frame: ScenarioFrame, scenario: Scenario) -> bool:
        """Whether `of` needs the frame traced. Edits may change the picture: the camera stands
        elsewhere, or actors that come or go stand in it, or close to what it shows, or between
        that and the sun."""
        return frame.source == "rendered" or self._changed(frame, scenario) is not None

    def of(
        self, frame: ScenarioFrame, scenario: Scenario, traced: TransportFrame | None
    ) -> SourceImage:
        """The source image of a frame.

        Args:
            traced: the frame in the scenario; None where `is_needed` says so.
        """
        image = self._recorded_image(frame)
        changed = self._changed(frame, scenario)
        if changed is None and frame.source != "rendered":
            return image
        assert traced is not None
        before = traced
        if changed is not None and self._recorded is not None:
            everybody = changed[0] + changed[1]
            before = self._renderer.trace_beside(traced, self._recorded, everybody)
        if frame.source == "rendered":
            image = self._from_elsewhere(frame, before)
        if changed is None:
            return image
        edited = self._edited(frame, scenario, (before, traced), image, changed)
        if edited is None:
            return image
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        radiance = self._with_noise(edited, gain, frame)
        made = srgb8_from_linear(radiance * gain)
        return SourceImage(
            np.where(edited.is_edited[..., None], made, image.srgb8),
            radiance,
            edited.is_clipped,
            edited.sky_matte,
            edited.is_edited | image.is_edited,
            image.is_observed,
        )

    def _edited(
        self,
        frame: CameraFrame,
        scenario: Scenario,
        views: tuple[TransportFrame, TransportFrame],
        image: SourceImage,
        changed: _Changed,
    ) -> EditedImage | None:
        """The edited picture, of which only what the edits reach is traced; None: they reach
        nothing."""
        assert self._recorded is not None
        numbers = _numbers(self._recorded, changed[0]), _numbers(scenario, changed[1])
        layer = self._layer_of(changed[1], frame, scenario, views[1], image)
        found = edit_window(views, changed, numbers, layer.coverage > 0, self._sky)
        if found is None:
            return None
        before, after = (view.part(found.window, found.is_reached) for view in views)
        inputs = self._inputs(frame, (before, after), image, changed, layer, found.window)
        return put_into(_unedited(image), edited_image(inputs), found.window)

    def _inputs(
        self,
        frame: CameraFrame,
        views: tuple[TransportFrame, TransportFrame],
        image: SourceImage,
        changed: _Changed,
        layer: ActorLayer,
        window: Window,
    ) -> EditInputs:
        """A window of the frame in the log and in the scenario, under the source sky.

        Args:
            views: of the window.
            image, layer: of the whole picture.
        """
        assert self._recorded is not None
        camera = self._log.cameras[frame.camera_name]
        (before, traced), (gone, new), sun = views, changed, self._sky.sun
        light = before.light(self._sky)
        everything = np.ones_like(image.sky_matte[window])
        return EditInputs(
            recorded=RelightInputs(
                radiance=image.radiance[window],
                is_clipped=image.is_clipped[window],
                sky_matte=image.sky_matte[window],
                buffers=before.geometry,
                source=light,
                target=light,
                target_sky=image.radiance[window],
                source_sun=sun,
                target_sun=sun,
                found_visibility=before.found_visibility(sun),
                picture_width_px=camera.width_px,
            ),
            buffers=traced.geometry,
            light=traced.light(self._sky),
            found_visibility=traced.found_visibility(sun),
            sky=visible_sky(self._sky, *seen_through(frame, camera, window)),
            gone=before.coverage(_numbers(self._recorded, gone)),
            new=layer.part(window),
            past_gone=before.sun_past(gone, sun, SHADOW_ERROR_M) if sun else everything,
            past_new=before.sun_past(new, sun) if sun else everything,
            is_fixed=self._ego_vehicle(camera)[window],
            focal_px=camera.fx,
            look=self._looks.of(camera),
            gain=self._workspace.twin.assets.camera_gains[camera.name],
        )

    def _from_elsewhere(self, frame: CameraFrame, before: TransportFrame) -> SourceImage:
        """The street without edits from where no camera stood: from the log's pictures, and from
        the twin what none of them shows. The ego vehicle's own parts move with the camera."""
        assert self._novel is not None
        shown = [f for f in self._log.frames_of(frame.camera_name) if f.stem not in self._hidden]
        recorded = self._recorded_image(min(shown, key=lambda f: abs(f.time_ns - frame.time_ns)))
        view = self._novel.of(frame, before.geometry, before.image(self._sky))
        is_fixed = self._ego_vehicle(self._log.cameras[frame.camera_name])
        radiance = np.where(is_fixed[..., None], recorded.radiance, view.radiance)
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        srgb8 = np.where(is_fixed[..., None], recorded.srgb8, srgb8_from_linear(radiance * gain))
        return SourceImage(
            srgb8,
            radiance,
            np.any(srgb8 >= _CLIPPED, axis=-1),
            np.where(is_fixed, recorded.sky_matte, view.sky_matte),
            ~is_fixed,
            view.is_observed | is_fixed,
        )

    def _layer_of(
        self,
        new: tuple[ActorPlacement, ...],
        frame: CameraFrame,
        scenario: Scenario,
        traced: TransportFrame,
        image: SourceImage,
    ) -> ActorLayer:
        """New actors as the camera would record them; only what is around them is rendered."""
        camera = self._log.cameras[frame.camera_name]
        numbers = _numbers(scenario, new)
        covered = traced.coverage(numbers)
        layer = empty_layer(*covered.shape)
        if not covered.any():
            return layer
        codes = image.srgb8.astype(np.float32) / 255
        is_new = np.isin(traced.geometry.actor_index, numbers)
        hidden = hidden_by_picture(codes, traced.geometry, is_new, camera.fx)
        near = np.asarray(binary_dilation(covered > 0, iterations=_MARGIN_PX), dtype=bool)
        window = window_around(near, 0)
        sampled = self._actors.retrace(traced.part(window, near[window]))
        fraction = sampled.sampled_coverage(numbers)
        found = cut_out(sampled.image(self._sky), fraction, covered[window], near[window])
        seen = 1 - hidden[window]
        layer.radiance[window] = seen[..., None] * found.radiance
        layer.coverage[window] = seen * found.coverage
        ego = self._log.ego if scenario.ego is None else scenario.ego
        motion_px = motion_in_picture(
            scenario, (frame, camera), ego, traced.geometry, numbers, self._exposure_s
        )
        return photographed(layer, self._looks.of(camera), motion_px)

    def _with_noise(
        self, edited: EditedImage, gain: Float32[np.ndarray, "3"], frame: CameraFrame
    ) -> Float32[np.ndarray, "h w 3"]:
        """The camera's noise where pixels are rendered; where they are so in part, the rest of what
        the recorded part has. The same for a frame whatever else is made."""
        look = self._looks.of(self._log.cameras[frame.camera_name])
        name = crc32(f"{frame.camera_name}/{frame.stem}".encode())
        rng = np.random.default_rng([self._seed, name])
        noise = noise_like(luminance(edited.radiance * gain), look, rng)
        missing = np.sqrt(1 - np.square(1 - edited.rendered)) * noise
        return np.maximum(edited.radiance + missing[..., None] / gain, 0.0).astype(np.float32)

    def _recorded_image(self, frame: CameraFrame) -> SourceImage:
        camera = self._log.cameras[frame.camera_name]
        srgb8 = frame.load_srgb8()
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        matte = self._workspace.likeliest_sky(frame)[..., None]
        return SourceImage(
            srgb8,
            (linear_from_srgb8(srgb8) / gain).astype(np.float32),
            np.any(srgb8 >= _CLIPPED, axis=-1),
            resize_area(matte, camera.height_px, camera.width_px)[..., 0],
            np.zeros(srgb8.shape[:2], dtype=bool),
        )

    def _ego_vehicle(self, camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
        nowhere = np.zeros((camera.height_px, camera.width_px), dtype=bool)
        return self._log.ego_vehicle_masks.get(camera.name, nowhere)

    def _changed(self, frame: CameraFrame, scenario: Scenario) -> _Changed | None:
        """Actors of the log that are not there and actors that were not, where the camera may see
        the difference."""
        if self._recorded is None:
            return None
        changed = changed_placements(self._recorded, scenario, frame.time_ns)
        if changed is None:
            return None
        camera = self._log.cameras[frame.camera_name]
        is_near = any(
            reaches_into(p, frame, camera, self._sun_direction) for part in changed for p in part
        )
        return changed if is_near else None

    @property
    def _sun_direction(self) -> Float32[np.ndarray, "3"] | None:
        sun = self._sky.sun
        if sun is None or sun.direction_world[2] <= 0:
            return None
        return sun.direction_world.astype(np.float32)


def _unedited(image: SourceImage) -> EditedImage:
    nothing = np.zeros_like(image.sky_matte)
    is_edited = np.zeros_like(image.is_edited)
    return EditedImage(image.radiance, is_edited, image.is_clipped, image.sky_matte, nothing)


def _numbers(scenario: Scenario, placements: tuple[ActorPlacement, ...]) -> list[int]:
    return [scenario.number_by_actor[p.track.actor_id] for p in placements]


def reaches_into(
    placement: ActorPlacement,
    frame: CameraFrame,
    camera: PinholeCamera,
    sun_direction: Float32[np.ndarray, "3"] | None,
) -> bool:
    """Whether an actor, its surroundings or its shadow on the ground may be in the picture.

    False is certain: the convex hull of the points lies behind the camera or beside its view.
    """
    pose = placement.world_from_actor(frame.time_ns)
    half = placement.track.size_lwh_m / 2
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    points = pose.apply(corners * (half + _REACH_M))
    if sun_direction is not None:
        # Down to the lowest ground within reach.
        top = pose.apply(corners * (half + SHADOW_ERROR_M))
        length_m = (top[:, 2] - points[:, 2].min()) / sun_direction[2]
        points = np.concatenate([points, top - length_m[:, None] * sun_direction])
    x, y, z = frame.world_from_camera.inverse().apply(points).T
    left, right = -camera.cx / camera.fx, (camera.width_px - camera.cx) / camera.fx
    up, down = -camera.cy / camera.fy, (camera.height_px - camera.cy) / camera.fy
    sides = (z, x - left * z, right * z - x, y - up * z, down * z - y)
    return not any((side < 0).all() for side in sides)
