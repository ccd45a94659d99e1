"""History of the viewer's states, saved scenarios, and command lines."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lightsim.app.session import History, command_line, scenario_of, state_of
from lightsim.app.state import ViewState
from lightsim.cli.app import parse_command
from lightsim.cli.relight import Relight
from lightsim.cli.simulate import Simulate
from lightsim.core.sky_choice import SkyChoice
from lightsim.scenario.edits import parse_scenario

PLAIN = ViewState("front", "00")
FILE = Path("folder of 'mine'/street.json")
METRES = st.floats(-1e4, 1e4)
NAMES = st.text(min_size=1, max_size=8)
PLACES = st.fixed_dictionaries({"x_m": METRES, "y_m": METRES, "yaw_deg": METRES})
OFFSETS = st.lists(METRES, min_size=3, max_size=3)
EDITS = st.one_of(
    st.fixed_dictionaries({"do": st.just("remove"), "actor": NAMES}),
    st.fixed_dictionaries({"do": st.just("move"), "actor": NAMES, "at": PLACES}),
    st.fixed_dictionaries({"do": st.just("move"), "actor": NAMES, "offset_m": OFFSETS}),
    st.fixed_dictionaries({"do": st.just("insert"), "asset": NAMES, "id": NAMES, "at": PLACES}),
    st.fixed_dictionaries({"do": st.just("ego"), "offset_m": OFFSETS}),
)
SKIES = st.builds(
    SkyChoice,
    st.sampled_from(["source", "sun:120,30", "time:2019-01-01T12:00:00", "-a sky.hdr", "é#1"]),
    st.floats(-360, 360),
    st.sampled_from(["auto", "none", "1.5"]),
    st.sampled_from(["", "-30,20", "120,30"]),
    st.floats(0, 1000),
)
EXPOSURES = st.floats(-30, 30)


@given(sky=SKIES, exposure_ev=EXPOSURES, edits=st.lists(EDITS, max_size=4), name=NAMES)
def test_a_saved_state_is_read_back(
    sky: SkyChoice, exposure_ev: float, edits: list[dict[str, Any]], name: str
) -> None:
    state = ViewState("front", "07", sky, exposure_ev, tuple(edits))
    written = json.loads(json.dumps(scenario_of(state, name), allow_nan=False))
    request = parse_scenario(written, FILE)
    assert request.name == name
    assert state_of(request, state.camera, state.stem, state.exposure_ev) == state


def test_inserted_actors_get_their_default_ids() -> None:
    """Otherwise the second one would change its id when the first is removed."""
    insert = {"do": "insert", "asset": "cone", "at": {"x_m": 0, "y_m": 0, "yaw_deg": 0}}
    request = parse_scenario({"version": 1, "edits": [insert, insert]}, FILE)
    edits = state_of(request, "front", "00").edits
    assert [edit["id"] for edit in edits] == ["inserted-1", "inserted-2"]


@settings(deadline=None, max_examples=40)
@given(sky=SKIES, exposure_ev=EXPOSURES)
def test_the_command_line_makes_the_state_without_edits(sky: SkyChoice, exposure_ev: float) -> None:
    state = replace(PLAIN, sky=sky, exposure_ev=exposure_ev)
    words = shlex.split(command_line(Path("a work"), FILE, state, "mine", "--frames", "2:3"))
    command = parse_command(words[1:])
    assert isinstance(command, Relight)
    assert command.work == Path("a work")
    options = command.options
    assert list(options.sky_by_name.values()) == [sky]
    assert (options.name, options.exposure_ev, options.frames) == ("mine", exposure_ev, "2:3")


@settings(deadline=None, max_examples=10)
@given(exposure_ev=EXPOSURES)
def test_the_command_line_of_edits_names_the_file(exposure_ev: float) -> None:
    edits = ({"do": "remove", "actor": "a"},)
    state = replace(PLAIN, exposure_ev=exposure_ev, edits=edits)
    words = shlex.split(command_line(Path("work"), FILE, state, "mine"))
    command = parse_command(words[1:])
    assert isinstance(command, Simulate)
    assert (command.scenario, command.options.name) == (FILE, "mine")
    assert command.options.exposure_ev == exposure_ev
    # The sky is that of the file.
    assert command.options.sky == ()


def test_a_plain_command_line_has_no_superfluous_options() -> None:
    line = command_line(Path("work"), FILE, PLAIN, "mine")
    assert line == "lightsim relight work --sky source --name mine"
    bright = replace(PLAIN, exposure_ev=-1.0)
    assert command_line(Path("work"), FILE, bright, "mine").endswith("--exposure-ev=-1")


CHANGES = st.lists(st.tuples(st.integers(0, 4), st.sampled_from(["", "sun", "car"])), max_size=12)


def history_of(changes: list[tuple[int, str]]) -> History:
    history = History.of(PLAIN)
    for stem, drag in changes:
        history = history.changed(replace(PLAIN, stem=str(stem)), drag)
    return history


@given(CHANGES)
def test_undo_and_redo_are_inverse(changes: list[tuple[int, str]]) -> None:
    history = end = history_of(changes)
    back = [history.current]
    while history.can_undo:
        history = history.undo()
        back.append(history.current)
    assert history.current == PLAIN
    assert history.undo() is history
    for state in reversed(back):
        assert history.current == state
        history = history.redo()
    assert history.redo() is history
    assert (history.states, history.position) == (end.states, end.position)


@given(CHANGES, st.integers(1, 5))
def test_a_change_after_undo_drops_what_was_undone(
    changes: list[tuple[int, str]], steps: int
) -> None:
    history = history_of(changes)
    for _ in range(steps):
        history = history.undo()
    new = replace(PLAIN, stem="new")
    for drag in ("", "sun"):
        changed = history.changed(new, drag)
        assert changed.current == new
        assert not changed.can_redo
        assert changed.undo().current == history.current


def test_a_drag_is_one_entry_and_another_drag_is_another() -> None:
    one, two, three = (replace(PLAIN, stem=stem) for stem in "123")
    history = History.of(PLAIN).changed(one, "sun 1").changed(two, "sun 1")
    assert history.states == (PLAIN, two)
    assert history.changed(two, "sun 2").states == (PLAIN, two)
    assert history.changed(three, "sun 2").states == (PLAIN, two, three)
    # An undo ends the drag: what it undid cannot be changed by it.
    assert history.undo().changed(three, "sun 1").states == (PLAIN, three)
    assert history.changed(three).states == (PLAIN, two, three)


@pytest.mark.parametrize("count", [999, 5000])
def test_a_long_session_forgets_its_oldest_states(count: int) -> None:
    history = History.of(PLAIN)
    for number in range(count):
        history = history.changed(replace(PLAIN, stem=str(number)))
    assert len(history.states) == 1000
    assert history.current.stem == str(count - 1)
    assert history.undo().current.stem == str(count - 2)
