"""Container of glTF 2.0: .glb chunks or .gltf text, buffers, and external files.

Reference: Khronos glTF 2.0 specification (registry.khronos.org/glTF/specs/2.0).
"""

from __future__ import annotations

import base64
import json
import re
import struct
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from lightsim.store.beside import path_beside
from lightsim.store.gltf_extensions import MESHOPT, unsupported
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

GLB_MAGIC = b"glTF"
# Largest size of a file, and of all its buffers together, in bytes. A street of ten million
# vertices takes half of it; binary glTF cannot exceed 4 GiB.
_MAX_BYTES = 2 << 30
# Data URIs of buffers and pictures; other texts, such as names, may start with "data:" too.
_DATA_URI = re.compile(rb'("uri"\s*:\s*)("(?i:data):[^"\\]*(?:\\.[^"\\]*)*")')


class GltfCode(IntEnum):
    """Numbers of the glTF 2.0 specification (sections 3.6, 3.7, 3.8.4 and 4.4)."""

    TRIANGLES = 4
    TRIANGLE_STRIP = 5
    UNSIGNED_INT = 5125
    FLOAT = 5126
    NEAREST = 9728
    LINEAR = 9729
    REPEAT = 10497
    CLAMP_TO_EDGE = 33071
    MIRRORED_REPEAT = 33648
    ARRAY_BUFFER = 34962
    ELEMENT_ARRAY_BUFFER = 34963
    JSON_CHUNK = 0x4E4F534A
    BINARY_CHUNK = 0x004E4942


@dataclass(eq=False)
class GltfDocument:
    """JSON of a glTF file and its binary data.

    Args:
        path: the .glb or .gltf file.
        json: the JSON document. Data URIs are replaced by "data:" and their index in `embedded`.
        binary: the binary chunk of a .glb file; None without one.
        embedded: data URIs as written in the file, with quotation marks.
    """

    path: Path
    json: dict[str, Any]
    binary: memoryview | None
    embedded: list[bytes]
    _buffers: dict[int, memoryview] = field(default_factory=dict)
    _loaded_bytes: int = 0

    def items(self, kind: str) -> list[Any]:
        """Return the top-level list `kind`, such as "meshes"; empty if the file has none."""
        items = self.json.get(kind, [])
        if not isinstance(items, list):
            raise ValueError(f"'{kind}' is not a list")
        return items

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Return one entry of a top-level list; ValueError if it does not exist."""
        items = self.items(kind)
        if not isinstance(index, int) or not 0 <= index < len(items):
            raise ValueError(f"{kind}[{index}] is named, and there are {len(items)}")
        if not isinstance(items[index], dict):
            raise ValueError(f"{kind}[{index}] is not an object")
        return items[index]

    def view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride in bytes (0: tightly packed)."""
        view = self.item("bufferViews", index)
        number = view.get("buffer", 0)
        buffer = self.item("buffers", number)
        is_compressed = [name for name in MESHOPT if name in extensions(view)]
        # A compressed view may have a fallback buffer with uncompressed data.
        if is_compressed and "uri" not in buffer and not self._is_chunk(number):
            raise unsupported(self.path, is_compressed[0])
        data = self._buffer(number)
        start, length = whole(view.get("byteOffset", 0)), whole(view["byteLength"])
        if start + length > len(data):
            raise ValueError(f"bufferViews[{index}] runs past the end of its buffer")
        return data[start : start + length], whole(view.get("byteStride", 0))

    def resource(self, uri: object, kind: str) -> bytes:
        """Return the bytes of a data URI or of a file beside the model.

        Raises:
            InputError: the file is missing, too large, or named by a URL.
        """
        if not isinstance(uri, str):
            raise ValueError(f"a {kind} has neither data nor the name of a file")
        if uri.startswith("data:"):
            return self._embedded(uri)
        data = read_bytes(path_beside(self.path, uri, kind), kind, _MAX_BYTES)
        self._count(len(data))
        return data

    def _is_chunk(self, number: int) -> bool:
        return number == 0 and self.binary is not None and "uri" not in self.item("buffers", 0)

    def _buffer(self, number: int) -> memoryview:
        if number not in self._buffers:
            buffer = self.item("buffers", number)
            if self._is_chunk(number):
                assert self.binary is not None
                self._buffers[number] = self.binary
            elif "uri" not in buffer:
                raise ValueError(f"buffers[{number}] has no data")
            else:
                self._buffers[number] = memoryview(self.resource(buffer["uri"], "buffer"))
        return self._buffers[number]

    def _embedded(self, uri: str) -> bytes:
        text = json.loads(self.embedded[int(uri.removeprefix("data:"))])
        head, _, body = text.partition(",")
        data = unquote_to_bytes(body) if "%" in body else body.encode()
        if head.lower().endswith(";base64"):
            data = base64.b64decode(data + b"=" * (-len(data) % 4))
        self._count(len(data))
        return data

    def _count(self, n_bytes: int) -> None:
        self._loaded_bytes += n_bytes
        if self._loaded_bytes > _MAX_BYTES:
            raise ValueError(f"its buffers and pictures have more than {_MAX_BYTES} bytes")


