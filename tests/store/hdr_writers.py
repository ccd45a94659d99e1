"""Writers of HDR files for tests: Radiance by hand, OpenEXR by the library or by hand."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

# A run of 4 to 127 equal bytes, or up to 128 bytes before the next run.
_RUN_OR_BYTES = re.compile(rb"(.)\1{3,126}|(?:(?!(.)\2{3}).){1,128}", re.DOTALL)
Box = tuple[int, int, int, int]
"""First and last column and row: left, top, right, bottom."""


def radiance_bytes(
    rgb: np.ndarray,
    header: Sequence[str] = ("#?RADIANCE", "FORMAT=32-bit_rle_rgbe"),
    order: str = "-Y +X",
    line_end: str = "\n",
    is_flat: bool = False,
) -> bytes:
    """A picture whose scanlines are stored in an order such as "+X -Y" (columns, from the left).

    Scanlines are run-length coded if their length allows it.
    """
    codes = rgbe_codes(rgb)
    height, width = codes.shape[:2]
    first, second = order.split()
    codes = codes[::-1] if "+Y" in order else codes
    codes = codes[:, ::-1] if "-X" in order else codes
    codes = codes.swapaxes(0, 1) if first.endswith("X") else codes
    size = {"Y": height, "X": width}
    resolution = f"{first} {size[first[1]]} {second} {size[second[1]]}"
    text = line_end.join([*header, "", resolution, ""]).encode()
    if is_flat or not 8 <= codes.shape[1] < 32768:
        return text + np.ascontiguousarray(codes).tobytes()
    lines = [text]
    for line in codes:
        lines.append(bytes([2, 2, len(line) >> 8, len(line) & 255]))
        lines.extend(_run_lengths(line[:, i].tobytes()) for i in range(4))
    return b"".join(lines)


def rgbe_codes(rgb: np.ndarray) -> np.ndarray:
    """Mantissas and exponent of each pixel: (m, e) means m x 2^(e - 136)."""
    largest = rgb.max(axis=2).astype(np.float64)
    exponent = np.frexp(largest)[1]
    # A mantissa that would round up to 256 takes the next exponent.
    exponent += np.round(np.ldexp(largest, 8 - exponent)) > 255
    is_stored = (largest > 0) & (exponent > -128)
    mantissas = np.round(np.ldexp(rgb.astype(np.float64), (8 - exponent)[..., None]))
    codes = np.concatenate([mantissas, exponent[..., None] + 128], axis=2)
    return np.where(is_stored[..., None], codes, 0).astype(np.uint8)


def _run_lengths(line: bytes) -> bytes:
    return b"".join(
        bytes([128 + len(m[0]), m[0][0]]) if m[1] else bytes([len(m[0])]) + m[0]
        for m in _RUN_OR_BYTES.finditer(line)
    )


def write_layers(
    path: Path, planes: Mapping[str, np.ndarray], header: Mapping[str, Any] | None = None
) -> Path:
    """One part with these channels."""
    OpenEXR.File(_header(header), _contiguous(planes)).write(str(path))
    return path


def write_parts(
    path: Path, parts: Sequence[tuple[str, Mapping[str, np.ndarray], Mapping[str, Any]]]
) -> Path:
    """Parts: name, channels, further header entries."""
    made = [OpenEXR.Part(_header(header), _contiguous(c), name) for name, c, header in parts]
    OpenEXR.File(made).write(str(path))
    return path


def planes_of(rgb: np.ndarray, layer: str = "", letters: str = "RGB") -> dict[str, np.ndarray]:
    """Channels R, G, B of a layer."""
    prefix = f"{layer}." if layer else ""
    return {f"{prefix}{letter}": rgb[..., i] for i, letter in enumerate(letters)}


def windows(data: Box, display: Box) -> dict[str, Any]:
    """Header entries of the two windows."""
    corners = {"dataWindow": data, "displayWindow": display}
    return {
        name: (np.array(box[:2], np.int32), np.array(box[2:], np.int32))
        for name, box in corners.items()
    }


def write_sampled(
    path: Path, planes: Mapping[str, tuple[np.ndarray, int]], data: Box, display: Box
) -> Path:
    """Channels with a sample every so many pixels each way, which the library cannot write:
    scanlines without compression, 32-bit floats (OpenEXR File Layout)."""
    named = sorted(planes.items())
    channels = b"".join(
        name.encode() + struct.pack("<xiBxxxii", 2, 0, step, step) for name, (_, step) in named
    )
    header = b"".join(
        [
            _attribute("channels", "chlist", channels + b"\0"),
            _attribute("compression", "compression", b"\0"),
            _attribute("dataWindow", "box2i", struct.pack("<4i", *data)),
            _attribute("displayWindow", "box2i", struct.pack("<4i", *display)),
            _attribute("lineOrder", "lineOrder", b"\0"),
            _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
            _attribute("screenWindowCenter", "v2f", bytes(8)),
            _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        ]
    )
    start = b"\x76\x2f\x31\x01\x02\0\0\0" + header + b"\0"
    lines = []
    for y in range(data[1], data[3] + 1):
        rows = [p[(y - data[1]) // step] for _, (p, step) in named if y % step == 0]
        body = b"".join(row.astype("<f4").tobytes() for row in rows)
        lines.append(struct.pack("<ii", y, len(body)) + body)
    offsets = len(start) + 8 * len(lines) + np.cumsum([0, *map(len, lines[:-1])])
    path.write_bytes(start + offsets.astype("<u8").tobytes() + b"".join(lines))
    return path


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _header(entries: Mapping[str, Any] | None) -> dict[str, Any]:
    common = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    return {**common, **(entries or {})}


def _contiguous(planes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
