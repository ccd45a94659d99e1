"""Notes: grouped, cut where they are printed, told once."""

from __future__ import annotations

from lightsim.core.notes import grouped_notes, printed_note, unseen_notes


def test_what_many_share_is_one_note_with_all_names() -> None:
    ids = [f"id-{i} (Car)" for i in range(90)]
    notes = grouped_notes({"default shape": ids, "too long": ["b"], "nothing": []}, "actor")
    assert notes == (f"90 actors: default shape: {', '.join(ids)}", "actor b: too long")
    printed = printed_note(notes[0], "work/geometry/artefact.json")
    assert printed.startswith("90 actors: default shape: id-0 (Car), id-1 (Car), ")
    assert printed.endswith(" ... (in full: work/geometry/artefact.json)")
    assert len(printed) < 360
    assert printed_note(notes[1], "x") == notes[1]


def test_a_note_that_stages_hand_on_is_told_once() -> None:
    seen: set[str] = set()
    assert unseen_notes(["a", "b", "a"], seen) == ["a", "b"]
    assert unseen_notes(["b", "c"], seen) == ["c"]
