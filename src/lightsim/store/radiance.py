"""Radiance RGBE pictures (.hdr), both run-length generations and flat pixels.

Reference: G. Ward, "Real Pixels", Graphics Gems II, 1991; radsite.lbl.gov/radiance/refer/Notes/
picture_format.html.
"""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float, Float32, UInt8

_MAGIC = (b"#?RADIANCE", b"#?RGBE", b"#?AUTOPANO")
_RESOLUTION = re.compile(rb"^([-+])Y (\d{1,6}) ([-+])X (\d{1,6})$")
_MAX_PIXELS = 1 << 28
_HEADER_BYTES = 1 << 16


def decode_radiance(data: bytes) -> Float32[np.ndarray, "h w 3"]:
    """Linear RGB of a .hdr file's bytes, row 0 up, EXPOSURE divided out.

    A code (m, e) means m x 2^(e - 136), as in Blender, OpenCV and stb; Radiance's own half-code
    offset is not added.

    Raises:
        ValueError: what is wrong with the bytes.
    """
    height, width, flip_y, flip_x, exposure, start = _read_header(data)
    codes = _read_pixels(data, start, height, width)
    exponent = codes[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1.0), exponent - 136), np.float32(0.0))
    rgb = codes[..., :3].astype(np.float32) * scale[..., None].astype(np.float32)
    rgb = rgb[::-1] if flip_y else rgb
    rgb = rgb[:, ::-1] if flip_x else rgb
    return np.ascontiguousarray(rgb / np.float32(exposure), dtype=np.float32)


def encode_radiance(rgb: Float[np.ndarray, "h w 3"]) -> bytes:
    """A run-length coded .hdr file of linear, non-negative RGB; relative error <= 1/256 of the
    largest channel.

    Raises:
        ValueError: a value is negative, not finite or beyond 1.7e38.
    """
    if not np.isfinite(rgb).all() or (rgb < 0).any() or (rgb > 1.7e38).any():
        raise ValueError("RGBE cannot hold negative, non-finite or huge values")
    height, width = rgb.shape[:2]
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    codes = _codes_from_rgb(rgb.astype(np.float64))
    if not 8 <= width < 32768:
        return header + codes.tobytes()
    lines = [header]
    for row in codes:
        lines.append(bytes([2, 2, width >> 8, width & 255]))
        lines.extend(_encode_runs(row[:, channel].tobytes()) for channel in range(4))
    return b"".join(lines)


def _read_header(data: bytes) -> tuple[int, int, bool, bool, float, int]:
    if not data.startswith(_MAGIC):
        raise ValueError("it does not start with #?RADIANCE")
    end = data.find(b"\n\n", 0, _HEADER_BYTES)
    line_end = data.find(b"\n", end + 2, end + 2 + 80)
    if end < 0 or line_end < 0:
        raise ValueError("the header does not end")
    exposure = 1.0
    for line in data[:end].split(b"\n")[1:]:
        key, _, value = line.partition(b"=")
        if key.strip() == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise ValueError(f"the pixel format {value[:40]!r} is not 32-bit_rle_rgbe")
        exposure *= float(value) if key.strip() == b"EXPOSURE" else 1.0
    match = _RESOLUTION.match(data[end + 2 : line_end].strip())
    if match is None:
        raise ValueError(f"the resolution line {data[end + 2 : line_end]!r} is not '-Y h +X w'")
    height, width = int(match[2]), int(match[4])
    if height < 1 or width < 1 or height * width > _MAX_PIXELS:
        raise ValueError(f"the size {width}x{height} px is out of range")
    if not 1e-30 < exposure < 1e30:
        raise ValueError(f"the exposure {exposure} is out of range")
    return height, width, match[1] == b"+", match[3] == b"-", exposure, line_end + 1


