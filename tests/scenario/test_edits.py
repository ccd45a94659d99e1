"""SCENARIO.json: what is read, and that whatever is wrong is named."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from lightsim.errors import InputError
from lightsim.scenario.edits import Ego, Insert, Move, Remove, parse_scenario

STANDS = {"x_m": 1.0, "y_m": 2.0, "yaw_deg": 90.0}
DRIVES = [{"time_s": 0.0, "x_m": 0.0, "y_m": 0.0}, {"time_s": 1.0, "x_m": 5.0, "y_m": 0.0}]
WHOLE: dict[str, Any] = {
    "version": 1,
    "name": "all",
    "sky": "sun:120,30",
    "edits": [
        {"do": "remove", "actor": "all-moving"},
        {"do": "move", "actor": "a", "offset_m": [1, 0, 0]},
        {"do": "move", "actor": "b", "trajectory": DRIVES},
        {"do": "insert", "asset": "cone", "at": STANDS, "id": "my cone"},
        {"do": "insert", "asset": "car.glb", "trajectory": DRIVES},
        {"do": "ego", "offset_m": [0, 1.5, 0]},
    ],
}
HERE = Path("street.json")


def test_every_edit_is_read_in_order() -> None:
    found = parse_scenario(WHOLE, HERE)
    assert (found.name, found.sky.sky) == ("all", "sun:120,30")
    assert [type(e) for e in found.edits] == [Remove, Move, Move, Insert, Insert, Ego]
    cone, car = found.edits[3], found.edits[4]
    assert isinstance(cone, Insert)
    assert isinstance(car, Insert)
    assert (cone.actor_id, car.actor_id) == ("my cone", "inserted-5")
    assert cone.waypoints[0].yaw_deg == 90.0
    assert [w.time_s for w in car.waypoints] == [0.0, 1.0]
    assert list(found.spelt) == WHOLE["edits"]


def test_sky_and_name_may_be_left_out() -> None:
    found = parse_scenario({"version": 1, "edits": []}, HERE)
    assert (found.name, found.sky.sky) == ("street", "source")


WRONG = {
    "another version": ("version", 2),
    "an unknown edit": ("edits.0.do", "paint"),
    "an unknown entry": ("edits.0.colour", "red"),
    "an unknown key of the file": ("edit", []),
    "no place at all": ("edits.3", {"do": "insert", "asset": "cone"}),
    "two places": ("edits.3.trajectory", DRIVES),
    "a single waypoint": ("edits.2.trajectory", DRIVES[:1]),
    "times that go back": ("edits.2.trajectory", DRIVES[::-1]),
    "no number": ("edits.3.at.x_m", float("nan")),
    "a place out of the world": ("edits.3.at.x_m", 1e9),
    "no heading": ("edits.3.at", {"x_m": 1.0, "y_m": 2.0}),
    "half of the headings": ("edits.2.trajectory", [DRIVES[0] | {"yaw_deg": 0}, DRIVES[1]]),
    "a path without motion": ("edits.2.trajectory", [DRIVES[0], DRIVES[0] | {"time_s": 1}]),
    "two numbers for three": ("edits.5.offset_m", [0, 1]),
    "a word for a number": ("edits.1.offset_m", ["1", 0, 0]),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name: str) -> None:
    key, value = WRONG[name]
    wrong: Any = copy.deepcopy(WHOLE)
    inner, *keys = wrong, *key.split(".")
    for part in keys[:-1]:
        inner = inner[int(part) if part.isdigit() else part]
    last = keys[-1]
    inner[int(last) if last.isdigit() else last] = value
    with pytest.raises(InputError) as reported:
        parse_scenario(wrong, HERE)
    message = str(reported.value)
    assert "street.json" in message
    if key.startswith("edits."):
        number = int(key.split(".")[1])
        assert f"'edits'[{number}]" in message or f"edit {number + 1}" in message
