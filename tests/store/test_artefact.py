"""Artefacts appear whole, know when they are stale, and survive interruption."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from lightsim.errors import ArtefactError
from lightsim.store.artefact import (
    ArtefactKey,
    find_damage,
    make_artefact,
    read_record,
    require_whole,
    state_of,
)


def artefact_key(**changes: object) -> ArtefactKey:
    base = {
        "stage": "toy",
        "sources": {"a.py": "1"},
        "config": {"size": 3},
        "inputs": {"log": "a"},
        "seed": 0,
    }
    return ArtefactKey(**{**base, **changes})  # type: ignore[arg-type]


def test_made_once_then_reused_then_stale(tmp_path: Path) -> None:
    calls: list[int] = []

    def build(folder: Path) -> list[str]:
        calls.append(1)
        (folder / "value.txt").write_text("x")
        return ["said once"]

    folder = tmp_path / "toy"
    assert state_of(folder, artefact_key()) == "missing"
    first = make_artefact(folder, artefact_key(), build)
    second = make_artefact(folder, artefact_key(), build)
    assert first == second
    assert len(calls) == 1
    assert first["notes"] == ["said once"]
    changes = {"config": {"size": 4}, "inputs": {"log": "b"}, "seed": 1, "sources": {"a.py": "2"}}
    for name, value in changes.items():
        assert state_of(folder, artefact_key(**{name: value})) == "stale"
    assert [p.name for p in tmp_path.iterdir()] == ["toy"]


def test_interrupted_build_shows_nothing_and_resumes(tmp_path: Path) -> None:
    done: list[str] = []

    def build(folder: Path, stop_after: int) -> list[str]:
        for k in range(4):
            path = folder / f"{k}.txt"
            if path.exists():
                continue
            if len(done) == stop_after:
                raise KeyboardInterrupt
            done.append(path.name)
            path.write_text(str(k))
        return []

    folder = tmp_path / "toy"
    with pytest.raises(KeyboardInterrupt):
        make_artefact(folder, artefact_key(), lambda f: build(f, 2))
    assert not folder.exists()
    make_artefact(folder, artefact_key(), lambda f: build(f, 99))
    assert done == ["0.txt", "1.txt", "2.txt", "3.txt"]
    names = {p.name for p in folder.iterdir()}
    assert names == {"0.txt", "1.txt", "2.txt", "3.txt", "artefact.json"}


def test_leftovers_of_another_recipe_are_removed(tmp_path: Path) -> None:
    def fail(folder: Path) -> list[str]:
        (folder / "old.txt").write_text("old")
        raise KeyboardInterrupt

    folder = tmp_path / "toy"
    with pytest.raises(KeyboardInterrupt):
        make_artefact(folder, artefact_key(), fail)
    make_artefact(folder, artefact_key(seed=5), lambda f: [])
    assert not (folder / "old.txt").exists()


def test_broken_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "artefact.json").write_text("{")
    with pytest.raises(ArtefactError, match=r"artefact\.json"):
        read_record(tmp_path)


def fill(folder: Path) -> list[str]:
    (folder / "sub").mkdir(exist_ok=True)
    (folder / "sub" / "value.bin").write_bytes(bytes(range(100)))
    return []


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[50] ^= 4
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda path: path.unlink(), "missing"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "99 bytes instead of 100"),
        (flip, "other content"),
    ],
)
def test_a_damaged_artefact_is_told_and_made_anew(
    tmp_path: Path, harm: Callable[[Path], None], told: str
) -> None:
    folder = tmp_path / "toy"
    record = make_artefact(folder, artefact_key(), fill)
    assert find_damage(folder, record, is_hashed=True) == ()
    harm(folder / "sub" / "value.bin")
    assert told in find_damage(folder, record, is_hashed=True)[0]
    assert state_of(folder, artefact_key(), is_hashed=True) == "broken"
    with pytest.raises(ArtefactError, match=rf"value\.bin.*{told}.*Build again"):
        require_whole(folder, "Build again.")
    make_artefact(folder, artefact_key(), fill)
    assert (folder / "sub" / "value.bin").read_bytes() == bytes(range(100))
    assert [p.name for p in tmp_path.iterdir()] == ["toy"]


@pytest.mark.parametrize("text", ["{", "[]", '{"key": 1}', "[" * 100_000])
def test_an_artefact_with_a_damaged_record_is_set_aside(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "toy"
    make_artefact(folder, artefact_key(), fill)
    (folder / "artefact.json").write_text(text)
    assert state_of(folder, artefact_key()) == "broken"
    make_artefact(folder, artefact_key(), fill)
    assert state_of(folder, artefact_key(), is_hashed=True) == "made"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["toy", "toy.broken-1"]


def test_a_record_that_names_what_cannot_be_a_file_is_damage(tmp_path: Path) -> None:
    folder = tmp_path / "toy"
    record = make_artefact(folder, artefact_key(), fill)
    names = {"x" * 5000: [1, "a"], "sub": [1, "a"], "a\0b": [1, "a"]}
    damage = find_damage(folder, {**record, "files": names}, is_hashed=True)
    assert [words.split()[-1] for words in damage] == ["read", "file", "read"]


def test_an_endless_record_is_not_read(tmp_path: Path) -> None:
    folder = tmp_path / "toy"
    make_artefact(folder, artefact_key(), fill)
    with (folder / "artefact.json").open("w") as handle:
        handle.truncate(1 << 40)
    assert state_of(folder, artefact_key()) == "broken"


def test_only_an_artefact_of_the_same_stage_is_replaced(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    other = tmp_path / "other"
    make_artefact(other, artefact_key(stage="other"), fill)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for folder in (mine, other):
        with pytest.raises(ArtefactError, match=r"contains other files.*Nothing was changed"):
            make_artefact(folder, artefact_key(), fill)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    empty = tmp_path / "empty"
    empty.mkdir()
    make_artefact(empty, artefact_key(), fill)


def test_a_finished_attempt_that_was_not_renamed_is_taken(tmp_path: Path) -> None:
    """The process was killed between the last file and the rename."""
    folder = tmp_path / "toy"
    made = make_artefact(folder, artefact_key(), fill)
    folder.rename(tmp_path / ".toy.partial")
    assert make_artefact(folder, artefact_key(), lambda f: pytest.fail("made again")) == made
    assert state_of(folder, artefact_key(), is_hashed=True) == "made"


def test_an_artefact_of_version_0_2_is_stale(tmp_path: Path) -> None:
    folder = tmp_path / "toy"
    record = make_artefact(folder, artefact_key(), fill)
    old = {k: v for k, v in record.items() if k not in ("files", "format")}
    (folder / "artefact.json").write_text(json.dumps({**old, "key": "of another time"}))
    assert state_of(folder, artefact_key()) == "stale"
    make_artefact(folder, artefact_key(), fill)
    assert [p.name for p in tmp_path.iterdir()] == ["toy"]
