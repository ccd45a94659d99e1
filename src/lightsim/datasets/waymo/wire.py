"""Records of a TFRecord file, and the wire format of protocol buffers in them.

Formats: tensorflow.org/tutorials/load_data/tfrecord and protobuf.dev/programming-guides/encoding.
Only keys and lengths are read until a field is used, so that a file of a gigabyte is indexed
in seconds.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from lightsim.datasets.files import require_number
from lightsim.errors import InputError
from lightsim.store.reading import open_regular

_MAX_FILE_BYTES = 16 << 30
"""Largest file: segments of 20 s have up to 1.2 GB."""
_MAX_RECORDS = 10_000
"""Most records of a file: segments have 200 frames."""
_MAX_FIELDS = 8_000_000
"""Most fields that are read of one file, against files of nothing but keys: segments have 1.5
million."""
_MAX_MESSAGE_FIELDS = 200_000
"""Most fields of one message: the first frame has some thousand features of the map."""
_MAX_VALUES = 4096
"""Most numbers of a list such as a matrix or the inclinations of beams."""
_HEAD_BYTES = 30
"""Bytes that hold the longest key, and the longest number or length."""
# Wire type of a number of variable length (protobuf.dev, "Encoding").
_VARINT = 0
# Wire type of 8 bytes.
_FIXED64 = 1
# Wire type of bytes with a length.
_LENGTH = 2
# Wire type of 4 bytes.
_FIXED32 = 5
# Added to the rotated checksum of a TFRecord (TensorFlow, tfrecord format).
_CRC_MASK = 0xA282EAD8
_BROKEN = "Copy the file again from the original data set."


class Span(NamedTuple):
    """Bytes of a file, from `start` up to `end`."""

    start: int
    end: int


_Value = int | float | Span


def broken(where: object, got: object, expected: object = None) -> InputError:
    """Return the error for a file that is not what its format demands."""
    return InputError(
        "the file is damaged or of another kind",
        where=where,
        got=got,
        expected=expected,
        remedy=_BROKEN,
    )


class Wire:
    """Reader of messages in an open file.

    Args:
        where: file, for messages.
    """

    def __init__(self, handle: BinaryIO | io.BytesIO, where: object) -> None:
        self.where = where
        self._handle = handle
        self._left = _MAX_FIELDS

    def records(self) -> Iterator[Span]:
        """Yield the data of every record of a TFRecord file.

        The checksum of each length is verified; that of the data is not, which would take minutes.
        """
        size = os.fstat(self._handle.fileno()).st_size
        position = 0
        for number in range(_MAX_RECORDS):
            if position == size:
                return
            where = f"{self.where}, record {number}"
            length = record_length(self.read(Span(position, min(size, position + 12))))
            start = position + 12
            if length is None or start + length + 4 > size:
                got = "no record" if length is None else f"{length} bytes of {size - start}"
                raise broken(where, got, "a whole record of a TFRecord file")
            yield Span(start, start + length)
            position = start + length + 4
        raise broken(self.where, f"more than {_MAX_RECORDS} records", "one drive")

    def read(self, span: Span, most: int = 1 << 16) -> bytes:
        """Return the bytes of a span."""
        length = span.end - span.start
        if length > most:
            raise broken(self.where, f"a field of {length} bytes", f"at most {most} bytes")
        self._handle.seek(span.start)
        return self._handle.read(length)

    def message(self, span: Span, name: str) -> Message:
        """Return the fields of a message; nested messages stay spans."""
        where = f"{self.where}, {name}"
        fields: dict[int, list[_Value]] = {}
        position = span.start
        most = min(self._left, _MAX_MESSAGE_FIELDS)
        for _ in range(most + 1):
            if position >= span.end:
                break
            self._left -= 1
            head = self.read(Span(position, min(span.end, position + _HEAD_BYTES)))
            try:
                number, value, position = _field(head, position)
            except (IndexError, ValueError, struct.error) as error:
                raise broken(where, error, "a protocol buffer") from error
            fields.setdefault(number, []).append(value)
        if position != span.end:
            got = "a field beyond the end" if position > span.end else f"more than {most} fields"
            raise broken(where, got, "a whole message")
        return Message(self, name, fields)


class Message:
    """Fields of one message, by number. Absent fields have the format's defaults: 0 and empty."""

    def __init__(self, wire: Wire, name: str, fields: dict[int, list[_Value]]) -> None:
        self.where = f"{wire.where}, {name}"
        self._name = name
        self._wire = wire
        self._fields = fields

    def spans(self, number: int) -> list[Span]:
        """Return the spans of a field of messages, text or bytes."""
        values = self._fields.get(number, [])
        spans = [value for value in values if isinstance(value, Span)]
        if len(spans) != len(values):
            raise broken(f"{self.where}, field {number}", "a number", "bytes or a message")
        return spans

    def messages(self, number: int, name: str) -> Iterator[Message]:
        """Yield the messages of a repeated field."""
        for i, span in enumerate(self.spans(number)):
            yield self._wire.message(span, f"{self._name}, {name} {i}")

    def message(self, number: int, name: str) -> Message:
        """Return the message of a field; one without fields if it is absent."""
        spans = self.spans(number)
        return self._wire.message(spans[-1] if spans else Span(0, 0), f"{self._name}, {name}")

    def text(self, number: int) -> str:
        """Return a text of at most 512 bytes."""
        spans = self.spans(number)
        data = self._wire.read(spans[-1], 512) if spans else b""
        text = data.decode("utf-8", errors="replace")
        if not text.isprintable():
            raise broken(f"{self.where}, field {number}", repr(text)[:60], "printable text")
        return text

    def whole(self, number: int) -> int:
        """Return an integer."""
        value = self._fields.get(number, [0])[-1]
        if not isinstance(value, int):
            raise broken(f"{self.where}, field {number}", "no integer", "an integer")
        return value

    def wholes(self, number: int) -> list[int]:
        """Return the integers of a repeated field, packed or not."""
        found: list[int] = []
        for value in self._fields.get(number, []):
            if isinstance(value, Span):
                data, at = self._wire.read(value, _MAX_VALUES) + b"\0" * 10, 0
                while at < len(data) - 10:
                    whole, at = _varint(data, at)
                    found.append(whole)
            elif isinstance(value, int):
                found.append(value)
        return found

    def number(self, number: int) -> float:
        """Return a finite float."""
        value = self._fields.get(number, [0.0])[-1]
        return require_number(value, f"{self.where}, field {number}")

    def numbers(self, number: int) -> list[float]:
        """Return the finite doubles of a repeated field, packed or not."""
        found: list[float] = []
        for value in self._fields.get(number, []):
            if isinstance(value, Span):
                data = self._wire.read(value, 8 * _MAX_VALUES)
                found += np.frombuffer(data[: len(data) // 8 * 8], "<f8").tolist()
            else:
                found.append(value)
            if len(found) > _MAX_VALUES:
                raise broken(f"{self.where}, field {number}", f"more than {_MAX_VALUES} numbers")
        return [require_number(value, f"{self.where}, field {number}") for value in found]


def record_length(header: bytes) -> int | None:
    """Return the length in the 12 bytes before a record; None if the checksum is wrong."""
    if len(header) < 12:
        return None
    length, checksum = struct.unpack("<QI", header)
    crc = crc32c(header[:8])
    # Rotated and shifted, so that checksums of data with checksums differ from plain ones.
    masked = ((crc >> 15 | crc << 17) + _CRC_MASK) & 0xFFFFFFFF
    return length if masked == checksum else None


def crc32c(data: bytes) -> int:
    """Return the CRC-32C (RFC 3720, appendix B.4) of a few bytes."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def is_tfrecord(path: Path) -> bool:
    """Return whether a file is a TFRecord file by its name and first bytes."""
    if path.suffix != ".tfrecord":
        return False
    try:
        with open_tfrecord(path) as handle:
            return record_length(handle.read(12)) is not None
    except InputError:
        return False


def open_tfrecord(path: Path) -> AbstractContextManager[BinaryIO]:
    """Open a TFRecord file.

    Raises:
        InputError: it cannot be opened.
    """
    return open_regular(path, "TFRecord file", _MAX_FILE_BYTES)


def _field(head: bytes, position: int) -> tuple[int, _Value, int]:
    """Return number and value of the field at the start of `head`, and the position after it."""
    key, at = _varint(head, 0)
    kind = key & 7
    if kind == _VARINT:
        value, at = _varint(head, at)
        # Negative integers are stored as their 64-bit complement.
        return key >> 3, value - (1 << 64) if value >> 63 else value, position + at
    if kind == _FIXED64:
        return key >> 3, struct.unpack_from("<d", head, at)[0], position + at + 8
    if kind == _FIXED32:
        return key >> 3, struct.unpack_from("<f", head, at)[0], position + at + 4
    if kind == _LENGTH:
        length, at = _varint(head, at)
        return key >> 3, Span(position + at, position + at + length), position + at + length
    raise ValueError(f"a field of kind {kind}")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value & 0xFFFFFFFFFFFFFFFF, at
    raise ValueError("a number of more than 10 bytes")
