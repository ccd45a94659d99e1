"""Base class of the viewer: its state, and the methods by which controls change it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from lightsim.app.editor import Editor
from lightsim.app.session import History
from lightsim.app.state import ViewState
from lightsim.app.suns import sun_of
from lightsim.app.widgets import Drags
from lightsim.build.workspace import Workspace
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.errors import need

if TYPE_CHECKING:
    import viser


class ViewerBase(ABC):
    """State of a viewer, with undo and redo; it changes in viser's event loop only.

    Args:
        server: a running server.
        workspace: with the twin.
        state: what is shown first.
        name: of the scenario that is saved.
    """

    def __init__(
        self, server: viser.ViserServer, workspace: Workspace, state: ViewState, name: str
    ) -> None:
        self.server, self.workspace, self.name = server, workspace, name
        self.folder = workspace.root / "view"
        """Folder of all files that the viewer writes."""
        self.icon: Any = need("viser", extra="view").Icon
        self.drags = Drags()
        self.editor = Editor(workspace)
        # Single actors of a group that a file removes can be restored.
        state = replace(state, edits=self.editor.without_groups(state.edits))
        self.history = History.of(state)

    @property
    def state(self) -> ViewState:
        """State of the viewer that is shown now."""
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
        return frame_of(self.state, self.editor.recorded).time_ns

    def actor_ids(self) -> tuple[str, ...]:
        """Return the ids of all actors: those of the log, and inserted ones."""
        inserted = [str(edit["id"]) for edit in self.state.edits if edit["do"] == "insert"]
        return (*(track.actor_id for track in self.editor.recorded.tracks), *inserted)

    @abstractmethod
    def update_scene(self) -> None:
        """Update the actors and handles of the scene, for example after a selection."""

    @abstractmethod
    def _show(self, before: ViewState | None, state: ViewState) -> None:
        """Show a state instead of the one before."""


def frame_of(state: ViewState, scenario: Scenario) -> ScenarioFrame:
    """Return the frame of a scenario that a state shows."""
    at = (state.camera, state.stem)
    return next(f for f in scenario.frames if (f.camera_name, f.stem) == at)
