"""Damaged and strange pictures: JPEG, PNG and other kinds, Radiance and OpenEXR skies."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from tests.store.hdr_writers import radiance_bytes

from lightsim.store.images import write_exr

from .mutations import NUMBER_WORDS, Rng, mutate_bytes, pick

_SIZES = ((1, 1), (2, 12000), (12000, 2), (1, 65500), (64, 36), (640, 360), (3000, 3000))
_MODES = ("RGB", "L", "RGBA", "P", "CMYK", "1", "I;16", "LA", "I", "F")
_KINDS = (
    "JPEG",
    "PNG",
    "WEBP",
    "GIF",
    "BMP",
    "TIFF",
    "EPS",
    "PPM",
    "TGA",
    "ICO",
    "JPEG2000",
    "PDF",
)


def mutate_picture(path: Path, rng: Rng) -> str:
    """A picture file with damaged bytes, a false size, or another kind of picture."""
    way = rng.random()
    if way < 0.4:
        data, words = mutate_bytes(path.read_bytes(), rng)
    else:
        data, words = pick(rng, (_other_kind, _other_kind, _false_size, _png_bomb))(path, rng)
    path.write_bytes(data)
    return f"{path.name}: {words}"


def _other_kind(path: Path, rng: Rng) -> tuple[bytes, str]:
    with Image.open(path) as image:
        own = image.size
    size = pick(rng, (*_SIZES, own, own, own))
    mode, kind = pick(rng, _MODES), pick(rng, _KINDS)
    out = io.BytesIO()
    picture = Image.new("RGB", size, (90, 120, 150)).convert("L" if mode in ("I;16", "F") else mode)
    picture = picture.convert("I").convert("I;16") if mode == "I;16" else picture
    picture = picture.convert("F") if mode == "F" else picture
    try:
        picture.save(out, format=kind)
    except (OSError, ValueError, KeyError):
        kind = "PNG"
        picture.convert("RGB").save(out := io.BytesIO(), format=kind)
    return out.getvalue(), f"a {kind} of {size[0]}x{size[1]} px, mode {mode}"


def _false_size(path: Path, rng: Rng) -> tuple[bytes, str]:
    """The size in the header is another than that of the pixels; a PNG's check sum is right."""
    data = bytearray(path.read_bytes())
    width, height = (int(pick(rng, (0, 1, 63, 4096, 30000, 65535))) for _ in range(2))
    if data.startswith(b"\x89PNG"):
        scale = int(pick(rng, (1, 1, 1 << 15)))
        data[16:24] = struct.pack(">II", width * scale, height * scale)
        data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    else:
        at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
        if at > 0:
            data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data), f"a header of {width}x{height} px"


def _png_bomb(path: Path, rng: Rng) -> tuple[bytes, str]:
    """Few bytes that decompress to very many: pixels, text or colour profile."""
    width, height = pick(rng, ((8000, 8000), (12000, 12000), (16000, 16000), (60000, 60000)))
    depth, colour = pick(rng, ((8, 2), (8, 0), (1, 0), (16, 6), (8, 6)))
    n = int(10 ** rng.uniform(5, 7.5))
    zeros = zlib.compress(bytes(n), 9)
    extra = pick(rng, (b"", _chunk(b"zTXt", b"a\0\0" + zeros), _chunk(b"iCCP", b"a\0\0" + zeros),
                       _chunk(b"iTXt", b"a\0\1\0\0\0" + zeros)))  # fmt: skip
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    end = _chunk(b"IEND", b"")
    data = b"\x89PNG\r\n\x1a\n" + head + extra + _chunk(b"IDAT", zeros) + end
    return data, f"a PNG bomb of {width}x{height} px, {n} bytes, colour type {colour}"


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


_ENTRIES = (b"COLORCORR=", b"PRIMARIES=", b"GAMMA=", b"PIXASPECT=", b"EXPOSURE=", b"\tEXPOSURE=")


def write_hdr_case(path: Path, rng: Rng) -> str:
    """A Radiance sky: honest, then damaged in header, runs or bytes."""
    height = int(pick(rng, (8, 16, 32, 64)))
    data = radiance_bytes(_honest(height, 2 * height, rng))
    way: Callable[[bytes, Rng], tuple[bytes, str]] = pick(
        rng, (mutate_bytes, mutate_bytes, _other_header, _other_header, _run_bomb, _flat_values)
    )
    data, words = way(data, rng)
    path.write_bytes(data)
    return f"{path.name}: {words}"


