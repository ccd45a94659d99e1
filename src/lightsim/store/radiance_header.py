"""Parser of headers of Radiance pictures (.hdr, .pic): text, an empty line, a resolution line.

Reference: G. Ward, "Radiance File Formats" (radsite.lbl.gov/radiance/refer/Notes/
picture_format.html).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lightsim.core.primaries import CIE_XYZ, Primaries
from lightsim.errors import InputError

# Largest number of pixels of a picture: a 16k panorama, 16384x8192.
MAX_PIXELS = 1 << 27
# Largest size of a header, in bytes. Each of Radiance's own programs adds one line.
HEADER_BYTES = 1 << 16
# Remedy for a damaged picture.
DAMAGED = "Download or export the file again."
# First bytes of a picture; the program's name follows: RADIANCE, RGBE, AUTOPANO and others.
_MAGIC = b"#?"
# Format line without the name of the colour space.
_FORMAT_LINE = b"FORMAT=32-bit_rle_"
# Primaries of the pixel formats; RGBE has the primaries of the header's PRIMARIES entry.
_PRIMARIES_BY_FORMAT: dict[bytes, Primaries | None] = {
    b"32-bit_rle_rgbe": None,
    b"32-bit_rle_xyze": CIE_XYZ,
}
_RESOLUTION = re.compile(rb"^([-+])([XY])\s+(\d{1,6})\s+([-+])([XY])\s+(\d{1,6})$")
# Range of an exposure; outside it, float32 results would be 0 or infinite.
_FACTORS = (1e-30, 1e30)
# Largest deviation of GAMMA and PIXASPECT from 1 without a note; rounding causes it.
_PLAIN_GAMMA = 1e-3


@dataclass(frozen=True, eq=False)
class RadianceHeader:
    """Size, pixel order and scale of a picture.

    Args:
        height, width: size of the picture, in pixels.
        is_column_major: scanlines are columns (the resolution line begins with X).
        is_flipped_y, is_flipped_x: the first pixel is at the bottom, at the right.
        divisor: product of all EXPOSURE and COLORCORR lines, for each channel.
        primaries: primaries of the stored colours; None if the header has none.
        notes: one note for each entry that is not applied.
        end: position of the first pixel's byte.
    """

    height: int
    width: int
    is_column_major: bool
    is_flipped_y: bool
    is_flipped_x: bool
    divisor: Float[np.ndarray, "3"]
    primaries: Primaries | None
    notes: tuple[str, ...]
    end: int

    @property
    def scanlines(self) -> tuple[int, int]:
        """Return the number of scanlines and the number of pixels of each."""
        return (self.width, self.height) if self.is_column_major else (self.height, self.width)


def is_radiance(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is a Radiance picture.

    It begins with `#?`, or (written by Radiance's oldest programs) with text and a FORMAT line.
    """
    return start.startswith(_MAGIC) or (
        _FORMAT_LINE in start and start[: start.index(_FORMAT_LINE)].isascii()
    )


def read_header(data: bytes) -> RadianceHeader:
    """Parse the header of a file.

    Lines that begin with a blank are ignored: they are headers of the source pictures. Lines may
    end with CR LF.

    Raises:
        InputError: the header is damaged, or of another format; the error has no file (`where`).
    """
    lines, end = _lines(data)
    found = _Found()
    for line in lines:
        key, is_entry, value = line.partition(b"=")
        if is_entry and not line[:1].isspace() and not line.startswith(b"#"):
            read = _READERS.get(key.strip().upper())
            if read is not None:
                read(found, value)
    divisor = found.divisor
    if not ((divisor > _FACTORS[0]) & (divisor < _FACTORS[1])).all():
        raise InputError(
            "EXPOSURE or COLORCORR of the Radiance header is out of range",
            got=" ".join(f"{value:g}" for value in divisor),
            expected=f"{_FACTORS[0]:g} to {_FACTORS[1]:g}",
            remedy="Correct the header, which is text.",
        )
    is_column_major, flips, height, width, end = _resolution(data, end)
    return RadianceHeader(
        height, width, is_column_major, *flips, divisor,
        found.format_primaries or found.primaries, tuple(found.notes), end,
    )  # fmt: skip


def damaged(got: str) -> InputError:
    """Return the error for a truncated or inconsistent picture."""
    return InputError("the Radiance picture is truncated or damaged", got=got, remedy=DAMAGED)


