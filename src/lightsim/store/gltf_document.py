"""Container of glTF 2.0: .glb chunks or .gltf text, buffers, and files that it names.

Reference: Khronos glTF 2.0 specification (registry.khronos.org/glTF/specs/2.0).
"""

from __future__ import annotations

import base64
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from lightsim.store.beside import path_beside
from lightsim.store.gltf_extensions import MESHOPT, unsupported
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

GLB_MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_MAX_BYTES = 2 << 30
"""Of a file, and of all buffers together. A street of ten million vertices takes half of it; glTF
itself ends at 4 GiB."""
_DATA_URI = re.compile(rb'("uri"\s*:\s*)("(?i:data):[^"\\]*(?:\\.[^"\\]*)*")')
"""Those of buffers and pictures; other texts, such as names, may start with "data:" too."""


@dataclass(eq=False)
class GltfDocument:
    """JSON of a glTF file and the bytes that belong to it.

    Args:
        path: the .glb or .gltf file.
        json: its document. Data URIs in it are replaced by "data:" and their number in `embedded`.
        binary: the binary chunk of a .glb file; None without one.
        embedded: data URIs as they are in the file, with their quotation marks.
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
            raise ValueError(f"'{kind}' is no list")
        return items

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Return one entry of a top-level list; ValueError if there is no such entry."""
        items = self.items(kind)
        if not isinstance(index, int) or not 0 <= index < len(items):
            raise ValueError(f"{kind}[{index}] is named, and there are {len(items)}")
        if not isinstance(items[index], dict):
            raise ValueError(f"{kind}[{index}] is no object")
        return items[index]

    def view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride in bytes (0: tightly packed)."""
        view = self.item("bufferViews", index)
        number = view.get("buffer", 0)
        buffer = self.item("buffers", number)
        is_compressed = [name for name in MESHOPT if name in extensions(view)]
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
    """Read a .glb or .gltf file; its content decides which, not its name.

    Raises:
        InputError: the file cannot be opened.
        ValueError, LookupError, struct.error: it is not glTF 2.0, or is damaged.
    """
    data = memoryview(read_bytes(path, "model", _MAX_BYTES))
    text, binary = _chunks(data) if bytes(data[:4]) == GLB_MAGIC else (data, None)
    embedded: list[bytes] = []

    def replace(match: re.Match[bytes]) -> bytes:
        # Data may be larger than what is safe to parse as JSON.
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
        chunks.setdefault(kind, data[position + 8 : position + 8 + length])
        position += 8 + length
    if JSON_CHUNK not in chunks:
        raise ValueError("it has no JSON chunk")
    # Blanks fill the chunk by the standard; some exporters write zeros.
    text = chunks[JSON_CHUNK]
    return text[: len(bytes(text).rstrip(b"\0"))], chunks.get(BINARY_CHUNK)


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
        raise ValueError("its JSON is no glTF document")
    version = str(document["asset"].get("version"))
    if version != "2" and not version.startswith("2."):
        raise ValueError(f"it is glTF {version[:20]}, not glTF 2")
    return document


def extensions(item: dict[str, Any]) -> dict[str, Any]:
    """Return the extensions of an object of the document."""
    value = item.get("extensions", {})
    if not isinstance(value, dict):
        raise ValueError("extensions are no object")
    return value


def whole(value: object) -> int:
    """Return a count, offset or index; ValueError unless it is a whole number of 0 or more."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
        raise ValueError(f"{str(value)[:40]} where a whole number is expected")
    if not 0 <= value < 2**53:
        raise ValueError(f"{value} where a whole number of 0 or more is expected")
    return int(value)
