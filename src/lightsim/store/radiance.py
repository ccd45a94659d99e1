"""Decoder of Radiance RGBE pictures (.hdr): flat pixels and both generations of run-length codes.

Reference: G. Ward, "Real Pixels", Graphics Gems II, 1991; radsite.lbl.gov/radiance/refer/Notes/
picture_format.html.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.errors import InputError
from lightsim.store.radiance_header import RadianceHeader, damaged, read_header

# Number of pixels that are decoded at once: 12 MB as floats.
_BLOCK_PIXELS = 1 << 20
# Largest picture with run-length codes of the first generation, 8192x4096 pixels. The pictures of
# that time (before 1991) had less than a tenth of it.
_MAX_MARKED_PIXELS = 1 << 25


def decode_radiance(data: bytes, factor: int = 1) -> Float32[np.ndarray, "h w 3"]:
    """Return the linear colours of a .hdr file, row 0 at the top, in the primaries of the header.

    EXPOSURE and COLORCORR are divided out. A code (m, e) means m x 2^(e - 136), as in Blender,
    OpenCV and stb; the half-code offset of Radiance itself is not added. Scanlines are decoded in
    blocks, so that memory beside the file and the result is small.

    Args:
        data: the whole file.
        factor: edge of the squares of pixels that are averaged to one pixel of the result; it must
            divide height and width.

    Raises:
        InputError: the bytes are damaged; the error has no file (`where`).
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
    # Exponent 0 is black.
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


def _code_blocks(
    data: bytes, header: RadianceHeader, factor: int
) -> Iterator[UInt8[np.ndarray, "_ w 4"]]:
    """Yield blocks of a multiple of `factor` scanlines, in the order of the file."""
    (height, width), start = header.scanlines, header.end
    step = factor * max(1, _BLOCK_PIXELS // (factor * width))
    is_coded = 8 <= width < 32768 and data[start : start + 2] == b"\x02\x02"
    # Compare a slice, which may be empty, since the file may end here.
    if not (is_coded and data[start + 2 : start + 3] < b"\x80"):
        flat = _read_flat(data, start, height * width).reshape(height, width, 4)
        yield from (flat[row : row + step] for row in range(0, height, step))
        return
    # Every scanline needs a marker and runs of at most 127 pixels: refuse before allocating.
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
    """Decode `count` bytes of four channels in sequence; return them and the next position.

    A run must not extend beyond the end of its channel.
    """
    line = bytearray()
    filled, channel_end, last = 0, width, len(data) - 1
    while filled < count:
        if position >= last:
            raise damaged("fewer bytes than pixels")
        # Above 128, one byte is repeated; else so many bytes follow.
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
    """Decode flat pixels, with the repeat marks (1, 1, 1, n) of the first generation."""
    # Each word, pixel or mark, gives at least one pixel; bytes after `count` words are ignored.
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
    # Adjacent marks are the bytes of one repeat count, the lowest first.
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
