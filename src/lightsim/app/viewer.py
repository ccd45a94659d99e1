"""The viewer: one state, the controls that change it, and the threads that make its pictures."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from lightsim.app.edit_panel import EditPanel
from lightsim.app.editor import Editor
from lightsim.app.light_panel import LightPanel
from lightsim.app.meshes import view_meshes
from lightsim.app.output_panel import OutputPanel
from lightsim.app.page import look_ahead
from lightsim.app.picture_layers import ShownPicture
from lightsim.app.picture_panel import PicturePanel
from lightsim.app.pictures import Pictures
from lightsim.app.preview import Previews
from lightsim.app.session import History
from lightsim.app.stage import Stage
from lightsim.app.suns import direction_of, position_of, sun_of
from lightsim.app.widgets import Drags
from lightsim.app.worker import LatestWins
from lightsim.build.workspace import Workspace
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.errors import LightSimError, need
from lightsim.progress import Progress
from lightsim.view.figures import reduced

if TYPE_CHECKING:
    import numpy as np
    import viser

    from lightsim.app.state import ViewState

# Time without a change after which the final picture is made, in seconds.
FINAL_DELAY_S = 0.3
_LOGGER = logging.getLogger(__name__)


class Viewer:
    """Connects the controls of a server with the pictures of a work folder.

    The state changes in viser's event loop only; pictures are made in other threads.

    Args:
        server: a running server.
        workspace: with the twin.
        state: what is shown first.
        name: of the scenario that is saved.
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
        self.server, self.workspace, self.name = server, workspace, name
        self.folder = workspace.root / "view"
        self.icon: Any = need("viser", extra="view").Icon
        self.drags = Drags()
        self.editor = Editor(workspace)
        # Single actors of a group that a file removes can be restored.
        state = replace(state, edits=self.editor.without_groups(state.edits))
        self.history = History.of(state)
        self._finished: ViewState | None = None
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        server.gui.set_panel_label(f"LightSim: {workspace.log.name}")
        self.pictures = Pictures(workspace, self.editor.recorded, method)
        self.previews = Previews(self.pictures)
        meshes = view_meshes(workspace, progress)
        look_ahead(server, workspace.log.ego.held(self.time_ns()))
        self.stage = Stage(server, workspace, meshes, self.editor.recorded)
        self._make_panels()
        self._staging = LatestWins(self._restage, name="stage")
        self._preview = LatestWins(self._make_preview, name="preview")
        self._final = LatestWins(self._make_final, name="final", delay_s=FINAL_DELAY_S)
        self.stage.on_select(self._edits.select)
        self.stage.on_sun_dragged(self._sun_dragged)
        self._show(None, state)

    @property
    def state(self) -> ViewState:
        """What is shown."""
        return self.history.current

    def change(self, state: ViewState, drag: str = "") -> None:
        """Show another state.

        Args:
            drag: name of the continuous change to which it belongs (`session.History.changed`).

        Raises:
            InputError: the words of its sky are wrong; the shown state remains.
        """
        sun_of(state.sky, self.workspace.log.geo, self.workspace.sky)
        before, self.history = self.state, self.history.changed(state, drag)
        self._show(before, state)

    def undo(self) -> None:
        """Show the state before the last change."""
        before, self.history = self.state, self.history.undo()
        self._show(before, self.state)

    def redo(self) -> None:
        """Show the state that was undone last."""
        before, self.history = self.state, self.history.redo()
        self._show(before, self.state)

    def restage(self) -> None:
        """Update the actors and handles of the scene, for example after a selection."""
        self._staging.post(self.state)

    def at(self, state: ViewState) -> ViewState:
        """Return a state whose camera has a frame of its stem: else its nearest frame."""
        frames = self.workspace.log.frames_of(state.camera)
        if any(frame.stem == state.stem for frame in frames):
            return state
        stems = self.workspace.log.stems
        wanted = stems.index(state.stem)
        nearest = min(frames, key=lambda frame: abs(stems.index(frame.stem) - wanted))
        return replace(state, stem=nearest.stem)

    def time_ns(self) -> int:
        """Return the time of the shown frame, on the log's clock."""
        return self._frame(self.state, self.editor.recorded).time_ns

    def actor_ids(self) -> tuple[str, ...]:
        """Return the ids of all actors: those of the log, and inserted ones."""
        inserted = [str(edit["id"]) for edit in self.state.edits if edit["do"] == "insert"]
        return (*(track.actor_id for track in self.editor.recorded.tracks), *inserted)

    def wait(self, timeout_s: float) -> bool:
        """Return True once scene and picture of the state are final, False after the timeout."""
        workers = (self._staging, self._preview, self._final)
        return all(worker.wait(timeout_s) for worker in workers)

    def close(self) -> None:
        """Stop all threads and a running simulation."""
        workers = (self._staging, self._preview, self._final)
        self._picture.close()
        # None starts another request while another is waited for.
        for worker in workers:
            worker.stop()
        self._output.close()
        for worker in workers:
            worker.close()

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
            self._picture = PicturePanel(self)
        window.float(x=12, y=12, width=500)

    def _show(self, before: ViewState | None, state: ViewState) -> None:
        """Set the controls, and order what a change requires."""
        for panel in (self._light, self._edits, self._output, self._picture):
            panel.show(state)
        sun = sun_of(state.sky, self.workspace.log.geo, self.workspace.sky)
        if sun is not None:
            self.stage.show_sun(direction_of(sun, self.workspace.log.geo))
        if before is None or (before.edits, before.stem) != (state.edits, state.stem):
            self._staging.post(state)
        if self._is_light_alone(before, state):
            self._preview.post(state)
        self._final.post(state)

    @staticmethod
    def _is_light_alone(before: ViewState | None, state: ViewState) -> bool:
        """Return True if two states differ in sky or exposure alone."""
        if before is None or before == state:
            return False
        return replace(before, sky=state.sky, exposure_ev=state.exposure_ev) == state

    def _sun_dragged(self, direction_world: np.ndarray, is_start: bool) -> None:
        if is_start:
            self._sun_drag = self.drags.new("sun")
        sun = position_of(direction_world, self.workspace.log.geo)
        self._light.drag_sun(sun, self._sun_drag)

    @staticmethod
    def _frame(state: ViewState, scenario: Scenario) -> ScenarioFrame:
        at = (state.camera, state.stem)
        return next(f for f in scenario.frames if (f.camera_name, f.stem) == at)

    def _restage(self, state: ViewState) -> None:
        """Place the actors of a state; in the thread of the scene."""
        try:
            scenario = self.editor.scenario(state.edits)
            time_ns = self._frame(state, scenario).time_ns
            boxes = self.editor.boxes(state.edits, time_ns)
            self.stage.show_stem(state.stem)
            self.stage.show_actors(scenario, boxes, self._edits.selected)
            self._edits.show_stage(state, boxes, self.editor.conflicts(state.edits))
        except LightSimError as error:
            self._picture.tell(f"{error}")

    def _make_preview(self, state: ViewState) -> None:
        """Make a preview; in the thread of previews."""
        try:
            scenario = self.editor.scenario(state.edits)
            frame = self._frame(state, scenario)
            image = self.previews.preview(frame, scenario, state.sky, state.exposure_ev)
            ready = self.pictures.ready(frame, scenario)
        except LightSimError as error:
            self._picture.tell(f"{error}")
            return
        is_same_view = state == self.state or self._is_light_alone(self.state, state)
        if not is_same_view or self._finished == self.state:
            return
        recorded = reduced(ready.source.srgb8, image.shape[1])
        view = self.pictures.log.cameras[state.camera], frame
        shown = ShownPicture(recorded, image, False, view)
        self._picture.show_picture(shown, f"preview · {_words(state)}")

    def _make_final(self, state: ViewState) -> None:
        """Make the final picture; in the thread of final pictures."""
        start = time.monotonic()
        try:
            scenario = self.editor.scenario(state.edits)
            frame = self._frame(state, scenario)
            final = self.pictures.final(frame, scenario, state.sky, state.exposure_ev)
        except LightSimError as error:
            self._picture.tell(f"{error}")
            return
        if state != self.state:
            return
        self._finished = state
        shown = ShownPicture(
            final.recorded,
            final.relit,
            True,
            (self.pictures.log.cameras[state.camera], frame),
            final.expected_error,
            final.depth_z_m,
        )
        seconds = time.monotonic() - start
        self._picture.show_picture(shown, f"**final** · {_words(state)} · {seconds:.1f} s")
        self.stage.show_sky(self.pictures.target(state.sky).sky.dome)
        if not self._picture.is_playing():
            # So that the first drag of the sun finds its rays traced.
            self.previews.ready(frame, scenario)


def _words(state: ViewState) -> str:
    """Return the sky of a state in words."""
    sky = state.sky
    words = sky.sky.rpartition("/")[2]
    return f"{words}, sun at {sky.move_sun}" if sky.move_sun else words
