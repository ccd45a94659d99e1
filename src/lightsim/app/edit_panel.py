"""Edits of actors: select, drag, turn, remove, insert, paths, ego vehicle, undo."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lightsim.app import editing
from lightsim.app.editor import ActorBox
from lightsim.app.gizmos import Gizmos
from lightsim.app.paths import add_waypoint, delete_waypoint, drag_waypoint, turn_waypoint
from lightsim.app.widgets import notify, on_user_event
from lightsim.errors import InputError, LightSimError
from lightsim.scenario.edits import Path3, Waypoint

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from lightsim.app.editing import Edits
    from lightsim.app.state import ViewState
    from lightsim.app.viewer_base import ViewerBase

_NOBODY = "nobody"
# Distance ahead of the ego vehicle at which assets are inserted, in metres.
_AHEAD_M = 14.0
# Number of conflicts that are listed.
_LISTED = 6
# Largest offset of the ego vehicle that the control offers, in metres. Chosen.
_OFFSET_M = 20.0


class EditPanel:
    """The tab "Actors"."""

    def __init__(self, viewer: ViewerBase) -> None:
        self._viewer = viewer
        gui, icon = viewer.server.gui, viewer.icon
        self._undo = gui.add_button("Undo", icon=icon.ARROW_BACK_UP)
        self._redo = gui.add_button("Redo", icon=icon.ARROW_FORWARD_UP)
        self._actor = gui.add_dropdown("Actor", (_NOBODY, *viewer.actor_ids()))
        self._remove = gui.add_button("Remove", icon=icon.TRASH)
        self._restore = gui.add_button("Restore as recorded", icon=icon.RESTORE)
        self._path = gui.add_checkbox("Edit the path", False)
        self._point = gui.add_slider("Waypoint", 1, 2, 1, 1, visible=False)
        self._add = gui.add_button("Add a waypoint after it", visible=False)
        self._delete = gui.add_button("Delete the waypoint", visible=False)
        self._asset = gui.add_dropdown("Asset", viewer.editor.asset_names)
        self._insert = gui.add_button("Insert ahead of the ego vehicle", icon=icon.PLUS)
        self._ego = gui.add_vector3(
            "Ego offset (ahead, left, up), m",
            (0.0, 0.0, 0.0),
            min=(-_OFFSET_M, -_OFFSET_M, -_OFFSET_M),
            max=(_OFFSET_M, _OFFSET_M, _OFFSET_M),
            step=0.1,
        )
        self._conflicts = gui.add_markdown("")
        self._gizmos = Gizmos(viewer.server.scene, self._dragged, self._point_dragged)
        # Edits at the start of the current drag, and its name.
        self._grabbed: tuple[Edits, str] | None = None
        on_user_event(self._undo, lambda _: viewer.undo())
        on_user_event(self._redo, lambda _: viewer.redo())
        on_user_event(self._actor, lambda _: self.select(self._actor.value))
        on_user_event(self._remove, lambda _: self._apply(editing.remove_actor))
        on_user_event(self._restore, lambda _: self._apply(editing.restore_actor))
        on_user_event(self._path, lambda _: viewer.update_scene())
        on_user_event(self._add, lambda _: self._change_path(add_waypoint, viewer.editor.last_s))
        on_user_event(self._delete, lambda _: self._change_path(delete_waypoint))
        on_user_event(self._insert, lambda _: self._inserted())
        on_user_event(self._ego, lambda _: self._ego_set())

    @property
    def selected(self) -> str | None:
        """Id of the selected actor."""
        return None if self._actor.value == _NOBODY else self._actor.value

    def select(self, actor_id: str) -> None:
        """Select an actor."""
        self._actor.value = actor_id
        self._viewer.update_scene()

    def show(self, state: ViewState) -> None:
        """Set the controls to a state."""
        history = self._viewer.history
        self._undo.disabled, self._redo.disabled = not history.can_undo, not history.can_redo
        names = (_NOBODY, *self._viewer.actor_ids())
        if self._actor.options != names:
            # If the selected actor no longer exists, no actor is selected.
            self._actor.options = names
        self._ego.value = editing.ego_offset(state.edits)

    def show_scene(
        self, state: ViewState, boxes: Mapping[str, ActorBox], conflicts: tuple[str, ...]
    ) -> None:
        """Show conflicts, and handles at the selected actor or at its waypoints."""
        lines = [f"- {text}" for text in conflicts[:_LISTED]]
        if len(conflicts) > _LISTED:
            lines.append(f"- and {len(conflicts) - _LISTED} more")
        self._conflicts.content = "**Conflicts**\n\n" + "\n".join(lines) if lines else ""
        selected = self.selected
        box = None if selected is None else boxes.get(selected)
        is_path = self._path.value and selected is not None
        for control in (self._point, self._add, self._delete):
            control.visible = is_path
        if self._grabbed is not None:
            return
        if is_path:
            assert selected is not None
            path = self._viewer.editor.path(state.edits, selected)
            self._point.max = max(2, len(path))
            self._gizmos.show_path(path, self._heights(state, selected, path))
        else:
            self._gizmos.show_box(box if box is not None and box.has_mesh else None)

    def _heights(self, state: ViewState, actor_id: str, path: Path3) -> list[float]:
        """Return the height of the actor's centre at each waypoint."""
        editor = self._viewer.editor
        track = editor.track(state.edits, actor_id)
        times_ns = [editor.span_ns[0] + round(point.time_s * 1e9) for point in path]
        return [float(track.trajectory.held(t).translation_m[2]) for t in times_ns]

    def _selected(self) -> str:
        if self.selected is None:
            raise InputError("no actor is selected", remedy="Click one, or choose it in the list.")
        return self.selected

    def _change(self, edits: Edits, drag: str = "") -> None:
        self._viewer.change(replace(self._viewer.state, edits=edits), drag)

    def _apply(self, change: Any) -> None:
        self._change(change(self._viewer.state.edits, self._selected()))

    def _change_path(self, change: Any, *further: Any) -> None:
        """Apply a function of `app.paths` to the path and the chosen waypoint."""
        edits, actor_id = self._viewer.state.edits, self._selected()
        path = self._viewer.editor.path(edits, actor_id)
        number = min(self._point.value, len(path)) - 1
        self._change(editing.set_path(edits, actor_id, change(path, number, *further)))

    def _inserted(self) -> None:
        viewer = self._viewer
        ego = viewer.workspace.log.ego.held(viewer.time_ns())
        place = ego.apply(np.array([_AHEAD_M, 0.0, 0.0]))
        at = Waypoint(
            x_m=float(place[0]), y_m=float(place[1]), yaw_deg=float(np.degrees(ego.yaw_rad))
        )
        edits, actor_id = viewer.editor.insert(viewer.state.edits, self._asset.value, at)
        self._change(edits)
        self.select(actor_id)

    def _ego_set(self) -> None:
        ahead, left, up = (float(metres) for metres in self._ego.value)
        edits = editing.set_ego_offset(self._viewer.state.edits, (ahead, left, up))
        self._change(edits, self._viewer.drags.name("ego"))

    def _dragged(self, place: Waypoint, phase: str) -> None:
        """Move the selected actor with its handle."""
        viewer = self._viewer
        self._drag(
            phase,
            lambda edits: viewer.editor.move(edits, self._selected(), viewer.time_ns(), place),
        )

    def _point_dragged(self, number: int, place: Waypoint, phase: str) -> None:
        """Move and turn a waypoint with its handle."""

        def changed(edits: Edits) -> Edits:
            actor_id = self._selected()
            path = self._viewer.editor.path(edits, actor_id)
            if number >= len(path):
                raise InputError("another user has deleted the waypoint", remedy="Drag another.")
            was_deg = self._gizmos.heading_deg(number)
            path = drag_waypoint(path, number, place.x_m, place.y_m)
            if place.yaw_deg is not None and abs(place.yaw_deg - was_deg) > 0.1:
                path = turn_waypoint(path, number, place.yaw_deg)
            return editing.set_path(edits, actor_id, path)

        self._drag(phase, changed)

    def _drag(self, phase: str, changed: Callable[[Edits], Edits]) -> None:
        """Apply a change to the edits at the start of a drag, in each of its phases."""
        viewer = self._viewer
        if phase == "start":
            self._grabbed = viewer.state.edits, viewer.drags.new("handle")
        # Messages that arrive after the end do not begin another drag.
        if self._grabbed is None:
            return
        edits, drag = self._grabbed
        try:
            self._change(changed(edits), drag)
        except LightSimError as error:
            notify(viewer.server, str(error))
        finally:
            if phase == "end":
                self._grabbed = None
                viewer.update_scene()
