"""Damage to bytes, text and JSON, all decided by one random generator."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_]{3,}")
NUMBER_WORDS = (
    "NaN", "Infinity", "-Infinity", "nan", "inf", ".nan", "1e999", "-1e999", "-1", "0", "-0.0", "1",
    "0.5", "1e308", "-1e300", "1e-320", "1e18", "2147483648", "9223372036854775808", "3e9",
    "9" * 400, "9" * 5000, "true", "false", "null", '"x"', '"1"', "[]", "{}", "[1, 2]", "", "~",
    "1e5", "-1e5", "1e6", "1e7", "65536", "0x10", "1_000", "٣",
)  # fmt: skip
"""What takes a number's place in a text."""
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, -0.0, 2**31, 2**63, -(2**63) - 1, 10**400, 1e18, 1e300,
    -1e300, 1e-320, 3e9, 1e5, 1e6, 1e7, float("nan"), float("inf"), float("-inf"), "", "x", "1",
    "nan", "\0", "a" * 10_000, "\ud800", "../../outside", "/dev/zero", "é\n\n\x1b[2J", [], {}, [[]],
    [None], [1, 2], [float("nan")] * 3, [0.0] * 3, [0.0] * 9, {"x": 1}, {"": None}, [[0.0] * 4] * 4,
    [1e300] * 3,
)  # fmt: skip
"""What takes an entry's place in a JSON document."""


def pick(rng: Rng, items: Any) -> Any:
    """One of a sequence."""
    return items[int(rng.integers(len(items)))]


