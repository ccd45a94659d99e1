"""Artefacts appear whole, know when they are stale, and survive interruption."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightsim.errors import ArtefactError
from lightsim.store.artefact import Recipe, fingerprint, make_artefact, read_record, state_of


def recipe(**changes: object) -> Recipe:
    base = {"stage": "toy", "schema": 1, "config": {"size": 3}, "inputs": {"log": "a"}, "seed": 0}
    return Recipe(**{**base, **changes})  # type: ignore[arg-type]


def test_made_once_then_reused_then_stale(tmp_path: Path) -> None:
    calls: list[int] = []

    def build(folder: Path) -> list[str]:
        calls.append(1)
        (folder / "value.txt").write_text("x")
        return ["said once"]

    folder = tmp_path / "toy"
    assert state_of(folder, recipe()) == "missing"
    first = make_artefact(folder, recipe(), build)
    second = make_artefact(folder, recipe(), build)
    assert first == second
    assert len(calls) == 1
    assert first["notes"] == ["said once"]
    for change in ({"config": {"size": 4}}, {"inputs": {"log": "b"}}, {"seed": 1}, {"schema": 2}):
        assert state_of(folder, recipe(**change)) == "stale"
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
        make_artefact(folder, recipe(), lambda f: build(f, 2))
    assert not folder.exists()
    make_artefact(folder, recipe(), lambda f: build(f, 99))
    assert done == ["0.txt", "1.txt", "2.txt", "3.txt"]
    names = {p.name for p in folder.iterdir()}
    assert names == {"0.txt", "1.txt", "2.txt", "3.txt", "artefact.json"}


def test_leftovers_of_another_recipe_are_removed(tmp_path: Path) -> None:
    def fail(folder: Path) -> list[str]:
        (folder / "old.txt").write_text("old")
        raise KeyboardInterrupt

    folder = tmp_path / "toy"
    with pytest.raises(KeyboardInterrupt):
        make_artefact(folder, recipe(), fail)
    make_artefact(folder, recipe(seed=5), lambda f: [])
    assert not (folder / "old.txt").exists()


def test_broken_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "artefact.json").write_text("{")
    with pytest.raises(ArtefactError, match=r"artefact\.json"):
        read_record(tmp_path)


def test_fingerprint_sees_names_and_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    before = fingerprint(tmp_path)
    (tmp_path / "a").write_text("2")
    changed = fingerprint(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert len({before, changed, fingerprint(tmp_path)}) == 3
