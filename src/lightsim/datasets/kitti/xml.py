"""Records of untrusted XML files, with bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np
from jaxtyping import Float64

from lightsim.datasets.files import MAX_NUMBER
from lightsim.errors import InputError
from lightsim.store.reading import open_regular

# Largest file, in bytes: KITTI-360 stores the meshes of all boxes of an hour.
_MAX_BYTES = 512 << 20
# Deepest nesting; both data sets have up to 6 levels.
_MAX_DEPTH = 16
# Most elements of one record: a track of 3000 poses has 50,000.
_MAX_ELEMENTS = 500_000
# Most characters of one record.
_MAX_CHARACTERS = 16 << 20
_REMEDY = "Copy the file again from the original data set."


def read_records(path: Path, depth: int, use: Callable[[Element], None]) -> None:
    """Call `use` with each element at a depth, such as 1 for the children of the root.

    Entities are rejected: they could expand to any size, or name other files.

    Raises:
        InputError: the file is no XML, too large or too deep, or declares entities.
    """
    collector = _Collector(path, depth, use)
    # Both data sets are UTF-8; a declared encoding, which may be any codec of Python, is ignored.
    parser = expat.ParserCreate("UTF-8")
    parser.buffer_text = True
    parser.StartElementHandler = collector.start
    parser.EndElementHandler = collector.end
    parser.CharacterDataHandler = collector.characters
    parser.EntityDeclHandler = collector.entity
    try:
        with open_regular(path, "XML file", _MAX_BYTES) as handle:
            parser.ParseFile(handle)
    except (expat.ExpatError, ValueError) as error:
        raise InputError(
            "the file is not valid XML", where=path, got=f"{error}"[:200], remedy=_REMEDY
        ) from error


class _Collector:
    """Builds the elements of one record at a time."""

    def __init__(self, path: Path, depth: int, use: Callable[[Element], None]) -> None:
        self._path, self._depth, self._use = path, depth, use
        self._level = 0
        self._stack: list[Element] = []
        self._text: list[str] = []
        self._elements = self._characters = 0

    def start(self, name: str, _: dict[str, str]) -> None:
        self._level += 1
        if self._level > _MAX_DEPTH:
            raise self._refused("elements are nested too deeply")
        if self._level <= self._depth:
            return
        if not self._stack:
            self._elements = self._characters = 0
        self._elements += 1
        if self._elements > _MAX_ELEMENTS:
            raise self._refused("a record has too many elements")
        element = Element(name)
        if self._stack:
            self._stack[-1].append(element)
        self._stack.append(element)
        self._text = []

    def end(self, _: str) -> None:
        self._level -= 1
        if not self._stack:
            return
        element = self._stack.pop()
        # Text between child elements is white space.
        element.text = "".join(self._text) if not len(element) else None
        self._text = []
        if not self._stack:
            self._use(element)

    def characters(self, text: str) -> None:
        if self._stack:
            self._characters += len(text)
            if self._characters > _MAX_CHARACTERS:
                raise self._refused("a record has too much text")
            self._text.append(text)

    def entity(self, *_: object) -> None:
        raise self._refused("the file declares entities")

    def _refused(self, what: str) -> InputError:
        return InputError(what, where=self._path, remedy=_REMEDY)


def text_of(element: Element, name: str, where: object) -> str:
    """Return the text of a child element, without white space at both ends.

    Raises:
        InputError: there is no such child, or it has no text.
    """
    child = element.find(name)
    text = "" if child is None or child.text is None else child.text.strip()
    if not text:
        raise InputError(
            f"the element <{element.tag[:40]}> has no <{name}>", where=where, remedy=_REMEDY
        )
    return text


def numbers_of(element: Element, name: str, where: object) -> Float64[np.ndarray, " n"]:
    """Return the finite numbers of a child element.

    Raises:
        InputError: there is no such child, or a word is not a finite number.
    """
    words = text_of(element, name, where).split()
    try:
        numbers = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        numbers = np.array([np.nan])
    if not (np.abs(numbers) <= MAX_NUMBER).all():
        raise InputError(
            f"<{name}> is not a finite number",
            where=where,
            got=" ".join(words)[:60],
            remedy=_REMEDY,
        )
    return numbers


def number_of(element: Element, name: str, where: object) -> float:
    """Return the finite number of a child element.

    Raises:
        InputError: there is no such child, or it is not one finite number.
    """
    numbers = numbers_of(element, name, where)
    if len(numbers) != 1:
        raise InputError(
            f"<{name}> is not one number",
            where=where,
            got=f"{len(numbers)} numbers",
            remedy=_REMEDY,
        )
    return float(numbers[0])