class _Found:
    """Entries of a header that have been read."""

    def __init__(self) -> None:
        self.divisor = np.ones(3)
        self.primaries: Primaries | None = None
        self.format_primaries: Primaries | None = None
        self.notes: list[str] = []

    def read_format(self, value: bytes) -> None:
        name = value.strip()
        if name not in _PRIMARIES_BY_FORMAT:
            raise InputError(
                "the Radiance picture has an unknown pixel format",
                got=name[:40].decode("ascii", "replace"),
                expected=" or ".join(key.decode() for key in _PRIMARIES_BY_FORMAT),
                remedy="Save it as RGBE or OpenEXR.",
            )
        self.format_primaries = _PRIMARIES_BY_FORMAT[name]

    def read_exposure(self, value: bytes) -> None:
        self._divide(_numbers("EXPOSURE", value, 1))

    def read_correction(self, value: bytes) -> None:
        self._divide(_numbers("COLORCORR", value, 3))

    def _divide(self, factors: list[float]) -> None:
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            self.divisor = self.divisor * factors

    def read_primaries(self, value: bytes) -> None:
        numbers = _numbers("PRIMARIES", value, 8)
        # Photoshop and ImageMagick write eight zeros for unknown primaries.
        self.primaries = tuple(numbers) if any(numbers) else None

    def read_gamma(self, value: bytes) -> None:
        (gamma,) = _numbers("GAMMA", value, 1)
        # Not an entry of Radiance itself: programs differ on whether it is the exponent or its
        # inverse.
        if abs(gamma - 1.0) > _PLAIN_GAMMA:
            self.notes.append(f"GAMMA={gamma:g} is not applied: pixels are taken as linear")

    def read_aspect(self, value: bytes) -> None:
        (aspect,) = _numbers("PIXASPECT", value, 1)
        if abs(aspect - 1.0) > _PLAIN_GAMMA:
            self.notes.append(
                f"PIXASPECT={aspect:g} is not applied: the picture is taken to span the sphere"
            )


_READERS: dict[bytes, Callable[[_Found, bytes], None]] = {
    b"FORMAT": _Found.read_format,
    b"EXPOSURE": _Found.read_exposure,
    b"COLORCORR": _Found.read_correction,
    b"PRIMARIES": _Found.read_primaries,
    b"GAMMA": _Found.read_gamma,
    b"PIXASPECT": _Found.read_aspect,
}


def _lines(data: bytes) -> tuple[list[bytes], int]:
    """Return the lines of the header, and the position after the empty line that ends it."""
    lines: list[bytes] = []
    start = 0
    while (end := data.find(b"\n", start, HEADER_BYTES)) >= 0:
        line = data[start:end].rstrip(b"\r")
        start = end + 1
        if not line:
            return lines, start
        lines.append(line)
    raise damaged("a header that does not end")


def _resolution(data: bytes, start: int) -> tuple[bool, tuple[bool, bool], int, int, int]:
    """Parse the resolution line.

    Returns:
        Whether scanlines are columns, flips (y, x), height, width, and position of the first pixel.
    """
    # Four words, such as "-Y 1024 +X 2048", are far below 80 bytes.
    line_end = data.find(b"\n", start, start + 80)
    if line_end < 0:
        raise damaged("no resolution line after the header")
    match = _RESOLUTION.match(data[start:line_end].strip())
    if match is None or match[2] == match[5]:
        raise InputError(
            "the resolution line of the Radiance picture cannot be read",
            got=data[start:line_end].decode("ascii", "replace"),
            expected="such as -Y 1024 +X 2048",
            remedy=DAMAGED,
        )
    sign, size = {}, {}
    for first in (1, 4):
        axis = match[first + 1]
        sign[axis], size[axis] = match[first], int(match[first + 2])
    height, width = size[b"Y"], size[b"X"]
    if height < 1 or width < 1 or height * width > MAX_PIXELS:
        raise InputError(
            f"the size {width}x{height} px is out of range",
            expected=f"1 to {MAX_PIXELS} pixels",
            remedy="Resize it to 4096x2048 px.",
        )
    flips = sign[b"Y"] == b"+", sign[b"X"] == b"-"
    return match[2] == b"X", flips, height, width, line_end + 1


def _numbers(key: str, value: bytes, count: int) -> list[float]:
    """Return the first `count` numbers of an entry's value."""
    words = value.split()[:count]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(
            f"{key} of the Radiance header cannot be read",
            got=value.strip()[:80].decode("ascii", "replace"),
            expected="a number" if count == 1 else f"{count} numbers",
            remedy="Correct the header, which is text.",
        )
    return numbers
