"""Files named by a frame index, such as 00.jpg and 00.pkl.gz.

PandaSet's original download had `.pkl.gz`; current mirrors have `.pkl`, and users convert pictures
and rename files. Each kind of file is read under any of its suffixes, in upper or lower case. A
file that looks like one of the kind but cannot be read is an error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lightsim.datasets.layout import has_folder, visible_entries
from lightsim.errors import InputError
from lightsim.store.reading import is_folder

# Most digits of a frame index: a year at 10 Hz has nine.
_MAX_DIGITS = 8
# Number of files that a message lists.
_SHOWN = 3
# Suffixes of accompanying files that contain no data.
_NOT_DATA = (".txt", ".md", ".rst", ".pdf", ".log", ".ini", ".db", ".html", ".yaml", ".yml")


@dataclass(frozen=True)
class FileKind:
    """Files of one purpose.

    Args:
        name: name for messages, such as "pictures".
        suffixes: accepted suffixes in lower case; of two files with one index, the earlier one is
            used.
    """

    name: str
    suffixes: tuple[str, ...]

    def split(self, name: str) -> tuple[str, int] | None:
        """Return the name without its suffix, and the index of the suffix in `suffixes`; else
        None."""
        for rank, suffix in enumerate(self.suffixes):
            if name.lower().endswith(suffix):
                return name[: -len(suffix)], rank
        return None

    @property
    def example(self) -> str:
        """Return example names for messages."""
        return f"names like 00{self.suffixes[0]} or 00{self.suffixes[1]}"


PICTURES = FileKind("pictures", (".jpg", ".jpeg", ".png"))
TABLES = FileKind("tables", (".pkl.gz", ".pkl", ".pickle.gz", ".pickle"))


@dataclass(frozen=True)
class NumberedFiles:
    """The files of one folder.

    Args:
        paths: paths by frame index, in order.
        digits: most digits of a name; 0 without files.
        notes: files that were left out.
    """

    paths: Mapping[int, Path]
    digits: int = 0
    notes: tuple[str, ...] = ()


def numbered_files(folder: Path, kind: FileKind) -> NumberedFiles:
    """Return the files of one kind in a folder, without hidden ones; none without the folder.

    Of two files with one index, that with the earlier suffix of the kind is used, with a note.

    Raises:
        InputError: a name is no index, two names differ in case or leading zeros only, the folder
            contains files that look like the kind under another name, or the path is no folder.
    """
    if not has_folder(folder):
        return NumberedFiles({})
    found: dict[int, list[tuple[int, Path]]] = {}
    misnamed: list[tuple[int, Path]] = []
    others: list[Path] = []
    digits = 0
    for path in visible_entries(folder):
        parts = kind.split(path.name)
        if parts is None:
            others.append(path)
        elif (number := _number(parts[0])) is None:
            misnamed.append((parts[1], path))
        else:
            found.setdefault(number, []).append((parts[1], path))
            digits = max(digits, len(parts[0]))
    # mask.png beside 00.jpg is no frame; first.jpg might be one.
    used = {rank for some in found.values() for rank, _ in some}
    wrong = [path for rank, path in misnamed if rank in used or not used]
    if wrong:
        raise _wrong_names(wrong, kind)
    paths: dict[int, Path] = {}
    for number, candidates in sorted(found.items()):
        candidates.sort()
        if len(candidates) > 1 and candidates[0][0] == candidates[1][0]:
            raise _wrong_names([path for _, path in candidates], kind)
        paths[number] = candidates[0][1]
    _check_others(folder, paths, others, kind)
    doubled = [[path for _, path in some] for some in found.values() if len(some) > 1]
    return NumberedFiles(paths, digits, _double_notes(folder, doubled))


def named(paths: Sequence[Path]) -> str:
    """Return the names of the first files, for messages."""
    names = ", ".join(path.name for path in paths[:_SHOWN])
    return names + (f" and {len(paths) - _SHOWN} more" if len(paths) > _SHOWN else "")


def looks_like_data(path: Path) -> bool:
    """Return whether a name may be that of a frame, not of a description or a list of times."""
    stem, _, suffix = path.name.partition(".")
    if _number(stem) is not None and suffix:
        return True
    return not path.name.lower().endswith((".json", *_NOT_DATA)) and not is_folder(path)


def _number(stem: str) -> int | None:
    is_number = stem.isascii() and stem.isdigit() and len(stem) <= _MAX_DIGITS
    return int(stem) if is_number else None


def _wrong_names(paths: list[Path], kind: FileKind) -> InputError:
    return InputError(
        "the file's name must be a unique frame number",
        where=paths[0],
        got=named(paths) if len(paths) > 1 else None,
        expected=kind.example,
        remedy="Rename or remove it." if len(paths) == 1 else "Rename or remove them.",
    )


def _check_others(
    folder: Path, paths: Mapping[int, Path], others: list[Path], kind: FileKind
) -> None:
    """Reject files that would be left out without another file in their place."""
    # Beside readable files, a file of another format matters only if no other file has its number.
    lost = [path for path in others if looks_like_data(path)]
    if paths:
        numbers = [(_number(path.name.partition(".")[0]), path) for path in lost]
        lost = [path for number, path in numbers if number is not None and number not in paths]
    inner = [] if paths else [p for p in others if is_folder(p) and _holds(p, kind)]
    if lost or inner:
        raise InputError(
            f"the folder of {kind.name} has files that are not read",
            where=folder,
            got=named(lost) if lost else f"the folder {named(inner)}",
            expected=f"{kind.example}, in this folder",
            remedy="Convert and rename the files, or remove them."
            if lost
            else "Move its files one folder up.",
        )


def _holds(folder: Path, kind: FileKind) -> bool:
    return any(kind.split(path.name) is not None for path in visible_entries(folder))


def _double_notes(folder: Path, doubled: list[list[Path]]) -> tuple[str, ...]:
    if not doubled:
        return ()
    first, second = doubled[0][:2]
    more = f" (and so for {len(doubled) - 1} more numbers)" if len(doubled) > 1 else ""
    return (f"{folder.name}: {first.name} is read, {second.name} beside it is not{more}",)
