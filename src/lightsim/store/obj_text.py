"""Parser of OBJ text to arrays: positions, texture coordinates and corners of faces.

Reference: Wavefront Advanced Visualizer, Appendix B1, Object Files (.obj), version 3.0.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from lightsim.store.primitives import FARTHEST

# Largest number of lines; models in the largest file that is read, 512 MiB, have 20 million.
_MAX_LINES = 40_000_000
# Largest length of a line, in bytes: a face of two million corners; faces of models have fewer than
# a thousand.
_MAX_LINE_BYTES = 16 << 20
# Size of the text that is parsed at once, in bytes; it needs about 40 times as much memory.
_BLOCK_BYTES = 32 << 20
# ASCII codes of characters that the parser searches for.
_NEWLINE, _SPACE, _SLASH, _HASH = b"\n /#"
# Whether each byte is a blank.
_BLANK = np.zeros(256, bool)
_BLANK[list(b" \t\n\r\v\f")] = True
# Byte order marks of UTF-16.
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Start of a comment behind a name.
_COMMENT = re.compile(r"(?<=[^ \t])[ \t]+#")
# Statements of names and groups, which do not change surfaces.
_SILENT = frozenset((b"o", b"g", b"mg"))


class _Kind(IntEnum):
    """Kind of statement of a line."""

    NOTHING = 0
    POSITION = 1
    UV = 2
    NORMAL = 3
    FACE = 4
    OTHER = 5


# Length of the keywords `v`, `vt` and `f`, in bytes.
_KEYWORD_BYTES = {_Kind.POSITION: 1, _Kind.UV: 2, _Kind.FACE: 1}


@dataclass(eq=False)
class ObjText:
    """Content of an OBJ file as arrays.

    Args:
        positions: x, y, z of each `v`, in units of the file.
        colours: r, g, b of each `v` as written; NaN if it has no colour.
        uv: texture coordinates of each `vt`, (0, 0) at the picture's bottom left.
        corners: 0-based indices of position, uv and normal of each face's corners, face after face;
            -1 if a corner has no uv or normal.
        corner_counts: number of corners of each face.
        face_lines: 0-based line of each face.
        materials: (line, name) of each `usemtl`, in order.
        smoothing: (line, group) of each `s`, in order; 0 is off.
        libraries: words after each `mtllib`.
        unread: number of lines of each other keyword.
    """

    positions: Float64[np.ndarray, "n 3"]
    colours: Float64[np.ndarray, "n 3"]
    uv: Float64[np.ndarray, "t 2"]
    corners: Int64[np.ndarray, "c 3"]
    corner_counts: Int64[np.ndarray, " f"]
    face_lines: Int64[np.ndarray, " f"]
    materials: list[tuple[int, str]] = field(default_factory=list)
    smoothing: list[tuple[int, int]] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    unread: Counter[str] = field(default_factory=Counter)


def parse_obj(data: bytes) -> ObjText:
    """Parse the text of an OBJ file.

    Raises:
        ValueError: a number is invalid or out of range, a face refers to a missing vertex, or the
            text has too many or too long lines.
    """
    lines = _Lines(_plain(data))
    blocks = [_parse_block(lines, first, last) for first, last in lines.blocks()]
    lines_of = {kind: np.flatnonzero(lines.kinds == kind) for kind in _Kind}
    positions = np.concatenate([block.positions for block in blocks])
    n_normals = len(lines_of[_Kind.NORMAL])
    uv = np.concatenate([block.uv for block in blocks])
    counts = np.concatenate([block.corner_counts for block in blocks])
    faces = lines_of[_Kind.FACE]
    # Negative indices count back from the face: number of statements of each kind above it.
    before = [np.searchsorted(lines_of[k], faces) for k in (_Kind.POSITION, _Kind.UV, _Kind.NORMAL)]
    corners = _absolute(
        np.concatenate([block.corners for block in blocks]),
        np.repeat(np.stack(before, axis=1), counts, axis=0),
        (len(positions), len(uv), n_normals),
        np.repeat(faces, counts),
    )
    text = ObjText(positions[:, :3], positions[:, 3:], uv, corners, counts, faces)
    _read_other(text, lines, lines_of[_Kind.OTHER])
    return text


def decode(name: bytes) -> str:
    """Decode a name of unknown encoding; equal bytes give equal names."""
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


def as_utf8(data: bytes) -> bytes:
    """Remove the byte order mark, and convert UTF-16 (of Windows editors) to UTF-8."""
    if data.startswith(_UTF16_MARKS):
        return data.decode("utf-16", "replace").encode("utf-8")
    return data.removeprefix(b"\xef\xbb\xbf")


def without_comment(words: str) -> str:
    """Return a name without a trailing comment; ` #` may also belong to the name."""
    return _COMMENT.split(words, maxsplit=1)[0]


def _plain(data: bytes) -> bytes:
    """Normalise a text: one statement per line, no leading blanks, LF as line end."""
    data = as_utf8(data)
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in data:
        data = data.replace(b"\\\n", b"  ")
    if re.search(rb"^[ \t]", data, re.MULTILINE):
        data = re.sub(rb"^[ \t]+", b"", data, flags=re.MULTILINE)
    return data if data.endswith(b"\n") else data + b"\n"


class _Lines:
    """Start, length and kind of each line of a text, found by array operations."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.codes = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(self.codes == _NEWLINE)
        if len(ends) > _MAX_LINES:
            raise ValueError(f"it has {len(ends)} lines, more than {_MAX_LINES}")
        self.starts = np.concatenate([[0], ends[:-1] + 1])
        self.lengths = ends + 1 - self.starts
        if self.lengths.max() > _MAX_LINE_BYTES:
            raise ValueError(f"line {self.lengths.argmax() + 1} has {self.lengths.max()} bytes")
        self.kinds = self._kinds()

    def _kinds(self) -> UInt8[np.ndarray, " l"]:
        last = len(self.codes) - 1
        first, second, third = (self.codes[np.minimum(self.starts + n, last)] for n in range(3))
        kinds = np.full(len(self.starts), _Kind.OTHER, np.uint8)
        is_short, is_pair = _BLANK[second], _BLANK[third]
        kinds[_BLANK[first] | (first == _HASH)] = _Kind.NOTHING
        # Keywords may be capitals: bit 5 distinguishes upper from lower case in ASCII.
        first, second = first | np.uint8(0x20), second | np.uint8(0x20)
        kinds[(first == ord("v")) & is_short] = _Kind.POSITION
        kinds[(first == ord("v")) & (second == ord("t")) & is_pair] = _Kind.UV
        kinds[(first == ord("v")) & (second == ord("n")) & is_pair] = _Kind.NORMAL
        kinds[(first == ord("f")) & is_short] = _Kind.FACE
        return kinds

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Yield ranges (first, last + 1) of lines of bounded size."""
        block = self.starts // _BLOCK_BYTES
        edges = np.flatnonzero(np.diff(block)) + 1
        yield from zip([0, *edges.tolist()], [*edges.tolist(), len(block)], strict=True)

    def text(self, kind: _Kind, first: int, last: int) -> tuple[bytes, Int64[np.ndarray, " k"]]:
        """Return the lines of one kind within a block, without keywords, and their numbers."""
        lengths = self.lengths[first:last]
        is_kind = self.kinds[first:last] == kind
        start = int(self.starts[first])
        codes = self.codes[start : start + int(lengths.sum())][np.repeat(is_kind, lengths)]
        starts = np.cumsum(lengths[is_kind]) - lengths[is_kind]
        for n in range(_KEYWORD_BYTES[kind]):
            codes[starts + n] = _SPACE
        text = codes.tobytes()
        if b"#" in text:
            text = re.sub(rb"#[^\n]*", b"", text)
        return text, first + np.flatnonzero(is_kind)


@dataclass(frozen=True, eq=False)
class _Block:
    positions: Float64[np.ndarray, "n 6"]
    uv: Float64[np.ndarray, "t 2"]
    corners: Int64[np.ndarray, "c 3"]
    corner_counts: Int64[np.ndarray, " f"]


def _parse_block(lines: _Lines, first: int, last: int) -> _Block:
    text, numbers = lines.text(_Kind.POSITION, first, last)
    positions = _table(text, numbers, (3, 3, 7))
    text, numbers = lines.text(_Kind.UV, first, last)
    uv = _table(text, numbers, (1, 2, 3))[:, :2]
    text, numbers = lines.text(_Kind.FACE, first, last)
    corners, counts = _corners(text, numbers)
    return _Block(positions[:, :6], np.nan_to_num(uv, nan=0.0), corners, counts)


def _table(
    text: bytes, lines: Int64[np.ndarray, " n"], columns: tuple[int, int, int]
) -> Float64[np.ndarray, "n c"]:
    """Return the numbers of each line as a table, NaN where a line has fewer.

    Args:
        columns: least count of numbers, count of numbers of a line without colour, and width of the
            table. A fourth coordinate (the weight w) without a colour after it is ignored.
    """
    least, plain, width = columns
    counts = _words_per_line(text, len(lines))
    if len(counts) and counts.min() < least:
        n = int(counts.argmin())
        raise ValueError(f"line {lines[n] + 1} has {counts[n]} numbers instead of {least}")
    values = _parsed(text, lines, float)
    if not (np.abs(values) <= FARTHEST).all():
        line = lines[np.repeat(np.arange(len(lines)), counts)[~(np.abs(values) <= FARTHEST)][0]]
        raise ValueError(f"line {line + 1} has a number that is not finite or beyond {FARTHEST:g}")
    table = np.full((len(lines), width), np.nan)
    start = np.cumsum(counts) - counts
    for count in np.unique(counts):
        rows = np.flatnonzero(counts == count)
        n = int(count) if count <= plain or count >= 6 else plain
        n = min(n, width)
        table[rows, :n] = values[start[rows, None] + np.arange(n)]
    return table


def _corners(
    text: bytes, lines: Int64[np.ndarray, " f"]
) -> tuple[Int64[np.ndarray, "c 3"], Int64[np.ndarray, " f"]]:
    """Return the indices of each corner as written (0: none), and each face's number of corners."""
    codes = np.frombuffer(text, np.uint8)
    is_slash = codes == _SLASH
    is_start = _word_starts(codes)
    n_corners = int(is_start.sum())
    # The first byte of each number: it follows a blank or a slash.
    is_number = ~_BLANK[codes] & ~is_slash
    is_number[1:] &= ~is_number[:-1]
    at = np.flatnonzero(is_number)
    corner = np.cumsum(is_start, dtype=np.int32)[at] - 1
    slashes = np.cumsum(is_slash, dtype=np.int32)
    # The number of slashes since the corner's start: 0 is the position, 1 uv, 2 the normal.
    slot = slashes[at] - (slashes - is_slash)[np.flatnonzero(is_start)][corner]
    counts = _words_per_line(text, len(lines))
    if len(slot) and slot.max() > 2:
        n = np.repeat(lines, counts)[corner[slot.argmax()]]
        raise ValueError(f"line {n + 1} has a corner of more than three numbers")
    corners = np.zeros((n_corners, 3), np.int64)
    corners[corner, slot] = _parsed(text.replace(b"/", b" "), lines, int)
    if not corners[:, 0].all():
        n = np.repeat(lines, counts)[int((corners[:, 0] == 0).argmax())]
        raise ValueError(f"line {n + 1} has a corner without a vertex; they count from 1")
    return corners, counts


