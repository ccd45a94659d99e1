"""Notes of a file reader: one sentence per feature, with the names that it concerns."""

from __future__ import annotations

# Number of names listed with one sentence; the others are counted.
_MAX_NAMED = 4


class Notes:
    """Sentences in the order of their first occurrence, each with the names that it concerns."""

    def __init__(self) -> None:
        self._names: dict[str, dict[str, None]] = {}

    def add(self, sentence: str, name: str | None = None) -> None:
        """Add a sentence without a full stop, and the name of the material or part concerned."""
        names = self._names.setdefault(sentence, {})
        if name is not None:
            names[name] = None

    def sentences(self) -> tuple[str, ...]:
        """Return each sentence once, with up to four of the names in brackets."""
        return tuple(_with_names(sentence, list(names)) for sentence, names in self._names.items())


def _with_names(sentence: str, names: list[str]) -> str:
    if not names:
        return sentence
    shown = ", ".join(name[:40] for name in names[:_MAX_NAMED])
    rest = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"{sentence} ({shown}{rest})"
