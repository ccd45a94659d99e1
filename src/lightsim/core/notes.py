"""Notes: sentences on what was odd or substituted, kept with what was made and printed once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

_PRINTED = 300
"""Characters of a printed note: four lines of a terminal; lists of actors are longer."""


def grouped_notes(ids_by_what: Mapping[str, Sequence[str]], noun: str) -> tuple[str, ...]:
    """Return one note for each thing that several have in common, with all of their names.

    Args:
        ids_by_what: names by what is said of them, such as "has a default shape".
        noun: for one of them, such as "actor".
    """
    return tuple(
        f"{noun} {ids[0]}: {what}"
        if len(ids) == 1
        else f"{len(ids)} {noun}s: {what}: {', '.join(ids)}"
        for what, ids in ids_by_what.items()
        if ids
    )


def printed_note(note: str, place: str) -> str:
    """Return a note as it is printed: long ones are cut between two words.

    Args:
        place: file that holds the whole note.
    """
    if len(note) <= _PRINTED:
        return note
    return f"{note[:_PRINTED].rsplit(' ', 1)[0]} ... (in full: {place})"


def unseen_notes(notes: Iterable[str], seen: set[str]) -> list[str]:
    """Return the notes that were not seen before, each once, and remember them in `seen`.

    Stages hand on the notes of what they read; read by people, each counts once.
    """
    found = [note for note in dict.fromkeys(notes) if note not in seen]
    seen.update(found)
    return found
