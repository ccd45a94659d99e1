"""The viewer: its state, the controls that change it, and the threads that make its pictures."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from lightsim.app.baked import LightTracer, TracedLight
from lightsim.app.edit_panel import EditPanel
from lightsim.app.light_panel import LightPanel
from lightsim.app.output_panel import OutputPanel
from lightsim.app.page import set_initial_camera
from lightsim.app.picture_layers import ShownPicture
from lightsim.app.picture_panel import PicturePanel
from lightsim.app.pictures import Pictures, edits_key
from lightsim.app.preview import Previews
from lightsim.app.recent_results import RecentResults
from lightsim.app.scene_view import SceneView
from lightsim.app.state import ViewState
from lightsim.app.stored import view_meshes
from lightsim.app.suns import direction_of, position_of, sun_of
from lightsim.app.viewer_base import ViewerBase, frame_of
from lightsim.app.worker import LatestRequestWorker
from lightsim.build.workspace import Workspace
from lightsim.errors import LightSimError
from lightsim.progress import Progress
from lightsim.view.figures import reduced

if TYPE_CHECKING:
    import numpy as np
    import viser

# Time without a change after which the final picture is made, in seconds.
FINAL_DELAY_S = 0.3
# Time after the final picture after which the 3D view gets its light, in seconds.
_LIGHT_DELAY_S = 1.0
_LOGGER = logging.getLogger(__name__)


class Viewer(ViewerBase):
    """Connects the controls of a server with the pictures of a work folder.

    Pictures are made in separate threads.

    Args:
        server, workspace, state, name: see `ViewerBase`.
        method: relighting method.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        workspace: Workspace,
        state: ViewState,
        progress: Progress,
        *,
        name: str = "edited",
        method: str = "network",
    ) -> None:
        super().__init__(server, workspace, state, name)
        # The state whose final picture is shown; None since the state has changed.
        self._finished: ViewState | None = None
        self._has_picture = False
        self.on_picture: Callable[[ShownPicture], None] = lambda _: None
        """Called with every picture after it is shown, in the thread that made it."""
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        server.gui.set_panel_label(f"LightSim: {workspace.log.name}")
        self._method = method
        self._makers = RecentResults[tuple[Pictures, Previews]](1)
        self._tracer = LightTracer(workspace)
        self._traced = RecentResults[TracedLight](1)
        meshes = view_meshes(self._tracer, progress)
        # The state whose light the meshes have.
        self._lit = ViewState("", workspace.log.stems[0])
        set_initial_camera(server, workspace.log.ego.held(self.time_ns()))
        self.scene_view = SceneView(server, workspace, meshes, self.editor.recorded)
        self._make_panels()
        self._staging = LatestRequestWorker(self._update_scene, name="stage")
        self._preview = LatestRequestWorker(self._make_preview, name="preview")
        self._final = LatestRequestWorker(self._make_final, name="final", delay_s=FINAL_DELAY_S)
        self._light_worker = LatestRequestWorker(
            self._relight, name="light", delay_s=_LIGHT_DELAY_S
        )
        self.scene_view.on_select(self._edits.select)
        self.scene_view.on_sun_dragged(self._sun_dragged)
        self._show(None, self.state)

    @property
    def pictures(self) -> Pictures:
        """Maker of final pictures; made at the first use, because it loads the network."""
        return self._makers.get("", self._make_picture_makers)[0]

    @property
    def previews(self) -> Previews:
        """Maker of previews; made at the first use."""
        return self._makers.get("", self._make_picture_makers)[1]

    def _make_picture_makers(self) -> tuple[Pictures, Previews]:
        pictures = Pictures(self.workspace, self.editor.recorded, self._method)
        return pictures, Previews(pictures)

    def update_scene(self) -> None:
        """Update the actors and handles of the scene, for example after a selection."""
        self._staging.post(self.state)

    def wait(self, timeout_s: float) -> bool:
        """Return True once scene and picture of the state are final, False after the timeout."""
        return all(worker.wait(timeout_s) for worker in self._workers)

    def close(self) -> None:
        """Stop all threads and a running simulation."""
        self._picture.close()
        # All are stopped first, so that no request starts while another one is finishing.
        for worker in self._workers:
            worker.stop()
        self._output.close()
        for worker in self._workers:
            worker.close()

    @property
    def _workers(self) -> tuple[LatestRequestWorker[ViewState], ...]:
        """Worker threads; each follows those that post requests to it."""
        return self._staging, self._preview, self._final, self._light_worker

    def _make_panels(self) -> None:
        gui = self.server.gui
        tabs = gui.add_tab_group()
        with tabs.add_tab("Light", icon=self.icon.SUN):
            self._light = LightPanel(self)
        with tabs.add_tab("Actors", icon=self.icon.CAR):
            self._edits = EditPanel(self)
        with tabs.add_tab("Output", icon=self.icon.MOVIE):
            self._output = OutputPanel(self)
        window = gui.add_panel()
        with window.add_tab("Picture", icon=self.icon.PHOTO):
            self._picture = PicturePanel(self, self.scene_view)
        window.float(x=12, y=12, width=500)

    def _show(self, before: ViewState | None, state: ViewState) -> None:
        """Set the controls, and request the pictures and light that a change requires."""
        if before != state:
            self._finished = None
        for panel in (self._light, self._edits, self._output, self._picture):
            panel.show(state)
        sun = sun_of(state.sky, self.workspace.log.geo, self.workspace.sky)
        if sun is not None:
            self.scene_view.show_sun(direction_of(sun, self.workspace.log.geo))
        if before is None or (before.edits, before.stem) != (state.edits, state.stem):
            self._staging.post(state)
        if self._differs_only_in_light(before, state):
            self._preview.post(state)
        self._final.post(state)

    @staticmethod
    def _differs_only_in_light(before: ViewState | None, state: ViewState) -> bool:
        """Return True if two states differ only in sky or exposure."""
        if before is None or before == state:
            return False
        return replace(before, sky=state.sky, exposure_ev=state.exposure_ev) == state

    def _sun_dragged(self, direction_world: np.ndarray, is_start: bool) -> None:
        if is_start:
            self._sun_drag = self.drags.new("sun")
        sun = position_of(direction_world, self.workspace.log.geo)
        self._light.drag_sun(sun, self._sun_drag)

    def _update_scene(self, state: ViewState) -> None:
        """Place the actors of a state; in the thread of the scene."""
        try:
            scenario = self.editor.scenario(state.edits)
            time_ns = frame_of(state, scenario).time_ns
            boxes = self.editor.boxes(state.edits, time_ns)
            self.scene_view.show_stem(state.stem)
            self.scene_view.show_actors(scenario, boxes, self._edits.selected)
            self._edits.show_scene(state, boxes, self.editor.conflicts(state.edits))
            if not self._has_picture or self._picture.is_playing():
                self._show_recorded(state)
        except LightSimError as error:
            self._picture.notify(f"{error}")

    def _show_recorded(self, state: ViewState) -> None:
        """Show the recorded picture of a frame at once; relit ones take longer than a frame."""
        frame = frame_of(state, self.editor.recorded)
        image = frame.load_srgb8()
        view = self.workspace.log.cameras[state.camera], frame
        note = "" if state.sky.sky == "source" and not state.edits else "; pause to relight"
        self._present(ShownPicture(image, image, False, view), f"recorded{note}")

    def _make_preview(self, state: ViewState) -> None:
        """Make a preview; in the thread of previews."""
        try:
            scenario = self.editor.scenario(state.edits)
            frame = frame_of(state, scenario)
            image = self.previews.preview(frame, scenario, state.sky, state.exposure_ev)
            ready = self.pictures.prepare_frame(frame, scenario)
        except LightSimError as error:
            self._picture.notify(f"{error}")
            return
        is_same_view = state == self.state or self._differs_only_in_light(self.state, state)
        if not is_same_view or self._finished == self.state:
            return
        recorded = reduced(ready.source.srgb8, image.shape[1])
        view = self.pictures.log.cameras[state.camera], frame
        self._present(ShownPicture(recorded, image, False, view), f"preview · {_sky_text(state)}")
        if state == self.state:
            # While previews take longer than the delay, final pictures must not slow them down.
            self._final.post(state)

    def _make_final(self, state: ViewState) -> None:
        """Make the final picture; in the thread of final pictures."""
        if state == self._finished:
            return
        start = time.monotonic()
        try:
            scenario = self.editor.scenario(state.edits)
            frame = frame_of(state, scenario)
            final = self.pictures.final(frame, scenario, state.sky, state.exposure_ev)
        except LightSimError as error:
            self._picture.notify(f"{error}")
            return
        if state != self.state:
            return
        self._finished, self._has_picture = state, True
        shown = ShownPicture(
            final.recorded,
            final.relit,
            True,
            (self.pictures.log.cameras[state.camera], frame),
            final.expected_error,
            final.depth_z_m,
        )
        seconds = time.monotonic() - start
        self._present(shown, f"**final** · {_sky_text(state)} · {seconds:.1f} s")
        self.scene_view.show_sky(self.pictures.target(state.sky).sky.dome, state.exposure_ev)
        self._light_worker.post(state)
        if not self._picture.is_playing():
            # Rays are traced in advance for the first drag of the sun.
            self.previews.prepare_frame(frame, scenario)

    def _present(self, shown: ShownPicture, status: str) -> None:
        self._picture.show_picture(shown, status)
        self.on_picture(shown)

    def _relight(self, state: ViewState) -> None:
        """Give twin and actors the light of a state; in the thread of the light.

        Rays are traced anew if frame or edits have changed. Until then, actors keep their light
        while the timeline moves.
        """
        wanted = _light_state(state)
        if wanted == self._lit or wanted != _light_state(self.state):
            return
        try:
            scenario = self.editor.scenario(state.edits)
            time_ns = frame_of(state, scenario).time_ns
            traced = self._traced.get(
                (state.stem, edits_key(state.edits)),
                lambda: self._tracer.traced(scenario, time_ns),
            )
            meshes = traced.lit(self.pictures.target(state.sky).sky.dome, state.exposure_ev)
        except LightSimError as error:
            self._picture.notify(f"{error}")
            return
        if wanted == _light_state(self.state):
            self.scene_view.show_meshes(meshes)
            self._lit = wanted


def _light_state(state: ViewState) -> ViewState:
    """Return a state that is equal for equal light."""
    return replace(state, camera="")


def _sky_text(state: ViewState) -> str:
    """Return the sky of a state in words."""
    sky = state.sky
    words = sky.sky.rpartition("/")[2]
    return f"{words}, sun at {sky.move_sun}" if sky.move_sun else words
