"""Radiance RGBE pictures (.hdr), both run-length generations and flat pixels.

Reference: G. Ward, "Real Pixels", Graphics Gems II, 1991; radsite.lbl.gov/radiance/refer/Notes/
picture_format.html.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float32, UInt8

from lightsim.errors import InputError
from lightsim.store.radiance_header import RadianceHeader, damaged, read_header

_BLOCK_PIXELS = 1 << 20
"""Decoded at once; 12 MB as floats."""
_MAX_MARKED_PIXELS = 1 << 25
"""8192x4096; the first generation's run lengths are older than pictures of a tenth of that."""


def decode_radiance(data: bytes, factor: int = 1) -> Float32[np.ndarray, "h w 3"]:
    """Return linear colours of a .hdr file's bytes, row 0 up, EXPOSURE and COLORCORR divided out;
    their primaries are those of the header.

    A code (m, e) means m x 2^(e - 136), as in Blender, OpenCV and stb; Radiance's own half-code
    offset is not added. Scanlines are decoded a few at a time, so that beside the file and the
    result little is held.

    Args:
        data: the whole file.
        factor: the result's pixels are means over squares of so many pixels each way; it divides
            height and width.

    Raises:
        InputError: what is wrong with the bytes; `where` is left open.
    """
    header = read_header(data)
    lines, length = header.scanlines
    if lines % factor or length % factor:
        raise InputError(
            "the picture cannot be reduced by this factor",
            got=f"{factor} of {header.width}x{header.height} px",
            expected="a divisor of both",
        )
    rgb = np.empty((lines // factor, length // factor, 3), dtype=np.float32)
    powers = np.ldexp(1.0, np.arange(256) - 136)
    powers[0] = 0.0
    with np.errstate(over="ignore", under="ignore"):
        scales = (powers[:, None] / header.divisor).astype(np.float32)
    line = 0
    for codes in _code_blocks(data, header, factor):
        block = codes[..., :3] * scales[codes[..., 3]]
        count = len(block) // factor
        if factor > 1:
            squares = block.reshape(count, factor, length // factor, factor, 3)
            block = squares.mean(axis=(1, 3), dtype=np.float32)
        rgb[line : line + count] = block
        line += count
    rgb = rgb.swapaxes(0, 1) if header.is_column_major else rgb
    rgb = rgb[::-1] if header.is_flipped_y else rgb
    rgb = rgb[:, ::-1] if header.is_flipped_x else rgb
    return np.ascontiguousarray(rgb)


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


def _code_blocks(
    data: bytes, header: RadianceHeader, factor: int
) -> Iterator[UInt8[np.ndarray, "_ w 4"]]:
    """Scanlines from the file's first to its last, some at a time, a multiple of `factor`."""
    (height, width), start = header.scanlines, header.end
    step = factor * max(1, _BLOCK_PIXELS // (factor * width))
    is_coded = 8 <= width < 32768 and data[start : start + 2] == b"\x02\x02"
    # A slice: the file may end here.
    if not (is_coded and data[start + 2 : start + 3] < b"\x80"):
        flat = _read_flat(data, start, height * width).reshape(height, width, 4)
        yield from (flat[row : row + step] for row in range(0, height, step))
        return
    # Every row needs a marker and four runs at the least: refuse before allocating.
    if len(data) - start < height * (4 + 8 * ((width + 126) // 127)):
        raise damaged("fewer bytes than pixels")
    marker = bytes([2, 2, width >> 8, width & 255])
    for row in range(0, height, step):
        codes = np.empty((min(step, height - row), 4, width), dtype=np.uint8)
        for line in range(len(codes)):
            if data[start : start + 4] != marker:
                raise damaged(f"scanline {row + line} does not start where it should")
            values, start = _expand_runs(data, start + 4, 4 * width, width)
            codes[line] = np.frombuffer(values, dtype=np.uint8).reshape(4, width)
        yield np.moveaxis(codes, 1, 2)


def _expand_runs(data: bytes, position: int, count: int, width: int) -> tuple[bytearray, int]:
    """`count` bytes of the four channels, one after another; runs end with their channel."""
    line = bytearray()
    filled, channel_end, last = 0, width, len(data) - 1
    while filled < count:
        if position >= last:
            raise damaged("fewer bytes than pixels")
        length = data[position]
        if length > 128:
            length -= 128
            line += data[position + 1 : position + 2] * length
            position += 2
        else:
            line += data[position + 1 : position + 1 + length]
            position += 1 + length
        filled += length
        if length == 0 or filled > channel_end or position > last + 1:
            raise damaged("a run of pixels is damaged")
        if filled == channel_end:
            channel_end += width
    return line, position


def _read_flat(data: bytes, start: int, count: int) -> UInt8[np.ndarray, "n 4"]:
    """Plain pixels, with the first generation's repeat marks (1, 1, 1, n)."""
    # Each pixel and each mark stands for one pixel at the least; what follows is not looked at.
    usable = min((len(data) - start) // 4, count)
    words = np.frombuffer(data, dtype="<u4", count=usable, offset=start)
    marks = np.flatnonzero((words & 0xFFFFFF) == 0x010101)
    if not len(marks):
        if usable < count:
            raise damaged("fewer bytes than pixels")
        return words.view(np.uint8).reshape(-1, 4)
    if count > _MAX_MARKED_PIXELS:
        raise damaged(f"repeat marks of 1989 in a picture of {count} pixels")
    repeats = np.ones(usable, dtype=np.int64)
    shift = 0
    for previous, mark in zip(np.concatenate([[-2], marks[:-1]]), marks, strict=True):
        shift = shift + 8 if mark == previous + 1 else 0
        if shift > 16:
            raise damaged("a repeat mark is damaged")
        repeats[mark] = int(words[mark] >> 24) << shift
    if marks[0] == 0 or not count <= repeats.sum() <= count + usable:
        raise damaged("repeat marks that do not add up to the picture")
    is_pixel = np.ones(usable, dtype=bool)
    is_pixel[marks] = False
    source = np.maximum.accumulate(np.where(is_pixel, np.arange(usable), 0))
    return np.repeat(words[source], repeats)[:count].view(np.uint8).reshape(-1, 4)


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
