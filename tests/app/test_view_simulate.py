"""What the viewer shows of a built street is what `lightsim simulate` makes of its saved file."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

from tests.app.edit_comparison import largest_difference
from tests.conftest import BuiltStreet

from lightsim import cli
from lightsim.app.editing import Edits, remove_actor, set_path
from lightsim.app.editor import Editor
from lightsim.app.paths import add_waypoint, place_of
from lightsim.app.session import command_line, scenario_of
from lightsim.app.state import ViewState
from lightsim.build.workspace import Workspace


def edits_of_every_kind(editor: Editor) -> Edits:
    """A moving actor moved and one removed; a parked one moved, another sent off; a new cone."""
    actors = [placement.track for placement in editor.recorded.placements]
    driving, gone = [track for track in actors if track.is_moving][:2]
    moved, leaving = [track for track in actors if not track.is_moving][:2]
    time_ns = editor.span_ns[0]
    edits: Edits = remove_actor((), gone.actor_id)
    for track in (driving, moved):
        here = place_of(track, time_ns)
        there = replace(here, x_m=here.x_m + 1.0, yaw_deg=(here.yaw_deg or 0.0) + 10.0, z_m=None)
        edits = editor.move(edits, track.actor_id, time_ns, there)
    path = add_waypoint(editor.path(edits, leaving.actor_id), 0, editor.last_s)
    edits = set_path(edits, leaving.actor_id, path)
    return editor.insert(edits, "cone", replace(place_of(moved, time_ns), z_m=None))[0]


def test_simulated_boxes_are_those_of_the_viewer(built_street: BuiltStreet, tmp_path: Path) -> None:
    editor = Editor(Workspace(built_street.work), library=tmp_path)
    edits = edits_of_every_kind(editor)
    assert len(edits) == 5
    state = ViewState("front_camera", "00", edits=edits)
    path = tmp_path / "viewed.json"
    path.write_text(json.dumps(scenario_of(state, "viewed")))
    only = ("--library", str(tmp_path), "--frames", "0:1", "--cameras", "front_camera")
    line = command_line(built_street.work, path, state, "viewed", *only)
    cli.main(shlex.split(line)[1:])
    written = json.loads((built_street.work / "scenarios/viewed/scenario.json").read_text())
    assert [frame["frame"] for frame in written["frames"]] == ["00"]
    metres, degrees = largest_difference(editor, edits, written)
    assert metres < 0.01
    assert degrees < 0.1