def mutate_bytes(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """One to three damages; the words say which."""
    words: list[str] = []
    for _ in range(int(rng.integers(1, 4))):
        change = pick(rng, _BYTE_CHANGES)
        data = change(data, rng)
        words.append(change.__name__.strip("_"))
    return data, "bytes: " + ", ".join(words)


def _span(data: bytes, rng: Rng) -> tuple[int, int]:
    """A random block; headers, where most meaning lies, are chosen as often as all the rest."""
    reach = min(len(data), 512) if rng.random() < 0.5 else len(data)
    start = int(rng.integers(reach + 1))
    return start, min(len(data), start + int(2 ** rng.uniform(0, 12)))


def _flipped(data: bytes, rng: Rng) -> bytes:
    changed = bytearray(data)
    for _ in range(int(2 ** rng.uniform(0, 5))):
        start, _ = _span(data, rng)
        if start < len(changed):
            changed[start] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _overwritten(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + rng.bytes(end - start) + data[end:]


def _filled(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return (
        data[:start] + pick(rng, (b"\0", b"\xff", b"\x01", b"{", b" ")) * (end - start) + data[end:]
    )


def _extreme_integer(data: bytes, rng: Rng) -> bytes:
    start, _ = _span(data, rng)
    width = pick(rng, (2, 4, 8))
    value = pick(rng, (0, 1, 2**15, 2**16 - 1, 2**20, 2**30, 2**31 - 1, 2**32 - 1, 2**40, 2**63))
    order = pick(rng, ("little", "big"))
    piece = (value % 2 ** (8 * width)).to_bytes(width, order)
    return data[:start] + piece + data[start + width :]


def _truncated(data: bytes, rng: Rng) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _emptied(data: bytes, rng: Rng) -> bytes:
    return b""


def _appended(data: bytes, rng: Rng) -> bytes:
    return data + (rng.bytes(int(2 ** rng.uniform(0, 14))) if rng.random() < 0.5 else data)


def _removed(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _repeated(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * int(2 ** rng.uniform(0, 6)) + data[end:]


def _swapped(data: bytes, rng: Rng) -> bytes:
    (a, b), (c, d) = sorted((_span(data, rng), _span(data, rng)))
    b = min(b, c)
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


_BYTE_CHANGES: tuple[Callable[[bytes, Rng], bytes], ...] = (
    _flipped, _flipped, _overwritten, _filled, _extreme_integer, _extreme_integer, _truncated,
    _emptied, _appended, _removed, _repeated, _swapped,
)  # fmt: skip


def mutate_text(text: str, rng: Rng) -> tuple[str, str]:
    """Numbers replaced, lines moved, words changed, or bytes damaged."""
    if not text.strip():
        return "\0", "text: a zero byte in an empty file"
    way = int(rng.integers(5))
    if way <= 1:
        return _with_other_numbers(text, rng)
    if way == 2:
        lines = text.split("\n")
        i, j = (int(rng.integers(len(lines))) for _ in range(2))
        change = pick(rng, ("removed", "doubled", "swapped", "indented"))
        if change == "removed":
            del lines[i]
        elif change == "doubled":
            lines.insert(j, lines[i])
        elif change == "swapped":
            lines[i], lines[j] = lines[j], lines[i]
        else:
            lines[i] = pick(rng, ("  ", "\t", " " * 5000)) + lines[i]
        return "\n".join(lines), f"text: line {i} {change}"
    if way == 3:
        words = list(_WORD.finditer(text))
        if words:
            found = pick(rng, words)
            other = pick(rng, ("", "x", "x" * 9999, found[0].upper(), pick(rng, words)[0], "\0"))
            return text[: found.start()] + other + text[found.end() :], f"text: {found[0]} changed"
    data, words_ = mutate_bytes(text.encode(errors="surrogatepass"), rng)
    return data.decode("latin1"), words_


def _with_other_numbers(text: str, rng: Rng) -> tuple[str, str]:
    found = list(_NUMBER.finditer(text))
    if not found:
        return text + pick(rng, NUMBER_WORDS), "text: a number appended"
    word = pick(rng, NUMBER_WORDS)
    if rng.random() < 0.1:
        return _NUMBER.sub(word[:60], text), f"text: all numbers become {word[:60]!r}"
    hit = pick(rng, found)
    return (
        text[: hit.start()] + word + text[hit.end() :],
        f"text: {hit[0]} at {hit.start()} becomes {word[:60]!r}",
    )


def mutate_json(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """A JSON file with damaged structure, values or text."""
    way = rng.random()
    if way < 0.25:
        text, words = mutate_text(data.decode(), rng)
        return text.encode(errors="surrogatepass"), words
    if way < 0.3:
        opening, depth = pick(rng, (("[", 100_000), ('{"a":', 100_000), ("[", 900), ("[[],", 5000)))
        closing = {"[": "]", '{"a":': "}", "[[],": "]"}[opening]
        return (opening * depth + "1" + closing * depth).encode(), f"JSON: {depth} deep"
    value = json.loads(data)
    words_: list[str] = []
    for _ in range(int(rng.integers(1, 4))):
        value, word = mutate_tree(value, rng)
        words_.append(word)
    return json.dumps(value).encode(), "JSON: " + "; ".join(words_)


def mutate_tree(value: Any, rng: Rng) -> tuple[Any, str]:
    """A JSON value with one entry changed, and words for it."""
    if not isinstance(value, dict | list) or not value or rng.random() < 0.02:
        other = copy.deepcopy(pick(rng, VALUES))
        return other, f"the document becomes {other!r:.60}"
    path: list[Any] = []
    inner = value
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = pick(rng, keys)
        path.append(key)
        child = inner[key]
        if not isinstance(child, dict | list) or not child or rng.random() < 0.3:
            return value, _change_entry(inner, key, rng) + f" at {path!r:.120}"
        inner = child


def _change_entry(holder: Any, key: Any, rng: Rng) -> str:
    """Change holder[key] in place."""
    old = holder[key]
    ways = ["removed", "replaced", "replaced", "replaced", "wrapped", "copied"]
    ways += ["shortened", "lengthened", "emptied"] if isinstance(old, list) else []
    ways += ["scaled", "scaled"] if isinstance(old, int | float) and abs(old) < 1e250 else []
    way = pick(rng, ways)
    if way == "removed":
        del holder[key]
    elif way == "replaced":
        holder[key] = copy.deepcopy(pick(rng, VALUES))
        return f"replaced by {holder[key]!r:.60}"
    elif way == "wrapped":
        holder[key] = pick(rng, ([old], {"x": old}, str(old)[:2000]))
    elif way == "copied":
        if isinstance(holder, list):
            holder.insert(int(rng.integers(len(holder) + 1)), copy.deepcopy(old))
        else:
            holder[pick(rng, list(holder))] = copy.deepcopy(old)
    elif way == "shortened":
        del holder[key][int(rng.integers(len(holder[key]))) if old else 0 :]
    elif way == "lengthened":
        holder[key] *= 1 + int(2 ** rng.uniform(0, 6))
    elif way == "emptied":
        holder[key] = []
    else:
        factor = pick(rng, (-1, 0, 1e3, 1e-3, 1e6, 1e9, 1e30, 1e-30))
        holder[key] = old * factor
        return f"times {factor:g}"
    return way