def _absolute(
    corners: Int64[np.ndarray, "c 3"],
    before: Int64[np.ndarray, "c 3"],
    sizes: tuple[int, int, int],
    lines: Int64[np.ndarray, " c"],
) -> Int64[np.ndarray, "c 3"]:
    """Return 0-based indices from the written ones; negative indices count back from the face.

    Args:
        before: number of positions, uv and normals above the face of each corner.
        sizes: number of positions, uv and normals of the file.
        lines: line of each corner.
    """
    found = np.where(corners < 0, before + corners, corners - 1)
    is_there = (found >= 0) & (found < np.array(sizes))
    if not is_there[:, 0].all():
        n = int(is_there[:, 0].argmin())
        raise ValueError(f"line {lines[n] + 1} names vertex {corners[n, 0]} of {sizes[0]}")
    return np.where(is_there, found, -1)


def _word_starts(codes: UInt8[np.ndarray, " b"]) -> Bool[np.ndarray, " b"]:
    is_word = ~_BLANK[codes]
    is_start = is_word.copy()
    is_start[1:] &= ~is_word[:-1]
    return is_start


def _words_per_line(text: bytes, n_lines: int) -> Int64[np.ndarray, " l"]:
    codes = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(codes == _NEWLINE)
    line = np.searchsorted(ends, np.flatnonzero(_word_starts(codes)))
    return np.bincount(line, minlength=n_lines).astype(np.int64)


