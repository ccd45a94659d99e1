"""Damaged files of ours: .npz arrays, .glb meshes, safetensors and checkpoints."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from .mutations import Rng, mutate_bytes, mutate_tree, pick


def mutate_npz(path: Path, rng: Rng) -> str:
    """Arrays changed and written again, a member damaged, or bytes."""
    way = rng.random()
    if way < 0.3:
        data, words = mutate_bytes(path.read_bytes(), rng)
        path.write_bytes(data)
        return f"{path.name}: {words}"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = pick(rng, sorted(members))
    if way < 0.4:
        members[name], words = mutate_bytes(members[name], rng)
    elif way < 0.5:
        members[name], words = _huge_header(rng)
    else:
        array, words = _other_array(np.load(io.BytesIO(members[name])), rng)
        if array is None:
            del members[name]
        else:
            members[name] = _npy(array)
    kind = zipfile.ZIP_DEFLATED if rng.random() < 0.15 else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", kind) as archive:
        for key, data in members.items():
            archive.writestr(key, data)
    return f"{path.name}, {name}: {words}"


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array, allow_pickle=True)
    return out.getvalue()


def _huge_header(rng: Rng) -> tuple[bytes, str]:
    """An array that claims to be large; or is, of zeros that compress to nothing."""
    if rng.random() < 0.3:
        return _npy(np.zeros(int(10 ** rng.uniform(7, 8.6)), np.uint8)), "zeros"
    shape = pick(rng, ("(9999999999,)", "(99999, 99999)", "(-1,)", "(1 << 70,)", "()", "((),)"))
    kind = pick(
        rng, ("<f8", "|O", "<U99999999", "|V999999999", "<M8[ns]", "[('a', '<f8')]", "\\\\")
    )
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(64), f"{kind} {shape}"


def _other_array(array: np.ndarray, rng: Rng) -> tuple[np.ndarray | None, str]:
    ways = (
        "removed",
        "empty",
        "scalar",
        "shorter",
        "flat",
        "deeper",
        "type",
        "cell",
        "all",
        "rows",
    )
    way = pick(rng, ways)
    with np.errstate(all="ignore"):
        if way == "removed":
            return None, way
        if way == "type":
            kind = pick(
                rng, ("f2", "f4", "f8", "i1", "i8", "u4", "?", "c8", "U5", "S3", "M8[s]", "O")
            )
            try:
                return array.astype(kind), f"type {kind}"
            except (TypeError, ValueError):
                return array.astype("U5"), "type U5"
        if way in ("cell", "all") and array.size and array.dtype.kind in "fiu":
            choices = (np.nan, np.inf, -1.0, 1e30, -1e30, 1e9, 0.0, 255.0, 2.0**31)
            value = pick(rng, choices)
            changed = array.copy()
            changed.flat[int(rng.integers(array.size)) if way == "cell" else slice(None)] = (
                np.array(value).astype(array.dtype)
            )
            return changed, f"{way} is {value}"
        shapes: dict[str, Any] = {
            "empty": lambda: array[:0] if array.ndim else np.empty(0, array.dtype),
            "scalar": lambda: array.reshape(-1)[:1].reshape(()) if array.size else np.array(0),
            "shorter": lambda: array[: len(array) // 2] if array.ndim else array,
            "flat": lambda: array.reshape(-1),
            "deeper": lambda: array[None],
            "rows": lambda: np.concatenate([array] * 3) if array.ndim else array,
        }
        return shapes.get(way, shapes["empty"])(), way


def mutate_glb(path: Path, rng: Rng) -> str:
    """The JSON chunk, the lengths, or bytes; or other positions, which a reader must accept."""
    data = path.read_bytes()
    way = rng.random()
    if way < 0.3:
        data, words = mutate_bytes(data, rng)
        path.write_bytes(data)
        return f"{path.name}: {words}"
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    if way < 0.55:
        path.write_bytes(_scaled(data, document, 28 + length, float(rng.uniform(0.5, 2.0))))
        return f"{path.name}: positions scaled"
    words_: list[str] = []
    for _ in range(int(rng.integers(1, 4))):
        document, word = mutate_tree(document, rng)
        words_.append(word)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    path.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)
    return f"{path.name}: {'; '.join(words_)}"


def _scaled(data: bytes, document: Any, binary: int, factor: float) -> bytes:
    """All positions times a factor; `binary` is where buffers begin."""
    changed = bytearray(data)
    primitives = [p for mesh in document["meshes"] for p in mesh["primitives"]]
    for index in {primitive["attributes"]["POSITION"] for primitive in primitives}:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        start = binary + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(changed, "<f4", 3 * accessor["count"], start)
        values *= np.float32(factor)
    return bytes(changed)


def mutate_safetensors(path: Path, rng: Rng) -> str:
    """The JSON header, its length, or bytes."""
    data = path.read_bytes()
    if rng.random() < 0.4:
        data, words = mutate_bytes(data, rng)
    else:
        length = struct.unpack_from("<Q", data)[0]
        document, words = mutate_tree(json.loads(data[8 : 8 + length]), rng)
        text = json.dumps(document).encode()
        data = struct.pack("<Q", len(text)) + text + data[8 + length :]
    path.write_bytes(data)
    return f"{path.name}: {words}"
