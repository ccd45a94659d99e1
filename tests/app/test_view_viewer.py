"""Controls of the viewer with wrong, late or unusual input, on a small log without a place."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.app.browser_client import wait_until
from tests.app.test_view_editor import hilly
from tests.app.test_view_scene import built
from tests.tiny_world import LENS

from lightsim.app.editing import remove_actor
from lightsim.app.light_panel import TIME, stored_sky
from lightsim.app.paths import add_waypoint, delete_waypoint, place_of
from lightsim.app.server import open_server, stop_server
from lightsim.app.state import ViewState
from lightsim.app.viewer import Viewer
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.store.exr import write_exr

pytest.importorskip("viser")
WAIT_S = 60.0


@pytest.fixture
def viewer(tmp_path: Path) -> Generator[Viewer]:
    work = built(tmp_path)
    work.__dict__.update(
        reading=SimpleNamespace(image_scale=1.0), fields=SimpleNamespace(ground=hilly())
    )
    ground = np.zeros((LENS.height_px, LENS.width_px), np.float32)
    work.mattes = {frame.stem: ground for frame in work.log.frames}
    server = open_server("127.0.0.1", 0)
    state = ViewState("above", "01")
    viewer = Viewer(server, work, state, SilentProgress(), method="physical")
    yield viewer
    viewer.close()
    stop_server(server)


def test_a_log_without_a_place_has_no_day_and_hour_and_is_relit(viewer: Viewer) -> None:
    assert TIME not in viewer._light._kind.options
    viewer.change(replace(viewer.state, sky=SkyChoice("sun:100,40")))
    assert viewer.wait(WAIT_S)
    shown = viewer._picture._shown
    assert shown is not None
    assert shown.is_final
    assert (shown.relit != shown.recorded).any()


@pytest.mark.parametrize(
    ("control", "typed", "sky"),
    [
        ("_azimuth", 500.0, "sun:0.0,45.0,3"),
        ("_elevation", 0.0, "sun:180.0,1.0,3"),
        ("_elevation", 200.0, "sun:180.0,90.0,3"),
        ("_turbidity", 0.0, "sun:180.0,45.0,1"),
        ("_turbidity", 50.0, "sun:180.0,45.0,10"),
    ],
)
def test_typed_numbers_stay_within_their_limits(
    viewer: Viewer, control: str, typed: float, sky: str
) -> None:
    viewer.change(replace(viewer.state, sky=SkyChoice("sun:180.0,45.0,3")))
    getattr(viewer._light, control).value = typed
    viewer._light._sun_set(control)
    assert viewer.state.sky.sky == sky


@pytest.mark.parametrize(("typed", "stem"), [(-1, "00"), (0, "00"), (2, "02"), (99, "02")])
def test_a_frame_beyond_an_end_is_that_of_the_end(viewer: Viewer, typed: int, stem: str) -> None:
    viewer._picture._frame.value = typed
    assert viewer._picture._stem() == stem


@pytest.mark.parametrize("sky", ["sun:10", "time:2026-06-21T12:00:00Z", "sun:x"])
def test_a_wrong_sky_leaves_state_and_history(viewer: Viewer, sky: str) -> None:
    before = viewer.history
    with pytest.raises(InputError):
        viewer.change(replace(viewer.state, sky=SkyChoice(sky)))
    assert viewer.history == before


@pytest.mark.parametrize("date", ["2026-13-45", "", "0001-01-01", "9999-12-31", "1800-01-01"])
def test_a_wrong_date_is_refused(viewer: Viewer, date: str) -> None:
    viewer._light._date.value = date
    before = viewer.history
    with pytest.raises(InputError):
        viewer._light._time_set("date")
    assert viewer.history == before


def test_playing_goes_round_and_ends_with_the_viewer(viewer: Viewer) -> None:
    loop = viewer.server.get_event_loop()
    loop.call_soon_threadsafe(viewer._picture._toggle)
    for stem in ("02", "00", "01"):
        wait_until(lambda stem=stem: viewer.state.stem == stem, f"frame {stem}")
    playing = viewer._picture._playing
    assert playing is not None
    viewer.close()
    wait_until(playing.cancelled, "the end of playing")
    assert len(viewer.history.states) == 2


def test_a_drag_is_one_entry_and_late_messages_do_not_begin_another(viewer: Viewer) -> None:
    panel, track = viewer._edits, viewer.editor.recorded.placements[0].track
    place = place_of(track, viewer.time_ns())
    panel._dragged(place, "start")  # nobody is selected
    panel._dragged(place, "end")
    assert len(viewer.history.states) == 1
    panel.select(track.actor_id)
    for phase, x_m in (("start", 0.5), ("update", 1.0), ("end", 2.0), ("update", 9.0)):
        panel._dragged(replace(place, x_m=place.x_m + x_m, z_m=None), phase)
    assert len(viewer.history.states) == 2
    (edit,) = viewer.state.edits
    moved = place_of(viewer.editor.track((edit,), track.actor_id), viewer.time_ns())
    assert moved.x_m == pytest.approx(place.x_m + 2.0, abs=0.01)
    viewer.undo()
    assert viewer.state.edits == ()


def test_a_waypoint_that_another_user_deletes_ends_its_drag(viewer: Viewer) -> None:
    panel, actor_id = viewer._edits, viewer.editor.recorded.placements[0].track.actor_id
    panel.select(actor_id)
    panel._path.value = True
    while len(viewer.editor.path(viewer.state.edits, actor_id)) > 1:
        panel._change_path(delete_waypoint)
    panel._change_path(add_waypoint, viewer.editor.last_s)
    viewer.update_scene()
    assert viewer.wait(WAIT_S)
    panel._change_path(delete_waypoint)
    before = viewer.state
    place = place_of(viewer.editor.track(before.edits, actor_id), viewer.time_ns())
    for phase in ("start", "update", "end"):
        panel._point_dragged(1, place, phase)
    assert viewer.state == before
    assert panel._grabbed is None


def test_the_selection_follows_the_edits(viewer: Viewer) -> None:
    panel = viewer._edits
    panel._inserted()
    name = panel.selected
    assert name is not None
    assert name in panel._actor.options
    viewer.undo()
    assert panel.selected is None
    assert name not in panel._actor.options
    with pytest.raises(InputError, match="no actor is selected"):
        panel._apply(remove_actor)
    viewer.redo()
    assert name in panel._actor.options
    assert viewer.wait(WAIT_S)


@pytest.mark.parametrize("name", ["", "../evening", "a/b", "con", "-x", "evening sky"])
def test_a_scenario_is_saved_under_harmless_names_alone(viewer: Viewer, name: str) -> None:
    viewer._output._name.value = name
    with pytest.raises(InputError, match="not a valid file name"):
        viewer._output._saved()
    viewer._output.show(viewer.state)
    assert [path.name for path in viewer.workspace.root.rglob("*.json")] == ["artefact.json"]


def test_uploads_of_one_name_and_another_content_are_two_files(tmp_path: Path) -> None:
    contents = []
    for level in (0.5, 1.0):
        path = tmp_path / "sky.exr"
        write_exr(path, np.full((8, 16, 3), level, np.float32))
        contents.append(path.read_bytes())
    stored = [stored_sky(tmp_path / "skies", "sky.exr", content) for content in contents]
    assert [path.name for path in stored] == ["sky.exr", "sky-2.exr"]
    assert stored_sky(tmp_path / "skies", "sky.exr", contents[0]) == stored[0]
    assert [path.read_bytes() for path in stored] == contents


@pytest.mark.parametrize("name", ["sky.exr", "sky.png", "../../sky.exr"])
def test_a_broken_upload_stores_nothing(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        stored_sky(tmp_path / "skies", name, b"not a picture")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
