"""The picture of one camera: timeline, wipe between recorded and relit, expected error."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lightsim.app.camera_view import CameraView
from lightsim.app.picture_layers import ShownPicture, layered
from lightsim.app.widgets import on_user_event, within

if TYPE_CHECKING:
    from lightsim.app.scene_view import SceneView
    from lightsim.app.state import ViewState
    from lightsim.app.viewer_base import ViewerBase

# Longest time between two frames while playing, in seconds: gaps of a recording are skipped.
_LONGEST_STEP_S = 1.0
# Quality of JPEG pictures for the clients. Chosen.
_JPEG_QUALITY = 85


class PicturePanel:
    """The window "Picture" with the timeline."""

    def __init__(self, viewer: ViewerBase, scene_view: SceneView) -> None:
        self._viewer, self._scene_view = viewer, scene_view
        self._shown: ShownPicture | None = None
        self._playing: asyncio.Task[None] | None = None
        log, gui, icon = viewer.workspace.log, viewer.server.gui, viewer.icon
        self._stems = log.stems
        blank = np.full((270, 480, 3), 24, np.uint8)
        self._image = gui.add_image(blank, format="jpeg", jpeg_quality=_JPEG_QUALITY)
        self._status = gui.add_markdown("")
        self._wipe = gui.add_slider("Recorded | relit", 0.0, 1.0, 0.01, 0.0)
        self._error = gui.add_checkbox("Expected error", False, hint="Of the final relit picture")
        self._camera = gui.add_dropdown("Camera", tuple(log.cameras))
        last = max(1, len(self._stems) - 1)
        self._frame = gui.add_slider("Frame", 0, last, 1, 0)
        self._play = gui.add_button("Play", icon=icon.PLAYER_PLAY)
        self._camera_view = gui.add_checkbox("Look through the camera", False)
        self._look = CameraView(viewer.server)
        for control in (self._wipe, self._error):
            on_user_event(control, lambda _: self._draw())
        on_user_event(self._camera, lambda _: self._go(camera=self._camera.value))
        on_user_event(self._frame, lambda _: self._go(stem=self._stem()))
        on_user_event(self._play, lambda _: self._toggle())
        on_user_event(self._camera_view, lambda _: self._set_camera_view())

    def show(self, state: ViewState) -> None:
        """Set the timeline to a state."""
        self._camera.value = state.camera
        self._frame.value = self._stems.index(state.stem)

    def show_picture(self, shown: ShownPicture, status: str) -> None:
        """Show a picture, with a line of text below it."""
        self._shown = shown
        self._status.content = status
        self._draw()

    def notify(self, status: str) -> None:
        """Show a line of text below the picture that is shown."""
        self._status.content = status

    def is_playing(self) -> bool:
        """Return True while the timeline advances by itself."""
        return self._playing is not None

    def close(self) -> None:
        """Stop playing."""
        playing, self._playing = self._playing, None
        if playing is not None:
            playing.get_loop().call_soon_threadsafe(playing.cancel)

    def _draw(self) -> None:
        shown = self._shown
        if shown is None:
            return
        image = layered(shown, self._wipe.value, is_error_shown=self._error.value)
        self._image.image = image
        self._look.show(image, shown.depth_z_m, *shown.view)

    def _stem(self) -> str:
        return self._stems[min(within(self._frame), len(self._stems) - 1)]

    def _go(self, **change: Any) -> None:
        viewer = self._viewer
        viewer.change(viewer.at(replace(viewer.state, **change)), viewer.drags.name("timeline"))

    def _set_camera_view(self) -> None:
        self._look.is_on = self._camera_view.value
        self._scene_view.set_camera_view(self._camera_view.value)
        self._draw()

    def _toggle(self) -> None:
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
        else:
            self._playing = asyncio.get_running_loop().create_task(self._run())
        self._play.label = "Pause" if self._playing else "Play"

    async def _run(self) -> None:
        """Advance the timeline at the speed of the recording, from the end back to the start."""
        viewer = self._viewer
        while True:
            frames = viewer.workspace.log.frames_of(viewer.state.camera)
            stems = [frame.stem for frame in frames]
            now = stems.index(viewer.state.stem)
            after = (now + 1) % len(stems)
            step_s = (frames[after].time_ns - frames[now].time_ns) / 1e9
            await asyncio.sleep(min(max(step_s, 0.05), _LONGEST_STEP_S))
            self._go(stem=stems[after])