def read_document(path: Path) -> GltfDocument:
    """Read a .glb or .gltf file; the content decides the kind, not the name.

    Raises:
        InputError: the file cannot be opened.
        ValueError, LookupError, struct.error: it is not glTF 2.0, or is damaged.
    """
    data = memoryview(read_bytes(path, "model", _MAX_BYTES))
    text, binary = _chunks(data) if bytes(data[:4]) == GLB_MAGIC else (data, None)
    embedded: list[bytes] = []

    def replace(match: re.Match[bytes]) -> bytes:
        # Embedded data may be larger than the limit of the JSON parser (`MAX_JSON_BYTES`).
        embedded.append(match[2])
        return match[1] + b'"data:%d"' % (len(embedded) - 1)

    return GltfDocument(path, _parsed(_DATA_URI.sub(replace, bytes(text))), binary, embedded)


def _chunks(data: memoryview) -> tuple[memoryview, memoryview | None]:
    _, version, total = struct.unpack_from("<4sII", data)
    if version != 2:
        raise ValueError(f"it is a binary file of glTF {version}, not glTF 2")
    if total > len(data):
        raise ValueError(f"it is truncated: {len(data)} of {total} bytes")
    chunks: dict[int, memoryview] = {}
    position = 12
    while position + 8 <= total:
        length, kind = struct.unpack_from("<II", data, position)
        if position + 8 + length > total:
            raise ValueError("a chunk runs past the end")
        # The first chunk of each type is used; unknown types are ignored (section 4.4.3).
        chunks.setdefault(kind, data[position + 8 : position + 8 + length])
        position += 8 + length
    if GltfCode.JSON_CHUNK not in chunks:
        raise ValueError("it has no JSON chunk")
    # The standard pads the chunk with blanks; some exporters pad it with zeros.
    text = chunks[GltfCode.JSON_CHUNK]
    return text[: len(bytes(text).rstrip(b"\0"))], chunks.get(GltfCode.BINARY_CHUNK)


def _parsed(text: bytes) -> dict[str, Any]:
    if len(text) > MAX_JSON_BYTES:
        raise ValueError(f"its JSON has {len(text)} bytes, more than {MAX_JSON_BYTES}")
    try:
        document = json.loads(text.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError("it is neither glTF binary nor JSON") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"it is neither glTF binary nor JSON ({error})") from error
    except RecursionError as error:
        raise ValueError("its JSON is nested too deep") from error
    if not isinstance(document, dict) or "asset" not in document:
        raise ValueError("its JSON is not a glTF document")
    version = str(document["asset"].get("version"))
    if version != "2" and not version.startswith("2."):
        raise ValueError(f"it is glTF {version[:20]}, not glTF 2")
    return document


def extensions(item: dict[str, Any]) -> dict[str, Any]:
    """Return the extensions of an object of the document, by name."""
    value = item.get("extensions", {})
    if not isinstance(value, dict):
        raise ValueError("the extensions are not an object")
    return value


def whole(value: object) -> int:
    """Return a count, offset or index; ValueError if it is not a whole number of 0 or more."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
        raise ValueError(f"{str(value)[:40]} where a whole number is expected")
    # JSON numbers of 2**53 or more may be rounded floats.
    if not 0 <= value < 2**53:
        raise ValueError(f"{value} where a whole number of 0 or more is expected")
    return int(value)
