"""Source images of frames, under the source sky: the recorded picture, the picture with edits, or a
view that no camera recorded."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock
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
    as_recorded,
    cut_out,
    empty_layer,
)
from lightsim.relighting.physical.blur_noise import camera_noise
from lightsim.relighting.physical.edited import EditedImage, EditInputs, edited_image
from lightsim.relighting.physical.occlusion import occlusion_from_picture
from lightsim.relighting.physical.ratio import RelightInputs
from lightsim.render.frame_renderer import (
    SHADOW_ERROR_M,
    FrameRenderer,
    TransportFrame,
)
from lightsim.render.image import visible_sky
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.render.window import window_view
from lightsim.simulation.blur_noise import CamerasBlurNoise, motion_in_picture
from lightsim.simulation.edit_window import edit_window, with_window_replaced
from lightsim.simulation.novel_views import NovelViews

# Lowest 8-bit code that counts as saturated; codes of JPEG pictures vary by about one.
_CLIPPED = 254
# Margin around new actors, in pixels, within which the background is rendered for compositing.
_MARGIN_PX = 4
# Distance from an actor, in metres, beyond which its occlusion of the sky is not visible.
_SKY_OCCLUSION_REACH_M = 3.0


@dataclass(frozen=True, eq=False)
class SourceImage:
    """One frame under the source sky.

    Args:
        srgb8: picture of the camera; unedited pixels have the recorded codes.
        radiance: linear radiance of the picture, scene units.
        is_clipped: pixels with at least one saturated channel.
        sky_matte: fraction of each pixel that is sky.
        is_edited: pixels that differ from the recorded picture.
        is_observed: pixels of a view that no camera recorded whose content recorded pictures show;
            None for a recorded view.
    """

    srgb8: UInt8[np.ndarray, "h w 3"]
    radiance: Float32[np.ndarray, "h w 3"]
    is_clipped: Bool[np.ndarray, "h w"]
    sky_matte: Float32[np.ndarray, "h w"]
    is_edited: Bool[np.ndarray, "h w"]
    is_observed: Bool[np.ndarray, "h w"] | None = None


# Removed actors and new actors; a moved actor is in both.
_Changed = tuple[tuple[ActorPlacement, ...], tuple[ActorPlacement, ...]]


class SourceImages:
    """Makes source images of one workspace.

    Args:
        workspace: with the twin.
        log: at the scale of the frames.
        recorded: the log without edits; None if scenarios have none.
        renderer: of the frames.
        sky: the source sky, prepared by the renderer.
        exposure_s: exposure time of the cameras, in seconds.
        seed: of the cameras' noise.
        hidden: stems of frames whose pictures are not used for views from other places.
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
        self._completing = Lock()
        self._hidden = hidden
        # Sampling of rendered actors, for cameras that sharpen. With 4 samples per pixel, panes
        # that mirror a street at a grazing angle are aliased; 16 take 5 % more time for the actors'
        # window and 0.4 kB more per pixel. With 4 sun rays per pixel, shadow edges of distant
        # occluders are noisy. With 8 reflection rays per pixel dark panes have a noise of 2.3 codes
        # (standard deviation relative to the neighbours), with 32 of 1.0, for 20 % more time.
        self._actors = renderer.sampled(16, sky.sun, sun_rays=64, glossy_rays=32)
        self._blur_noise = CamerasBlurNoise(log)
        self._exposure_s = exposure_s
        self._seed = seed

    def is_needed(self, frame: ScenarioFrame, scenario: Scenario) -> bool:
        """Return True if `of` requires the traced frame: the camera was moved, or a new or removed
        actor may be visible, near visible surfaces, or between them and the sun."""
        return frame.source == "rendered" or self._changed(frame, scenario) is not None

    def of(
        self, frame: ScenarioFrame, scenario: Scenario, traced: TransportFrame | None
    ) -> SourceImage:
        """Return the source image of a frame.

        Args:
            traced: the frame in the scenario; None if `is_needed` is False.
        """
        image = self._recorded_image(frame)
        changed = self._changed(frame, scenario)
        if changed is None and frame.source != "rendered":
            return image
        assert traced is not None
        # The scenario is traced already; for the log only pixels of changed actors are traced.
        before = traced
        if changed is not None and self._recorded is not None:
            everybody = changed[0] + changed[1]
            before = self._renderer.trace_changed_pixels(traced, self._recorded, everybody)
        # Edits are applied to the picture of a moved camera as to a recorded one.
        if frame.source == "rendered":
            image = self._novel_view(frame, before)
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
        """Return the edited picture, of which only the window that edits affect is traced; None if
        they affect no pixel."""
        assert self._recorded is not None
        numbers = _numbers(self._recorded, changed[0]), _numbers(scenario, changed[1])
        layer = self._layer_of(changed[1], frame, scenario, views[1], image)
        found = edit_window(views, changed, numbers, layer.coverage > 0, self._sky)
        if found is None:
            return None
        before, after = (view.part(found.window, found.is_reached) for view in views)
        inputs = self._inputs(frame, (before, after), image, changed, layer, found.window)
        return with_window_replaced(_unedited(image), edited_image(inputs), found.window)

    def _inputs(
        self,
        frame: CameraFrame,
        views: tuple[TransportFrame, TransportFrame],
        image: SourceImage,
        changed: _Changed,
        layer: ActorLayer,
        window: Window,
    ) -> EditInputs:
        """Return the inputs of editing for a window: `views` show the window in the log and in the
        scenario, `image` and `layer` are whole pictures."""
        assert self._recorded is not None
        camera = self._log.cameras[frame.camera_name]
        (before, traced), (removed, new), sun = views, changed, self._sky.sun
        light = before.light(self._sky)
        # Without a sun in the source sky no actor casts a shadow.
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
            sky=visible_sky(self._sky, *window_view(frame, camera, window)),
            removed_fraction=before.coverage(_numbers(self._recorded, removed)),
            new=layer.part(window),
            sun_past_removed=before.sun_visibility_with_only(removed, sun, SHADOW_ERROR_M)
            if sun
            else everything,
            sun_past_new=before.sun_visibility_with_only(new, sun) if sun else everything,
            is_fixed=self._ego_vehicle(camera)[window],
            focal_px=camera.fx,
            blur_noise=self._blur_noise.of(camera),
            gain=self._workspace.twin.assets.camera_gains[camera.name],
        )

    def _novel_view(self, frame: CameraFrame, before: TransportFrame) -> SourceImage:
        """Return a view without edits that no camera recorded, from the log's pictures completed by
        the twin. Visible parts of the ego vehicle move with the camera."""
        assert self._novel is not None
        shown = [f for f in self._log.frames_of(frame.camera_name) if f.stem not in self._hidden]
        # The visible parts of the ego vehicle are copied from the picture nearest in time.
        recorded = self._recorded_image(min(shown, key=lambda f: abs(f.time_ns - frame.time_ns)))
        image = before.image(self._sky)
        # The object caches the recorded pictures that its views use.
        with self._completing:
            view = self._novel.of(frame, before.geometry, image)
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
        """Return the layer of new actors as the camera records them; only a window around them is
        rendered."""
        camera = self._log.cameras[frame.camera_name]
        numbers = _numbers(scenario, new)
        covered = traced.coverage(numbers)
        layer = empty_layer(*covered.shape)
        if not covered.any():
            return layer
        # Nearer objects hide new actors; the picture refines the objects' reconstructed outlines.
        codes = image.srgb8.astype(np.float32) / 255
        is_new = np.isin(traced.geometry.actor_index, numbers)
        hidden = occlusion_from_picture(codes, traced.geometry, is_new, camera.fx)
        near = np.asarray(binary_dilation(covered > 0, iterations=_MARGIN_PX), dtype=bool)
        window = window_around(near, 0)
        # Anti-aliased samples are needed at the actors alone; the recorded background has its own.
        sampled = self._actors.retrace(traced.part(window, near[window]))
        fraction = sampled.sampled_coverage(numbers)
        found = cut_out(sampled.image(self._sky), fraction, covered[window], near[window])
        seen = 1 - hidden[window]
        # Layers are premultiplied: radiance is weighted by the visible fraction like the coverage.
        layer.radiance[window] = seen[..., None] * found.radiance
        layer.coverage[window] = seen * found.coverage
        ego = self._log.ego if scenario.ego is None else scenario.ego
        motion_px = motion_in_picture(
            scenario, (frame, camera), ego, traced.geometry, numbers, self._exposure_s
        )
        return as_recorded(layer, self._blur_noise.of(camera), motion_px)

    def _with_noise(
        self, edited: EditedImage, gain: Float32[np.ndarray, "3"], frame: CameraFrame
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return the radiance with the camera's noise at rendered pixels. In partly rendered pixels
        it complements the noise of the recorded part. The noise of a frame depends only on its name
        and the seed."""
        blur_noise = self._blur_noise.of(self._log.cameras[frame.camera_name])
        # A checksum instead of hash(), which differs from process to process.
        name = crc32(f"{frame.camera_name}/{frame.stem}".encode())
        rng = np.random.default_rng([self._seed, name])
        noise = camera_noise(luminance(edited.radiance * gain), blur_noise, rng)
        # Variances add: the recorded part of a pixel contributes (1 - rendered)^2 of its noise.
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
        """Return the removed and the new actors; None if the camera cannot observe a difference."""
        if self._recorded is None:
            return None
        changed = changed_placements(self._recorded, scenario, frame.time_ns)
        if changed is None:
            return None
        camera = self._log.cameras[frame.camera_name]
        is_near = any(
            may_be_in_picture(p, frame, camera, self._sun_direction)
            for part in changed
            for p in part
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


def may_be_in_picture(
    placement: ActorPlacement,
    frame: CameraFrame,
    camera: PinholeCamera,
    sun_direction: Float32[np.ndarray, "3"] | None,
) -> bool:
    """Return True if an actor, its surroundings or its shadow on the ground may be in the picture.

    False is certain: the convex hull of the points is behind the camera or outside one side of its
    view.
    """
    pose = placement.world_from_actor(frame.time_ns)
    half = placement.track.size_lwh_m / 2
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    points = pose.apply(corners * (half + _SKY_OCCLUSION_REACH_M))
    if sun_direction is not None:
        # The shadow extends down to the lowest ground in reach.
        top = pose.apply(corners * (half + SHADOW_ERROR_M))
        length_m = (top[:, 2] - points[:, 2].min()) / sun_direction[2]
        points = np.concatenate([points, top - length_m[:, None] * sun_direction])
    x, y, z = frame.world_from_camera.inverse().apply(points).T
    left, right = -camera.cx / camera.fx, (camera.width_px - camera.cx) / camera.fx
    up, down = -camera.cy / camera.fy, (camera.height_px - camera.cy) / camera.fy
    # One row per boundary of the view: camera plane, left, right, up, down; positive is inside.
    sides = (z, x - left * z, right * z - x, y - up * z, down * z - y)
    return not any((side < 0).all() for side in sides)