def _read_pixels(data: bytes, start: int, height: int, width: int) -> UInt8[np.ndarray, "h w 4"]:
    is_coded = 8 <= width < 32768 and data[start : start + 2] == b"\x02\x02"
    if is_coded and data[start + 2] < 128:
        # Every row needs a marker and four runs at the least: refuse before allocating.
        if len(data) - start < height * (4 + 8 * ((width + 126) // 127)):
            raise ValueError("the file is truncated")
        return _read_run_length(data, start, height, width)
    flat = _read_flat(data, start, height * width)
    return flat.reshape(height, width, 4)


def _read_run_length(
    data: bytes, position: int, height: int, width: int
) -> UInt8[np.ndarray, "h w 4"]:
    codes = np.empty((height, 4, width), dtype=np.uint8)
    marker = bytes([2, 2, width >> 8, width & 255])
    for row in range(height):
        if data[position : position + 4] != marker:
            raise ValueError(f"row {row} does not start where it should; truncated or damaged")
        line, position = _expand_runs(data, position + 4, 4 * width, width)
        codes[row] = np.frombuffer(line, dtype=np.uint8).reshape(4, width)
    return np.moveaxis(codes, 1, 2)


def _expand_runs(data: bytes, position: int, count: int, width: int) -> tuple[bytes, int]:
    """`count` bytes of the four channels, one after another; runs end with their channel."""
    line = bytearray()
    size = len(data)
    while len(line) < count:
        if position + 1 >= size:
            raise ValueError("the file is truncated")
        length = data[position]
        channel_left = width - len(line) % width
        if length > 128:
            length -= 128
            line += data[position + 1 : position + 2] * length
            position += 2
        else:
            line += data[position + 1 : position + 1 + length]
            position += 1 + length
        if length == 0 or length > channel_left or position > size:
            raise ValueError("a run of pixels is damaged")
    return bytes(line), position


def _read_flat(data: bytes, start: int, count: int) -> UInt8[np.ndarray, "n 4"]:
    """Plain pixels, with the first generation's repeat marks (1, 1, 1, n)."""
    usable = (len(data) - start) // 4
    raw = np.frombuffer(data, dtype=np.uint8, count=usable * 4, offset=start).reshape(-1, 4)
    marks = np.flatnonzero((raw[:, :3] == 1).all(axis=1))
    if not len(marks):
        if len(raw) < count:
            raise ValueError("the file is truncated")
        return raw[:count]
    repeats = np.ones(len(raw), dtype=np.int64)
    shift = 0
    for previous, mark in zip(np.concatenate([[-2], marks[:-1]]), marks, strict=True):
        shift = shift + 8 if mark == previous + 1 else 0
        if shift > 16:
            raise ValueError("a repeat mark is damaged")
        repeats[mark] = int(raw[mark, 3]) << shift
    if marks[0] == 0 or repeats.sum() < count or repeats.sum() > 2 * _MAX_PIXELS:
        raise ValueError("the repeat marks do not add up to the picture; truncated or damaged")
    is_pixel = np.ones(len(raw), dtype=bool)
    is_pixel[marks] = False
    source = np.maximum.accumulate(np.where(is_pixel, np.arange(len(raw)), 0))
    return raw[np.repeat(source, repeats)[:count]]


def _codes_from_rgb(rgb: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 4"]:
    largest = rgb.max(axis=2)
    exponent = np.frexp(largest)[1]
    # A mantissa that would round up to 256 takes the next exponent.
    exponent += np.round(np.ldexp(largest, 8 - exponent)) > 255
    codes = np.zeros((*largest.shape, 4), dtype=np.uint8)
    is_held = (largest > 0) & (exponent > -128)
    mantissa = np.round(np.ldexp(rgb, (8 - exponent)[..., None]))
    codes[..., :3] = np.where(is_held[..., None], mantissa, 0)
    codes[..., 3] = np.where(is_held, exponent + 128, 0)
    return codes


def _encode_runs(line: bytes) -> bytes:
    values = np.frombuffer(line, dtype=np.uint8)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
    out, pending = bytearray(), bytearray()
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if end - start < 4:
            pending += line[start:end]
            continue
        _flush_literals(out, pending)
        for left in range(end - start, 0, -127):
            out += bytes([128 + min(left, 127), line[start]])
    _flush_literals(out, pending)
    return bytes(out)


def _flush_literals(out: bytearray, pending: bytearray) -> None:
    for start in range(0, len(pending), 128):
        part = pending[start : start + 128]
        out += bytes([len(part)]) + part
    pending.clear()