def _honest(height: int, width: int, rng: Rng) -> np.ndarray:
    picture = rng.lognormal(0, 1, (height, width, 3)).astype(np.float32)
    picture[height // 4, width // 3] = 1e4
    return picture


def _other_header(data: bytes, rng: Rng) -> tuple[bytes, str]:
    word = pick(rng, NUMBER_WORDS)[:200]
    number = word.encode()
    lines = {
        "exposure": lambda: data.replace(b"\n\n", b"\nEXPOSURE=" + number + b"\n\n", 1),
        "format": lambda: data.replace(b"32-bit_rle_rgbe", pick(rng, (b"32-bit_rle_xyze", number))),
        "entry": lambda: data.replace(b"\n\n", b"\n" + pick(rng, _ENTRIES) + b" ".join(
            pick(rng, NUMBER_WORDS)[:20].encode() if rng.random() < 0.3 else b".3"
            for _ in range(int(pick(rng, (1, 3, 8))))) + b"\n\n", 1),
        "size": lambda: re.sub(
            rb"-Y \d+ \+X \d+", pick(rng, (b"-Y 16384 +X 32768", b"-Y 8 +X " + number,
            b"-Y 10000 +X 20000", b"+X 16 -Y 8", b"-X 64 +Y 32", b"+X 9999 -Y 9998",
            b"+Y 8 -X 16", b"-Y 30000 +X 16",
            b"-Y 2 +X 32767", b"-Y 999999 +X 999999")).replace(b"\\", b""), data, count=1,
        ),
        "end": lambda: data.replace(b"\n\n", pick(rng, (b"\n", b"\r\n\r\n", b"")), 1),
        "long": lambda: data.replace(b"\n\n", b"\n" + b"x=1\n" * 30_000 + b"\n", 1),
        "magic": lambda: data.replace(b"#?RADIANCE", pick(rng, (b"#?", b"#?RGBE", b"RADIANCE"))),
    }  # fmt: skip
    name = pick(rng, list(lines))
    return lines[name](), f"header: {name} {word[:30]!r}"


def _run_bomb(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """A small file of runs for a very large picture, in the new coding or the old one."""
    width, height = pick(rng, ((32000, 8000), (32766, 16000), (20000, 10000), (8192, 4096)))
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    if rng.random() < 0.5:
        pixel = b"\x40\x40\x40\x81"
        repeat = bytes([1, 1, 1, 255]) * int(pick(rng, (2, 3, 4)))
        count = int(pick(rng, (1, 100, 10_000)))
        return head + (pixel + repeat) * count, f"old runs for {width}x{height} px"
    runs = (bytes([255, 64]) * (width // 127) + bytes([128 + width % 127, 64])) * 4
    line = bytes([2, 2, width >> 8, width & 255]) + runs
    count = int(pick(rng, (1, height // 8)))
    return head + line * count, f"runs for {width}x{height} px, {count} rows"


def _flat_values(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """Whole skies of one code: no light, too much light, nearly none."""
    code = bytes(
        pick(rng, ((0, 0, 0, 0), (255, 255, 255, 255), (1, 0, 0, 1), (9, 9, 9, 9), (2, 2, 2, 128)))
    )
    height, width = pick(rng, ((4, 8), (3, 6), (1, 2), (2, 4), (8, 17), (16, 33), (5, 10)))
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    return head + code * (height * width), f"{width}x{height} px of {code.hex()}"


def write_exr_case(path: Path, rng: Rng) -> str:
    """An OpenEXR sky: damaged bytes, a false window, strange values, channels or sizes."""
    height = int(pick(rng, (8, 16, 32)))
    way = int(rng.integers(7))
    picture = _honest(height, 2 * height, rng)
    words = ""
    if way == 2:
        picture, words = _strange_values(picture, rng)
    if way == 3:
        height, width = pick(rng, ((1, 2), (2, 4), (3, 6), (1, 1), (16, 31), (16, 33), (2, 12000)))
        picture, words = (
            _honest(max(height, 4), max(width, 4), rng)[:height, :width],
            f"{width}x{height}",
        )
    if way > 4:
        return f"{path.name}: {_other_structure(path, picture, rng)}"
    if way == 4 and rng.random() < 0.5:
        return f"{path.name}: {_other_channels(path, picture, rng)}"
    with np.errstate(over="ignore"):
        write_exr(path, picture)
    if way in (0, 4):
        data, words = mutate_bytes(path.read_bytes(), rng)
        path.write_bytes(data)
    if way == 1:
        words = _false_window(path, rng)
    return f"{path.name}: {words}"


def _strange_values(picture: np.ndarray, rng: Rng) -> tuple[np.ndarray, str]:
    value = pick(rng, (np.nan, np.inf, -np.inf, -1.0, -1e-6, 3e38, 1e30, 1e-38, 0.0))
    area = pick(rng, ("a pixel", "a channel", "a half", "all"))
    picture = picture.copy()
    where = {
        "a pixel": (int(rng.integers(len(picture))), int(rng.integers(len(picture)))),
        "a channel": (..., int(rng.integers(3))),
        "a half": (slice(0, len(picture) // 2),),
        "all": (...,),
    }[area]
    picture[where] = value
    return picture, f"{area} is {value}"


def _false_window(path: Path, rng: Rng) -> str:
    data = bytearray(path.read_bytes())
    width, height = pick(
        rng, ((32768, 8192), (20000, 10000), (2**31, 2**31), (0, 0), (16, 7), (60000, 1))
    )
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.find(name) + len(name) + 4
        data[at : at + 16] = struct.pack("<iiii", 0, 0, width - 1, height - 1)
        if rng.random() < 0.2:
            break
    path.write_bytes(bytes(data))
    return f"windows of {width}x{height} px"


def _other_channels(path: Path, picture: np.ndarray, rng: Rng) -> str:
    import OpenEXR

    grey = np.ascontiguousarray(picture[..., 0])
    names: tuple[str, ...] = pick(
        rng, (("R", "G"), ("Z",), ("a.R", "a.G", "a.B", "b.R"), ("a.R", "b.G", "c.B"), ("Y", "RY"))
    )
    kind = pick(rng, (np.float32, np.float16, np.uint32))
    with np.errstate(all="ignore"):
        channels = {name: grey.astype(kind) for name in names}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return f"channels {names} of {np.dtype(kind)}"


def _other_structure(path: Path, picture: np.ndarray, rng: Rng) -> str:
    """Parts, windows, views and colours as they may be, some of them absurd; bytes damaged then."""
    import OpenEXR

    height, width = picture.shape[:2]
    left, top = (int(pick(rng, (0, 0, -5, 3, 10**6, -(2**30)))) for _ in range(2))
    right, bottom = (int(pick(rng, (0, 1, 15, 63, 4095, 2**20, 2**30))) for _ in range(2))
    corners = [(left, top), (left + width - 1, top + height - 1), (0, 0), (right, bottom)]
    data, end, start, far = (np.array(corner, np.int32) for corner in corners)
    numbers = (0.0, 0.3, 0.33, 0.6, 1.0, -1.0, np.nan, np.inf, 1e30)
    entries = {
        "chromaticities": tuple(float(pick(rng, numbers)) for _ in range(8)),
        "dataWindow": (data, end),
        "displayWindow": (start, far),
        "acesImageContainerFlag": int(pick(rng, (0, 1, -1))),
        "whiteLuminance": float(pick(rng, numbers)),
        "adoptedNeutral": np.array([pick(rng, numbers), 0.3], np.float32),
        "multiView": list(pick(rng, (("left", "right"), ("",), ("R",)))),
        "colorInteropID": str(pick(rng, ("lin_ap1_scene", "lin_ap0_scene", "x" * 99, ""))),
    }
    kept = {key: value for key, value in entries.items() if rng.random() < 0.25}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **kept}
    layers = [str(pick(rng, ("", "a.", "left.", "x.Combined.", "."))) for _ in range(2)]
    planes = [
        {f"{layer}{c}": np.ascontiguousarray(picture[..., i]) for i, c in enumerate("RGB")}
        for layer in layers
    ]
    try:
        if rng.random() < 0.5:
            parts = [OpenEXR.Part(dict(header), p, n) for p, n in zip(planes, "ab", strict=True)]
            OpenEXR.File(parts).write(str(path))
        else:
            OpenEXR.File(header, planes[0] | planes[1]).write(str(path))
    except (RuntimeError, ValueError, TypeError):
        write_exr(path, picture)
    if rng.random() < 0.3:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng)[0])
    return f"layers {layers}, {sorted(kept)}"
