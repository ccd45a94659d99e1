"""Relighting samples some thirty times smaller, for carrying to a machine that trains on them.

    python tools/pack_samples.py pack DATA/201 DATA/203 ... --out FILE.zip
    python tools/pack_samples.py unpack FILE.zip --out DATA

Planes become 8 bits in a curve that suits them, and WebP: colours and light with a little loss,
masks, depth and vectors with none but that of 8 bits; domes stay as they are. What `unpack` makes,
`lightsim train relight --data` reads. A plane that samples share is packed once.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from lightsim.errors import InputError
from lightsim.store.arrays import load_arrays
from lightsim.store.atomic import whole_file

_QUALITY = 92
_DARK = 0.02
"""Codes are logarithmic above it and linear below."""
_BRIGHTEST = 4.0
"""Of white: more is a sun, or next to it."""
_LIGHT = ("shaded", "reflected", "physical", "sky")
_SIGNED = ("normal", "position", "found")
_SMOOTH = ("source", "base_colour", "openness", "ratio", "truth")
"""Others are masks, depth, and domes (kept as they are)."""


@dataclass(frozen=True)
class Plane:
    """How a plane is packed: `blob` is its file, `high` what the code 255 stands for."""

    blob: str
    channels: int
    high: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    packing = commands.add_parser("pack")
    packing.add_argument("streets", type=Path, nargs="+")
    unpacking = commands.add_parser("unpack")
    unpacking.add_argument("file", type=Path)
    for command in (packing, unpacking):
        command.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.command == "pack":
        pack(options.streets, options.out)
    else:
        unpack(options.file, options.out)


def pack(streets: list[Path], out: Path) -> None:
    """Write one file of all samples of some streets' folders."""
    with whole_file(out) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        known: set[str] = set()
        for street in streets:
            files = sorted(street.glob("*.npz"))
            if not files:
                raise InputError("no samples", where=street, expected="a street's folder of DATA")
            for file in files:
                planes = {
                    name: _packed(archive, name, value, known)
                    for name, value in load_arrays(file, is_mapped=True).items()
                }
                index = {name: [p.blob, p.channels, p.high] for name, p in planes.items()}
                archive.writestr(f"{street.name}/{file.stem}.json", json.dumps(index))
            size_mb = sum(file.stat().st_size for file in files) / 1e6
            sys.stdout.write(f"{street.name}: {len(files)} samples, {size_mb:.1f} MB\n")
    sys.stdout.write(f"{out}: {out.stat().st_size / 1e6:.1f} MB\n")


def unpack(file: Path, out: Path) -> None:
    """Samples as `lightsim train prepare relight` writes them; those that are there stay."""
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            path = (out / name).with_suffix(".npz")
            if not name.endswith(".json") or path.exists():
                continue
            index = json.loads(archive.read(name))
            arrays = {k: _unpacked(archive, k, Plane(*v)) for k, v in index.items()}
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as temporary, temporary.open("wb") as handle:
                np.savez(handle, allow_pickle=False, **arrays)


def _packed(archive: zipfile.ZipFile, name: str, value: np.ndarray, known: set[str]) -> Plane:
    kind, high = _kind(name), 1.0
    if kind == "dome":
        data = value.astype(np.float16).tobytes()
    else:
        if name.endswith("truth"):
            codes = value
        else:
            numbers = np.nan_to_num(value.astype(np.float32))
            high = _high(numbers, kind)
            codes = np.rint(255 * _coded(numbers / high, kind)).astype(np.uint8)
        data = _picture(codes, is_lossless=kind not in ("light", "smooth"))
    blob = hashlib.sha256(data).hexdigest()[:24]
    if blob not in known:
        known.add(blob)
        archive.writestr(f"planes/{blob}", data)
    return Plane(blob, value.shape[0], high)


def _unpacked(archive: zipfile.ZipFile, name: str, plane: Plane) -> np.ndarray:
    data, kind = archive.read(f"planes/{plane.blob}"), _kind(name)
    if kind == "dome":
        rows = round((len(data) / 2 / plane.channels / 2) ** 0.5)
        return np.frombuffer(data, np.float16).reshape(plane.channels, rows, 2 * rows)
    with Image.open(io.BytesIO(data)) as picture:
        codes = np.moveaxis(np.asarray(picture.convert("RGB")), -1, 0)[: plane.channels]
    if name.endswith("truth"):
        return np.ascontiguousarray(codes)
    return (plane.high * _decoded(codes.astype(np.float32) / 255, kind)).astype(np.float16)


def _high(numbers: np.ndarray, kind: str) -> float:
    """What the code 255 stands for."""
    if kind not in ("light", "signed", "depth"):
        return 1.0
    largest = max(float(np.abs(numbers).max()), 1e-6)
    return min(largest, _BRIGHTEST) if kind == "light" else largest


def _kind(name: str) -> str:
    plane = name.rsplit("/", 1)[-1].removeprefix("source_").removeprefix("target_")
    if plane in ("dome", "depth"):
        return plane
    for kind, names in (("light", _LIGHT), ("signed", _SIGNED), ("smooth", _SMOOTH)):
        if plane in names:
            return kind
    return "mask"


def _coded(numbers: np.ndarray, kind: str) -> np.ndarray:
    """Codes in [0, 1] of numbers up to 1."""
    if kind in ("light", "depth"):
        return np.log1p(numbers.clip(0, 1) / _DARK) / np.log1p(1 / _DARK)
    return (numbers + 1) / 2 if kind == "signed" else numbers.clip(0, 1)


def _decoded(codes: np.ndarray, kind: str) -> np.ndarray:
    if kind in ("light", "depth"):
        return _DARK * np.expm1(codes * np.log1p(1 / _DARK))
    return 2 * codes - 1 if kind == "signed" else codes


def _picture(codes: np.ndarray, *, is_lossless: bool) -> bytes:
    """WebP of one or three channels."""
    rgb = np.moveaxis(np.broadcast_to(codes, (3, *codes.shape[1:])), 0, -1)
    buffer = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(rgb))
    picture.save(buffer, "WEBP", lossless=is_lossless, quality=_QUALITY, method=3, exact=True)
    return buffer.getvalue()


if __name__ == "__main__":
    main()
