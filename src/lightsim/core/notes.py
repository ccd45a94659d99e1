"""Notes: sentences on unusual or substituted input, stored with the artefact and printed once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

# Characters of a printed note: four lines of a terminal; lists of actors are longer.
_PRINTED = 300


def grouped_notes(ids_by_what: Mapping[str, Sequence[str]], noun: str) -> tuple[str, ...]:
    """Return one note for each property, with the names of all that have it.

    Args:
        ids_by_what: names by their common property, such as "has a default shape".
        noun: singular for one of them, such as "actor".
    """
    return tuple(
        f"{noun} {ids[0]}: {what}"
        if len(ids) == 1
        else f"{len(ids)} {noun}s: {what}: {', '.join(ids)}"
        for what, ids in ids_by_what.items()
        if ids
    )


def printed_note(note: str, place: str) -> str:
    """Return a note for the terminal: long ones are cut between two words.

    Args:
        place: file that holds the whole note.
    """
    if len(note) <= _PRINTED:
        return note
    return f"{note[:_PRINTED].rsplit(' ', 1)[0]} ... (in full: {place})"


def unseen_notes(notes: Iterable[str], seen: set[str]) -> list[str]:
    """Return the notes that are not yet in the set `seen`, each once, and add them to it.

    Stages repeat the notes of their inputs; users read each note once.
    """
    found = [note for note in dict.fromkeys(notes) if note not in seen]
    seen.update(found)
    return found
