"""Ids from a log never decide where a file lies."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lightsim.errors import ArtefactError
from lightsim.store.names import file_names, inside, is_harmless, safe_file_name

HARMLESS = (
    "car-1",
    "0f2c8a5e-6c1f-4f0e-9d5e-3a3bb1f0a001",
    "front_camera",
    "CAM_FRONT",
    "a.b",
    "007",
)
HOSTILE = (
    "../../../x", "/etc/passwd", "..", ".", "", ".partial", ".hidden", "-rf", "a/b", "a\\b", "a:b",
    "a" * 300, "con", "NUL.txt", "x.", "x ", " x", "two words", "new\nline", "nul\0byte", "weiß",
    "日本", "\ud800", "e\u0301", "é", "~root", "x~0000000000000000", "*", "a\u202eb",
)  # fmt: skip


def test_harmless_ids_keep_their_names() -> None:
    assert [safe_file_name(name) for name in HARMLESS] == list(HARMLESS)


def test_hostile_ids_become_plain_names_that_differ(tmp_path: Path) -> None:
    names = [safe_file_name(text) for text in (*HOSTILE, *HARMLESS)]
    assert len({name.casefold() for name in names}) == len(names)
    for name in names:
        (tmp_path / f"{name}.glb").write_text(name)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f"{name}.glb" for name in names)


def test_ids_that_differ_by_case_alone_do_not_fraction_a_file() -> None:
    names = file_names(["Car", "car", "bus"])
    assert names["bus"] == "bus"
    assert len({name.casefold() for name in names.values()}) == 3


@given(st.sets(st.text(), max_size=8))
def test_any_set_of_ids_gets_names_of_its_own(texts: set[str]) -> None:
    names = file_names(texts)
    assert set(names) == texts
    assert len({name.casefold() for name in names.values()}) == len(texts)
    for name in names.values():
        assert is_harmless(name.replace("~", "-"))
        # A made-up name is never that of a harmless id of another set.
        assert ("~" in name) != is_harmless(name)


@pytest.mark.parametrize(
    "name",
    [
        "../x",
        "a/../../x",
        "/etc/passwd",
        "",
        ".",
        "a//b",
        "a\\..\\x",
        "C:x",
        "a\0b",
        None,
        7,
        ["a"],
    ],
)
def test_a_name_in_json_must_stay_below_its_folder(tmp_path: Path, name: object) -> None:
    with pytest.raises(ArtefactError, match="leads out of its folder"):
        inside(tmp_path, name)


def test_links_out_of_the_folder_are_seen(tmp_path: Path) -> None:
    twin = tmp_path / "twin"
    twin.mkdir()
    assert inside(twin, "actors/car.glb") == twin / "actors" / "car.glb"
    (twin / "actors").symlink_to(tmp_path)
    with pytest.raises(ArtefactError):
        inside(twin, "actors/car.glb")