def _parsed(
    text: bytes, lines: Int64[np.ndarray, " l"], kind: type[int] | type[float]
) -> Int64[np.ndarray, " n"] | Float64[np.ndarray, " n"]:
    """Return all numbers of a text; the error names the first line with another word."""
    dtype = np.int64 if kind is int else np.float64
    words = text.split()
    try:
        return np.fromiter(map(kind, words), dtype, len(words))
    except (ValueError, OverflowError):
        # Parse again line by line, only to find the line of the error.
        for line, row in zip(lines, text.split(b"\n"), strict=False):
            try:
                np.fromiter(map(kind, row.split()), dtype)
            except (ValueError, OverflowError):
                shown = decode(row.strip()[:60])
                raise ValueError(f"line {line + 1} has no numbers: {shown!r}") from None
        raise


def _read_other(text: ObjText, lines: _Lines, numbers: Int64[np.ndarray, " k"]) -> None:
    """Read the statements that are not vertices and faces into `text`."""
    for n in numbers.tolist():
        start = int(lines.starts[n])
        words = lines.data[start : start + int(lines.lengths[n])].split(None, 1)
        keyword, rest = words[0].lower(), words[1].strip() if len(words) > 1 else b""
        if keyword == b"usemtl":
            text.materials.append((n, decode(rest)))
        elif keyword == b"s":
            text.smoothing.append((n, int(rest) if rest.isdigit() and len(rest) < 10 else 0))
        elif keyword == b"mtllib":
            text.libraries.append(decode(rest))
        elif keyword not in _SILENT:
            text.unread[decode(keyword[:20])] += 1
