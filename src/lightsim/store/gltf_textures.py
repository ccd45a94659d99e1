"""Pictures of a glTF file, how they repeat, and where they lie on a surface.

Reference: Khronos glTF 2.0 specification, section 3.8; KHR_texture_transform, EXT_texture_webp,
KHR_texture_basisu, EXT_texture_avif, MSFT_texture_dds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from lightsim.errors import InputError
from lightsim.store.gltf_document import GltfDocument, extensions, whole
from lightsim.store.gltf_extensions import BASISU
from lightsim.store.images import decode_texture
from lightsim.store.primitives import ImageTexture, Wrap

_WRAP_BY_CODE = {33071: Wrap.CLAMP, 33648: Wrap.MIRROR, 10497: Wrap.REPEAT}
_NEAREST = 9728
_PREFERRED = ("EXT_texture_webp",)
_OTHER_FORMATS = {
    BASISU: "KTX2 pictures (KHR_texture_basisu)",
    "EXT_texture_avif": "AVIF pictures (EXT_texture_avif)",
    "MSFT_texture_dds": "DDS pictures (MSFT_texture_dds)",
}
LARGEST_UV = 1e9
"""Largest texture coordinate: beyond it, float64 numbers do not resolve a pixel."""
_MAX_PIXELS = 1 << 28
"""Of all pictures of a file together; as RGBA they take a gigabyte. A model of a car with four
pictures of 8192 x 8192 px just fits."""


class Textures:
    """Decodes the pictures of one document, each once."""

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self._pixels: dict[int, UInt8[np.ndarray, "h w _"] | str] = {}
        self._textures: dict[int, ImageTexture | str] = {}
        self._n_pixels = 0

    def texture(self, index: object) -> ImageTexture | str:
        """Return a texture, or the reason, as a clause, why its picture is not read."""
        number = whole(index)
        if number not in self._textures:
            self._textures[number] = self._read(self._document.item("textures", number))
        return self._textures[number]

    def _read(self, texture: dict[str, Any]) -> ImageTexture | str:
        reasons = [f"{what} are not read" for name, what in _OTHER_FORMATS.items()
                   if name in extensions(texture)]  # fmt: skip
        for source in self._sources(texture):
            pixels = self._picture(source)
            if not isinstance(pixels, str):
                return self._sampled(texture, pixels)
            reasons.insert(0, pixels)
        return reasons[0] if reasons else "a texture without a picture is not read"

    def _sources(self, texture: dict[str, Any]) -> Iterator[int]:
        """Indices of pictures, the preferred one first."""
        for name in _PREFERRED:
            if name in extensions(texture):
                yield whole(extensions(texture)[name]["source"])
        if "source" in texture:
            yield whole(texture["source"])

    def _sampled(self, texture: dict[str, Any], pixels: UInt8[np.ndarray, "h w _"]) -> ImageTexture:
        sampler: dict[str, Any] = {}
        if "sampler" in texture:
            sampler = self._document.item("samplers", texture["sampler"])
        wrap = (_wrap(sampler.get("wrapS", 10497)), _wrap(sampler.get("wrapT", 10497)))
        return ImageTexture(pixels, wrap, sampler.get("magFilter") == _NEAREST)

    def _picture(self, source: int) -> UInt8[np.ndarray, "h w _"] | str:
        """Pixels, or why there are none."""
        if source not in self._pixels:
            image = self._document.item("images", source)
            name = _shown(image, source)
            try:
                if self._n_pixels > _MAX_PIXELS:
                    raise ValueError(f"all pictures together have more than {_MAX_PIXELS} pixels")
                pixels = decode_texture(self._bytes(image))
                self._n_pixels += pixels.shape[0] * pixels.shape[1]
                self._pixels[source] = pixels
            except InputError as error:
                found = f", {error.got}" if error.got is not None else ""
                self._pixels[source] = f"picture {name} is not read ({error.what}{found})"
            except ValueError as error:
                self._pixels[source] = f"picture {name} is not read ({error})"
        return self._pixels[source]

    def _bytes(self, image: dict[str, Any]) -> bytes:
        if "bufferView" in image:
            return bytes(self._document.view(image["bufferView"])[0])
        return self._document.resource(image.get("uri"), "picture")


def coordinates(
    uv: Float64[np.ndarray, "n 2"], reference: dict[str, Any]
) -> Float64[np.ndarray, "n 2"]:
    """Return coordinates after KHR_texture_transform: scale, then rotation, then offset.

    A rotation turns the coordinates (v downwards) counter-clockwise, as the extension's example
    and its sample viewer do.
    """
    transform = extensions(reference).get("KHR_texture_transform")
    if transform is None:
        return uv
    scale = np.array(transform.get("scale", [1.0, 1.0]), np.float64).reshape(2)
    offset = np.array(transform.get("offset", [0.0, 0.0]), np.float64).reshape(2)
    angle = float(transform.get("rotation", 0.0))
    cos, sin = np.cos(angle), np.sin(angle)
    moved = (uv * scale) @ np.array([[cos, -sin], [sin, cos]]) + offset
    if not (np.abs(moved) <= LARGEST_UV).all():
        raise ValueError("a texture transform is not finite or too large")
    return moved


def coordinate_set(reference: dict[str, Any]) -> int:
    """Return n of the TEXCOORD_n that a texture uses."""
    transform = extensions(reference).get("KHR_texture_transform", {})
    return whole(transform.get("texCoord", reference.get("texCoord", 0)))


def _wrap(code: object) -> Wrap:
    if code not in _WRAP_BY_CODE:
        raise ValueError(f"a sampler wraps by {str(code)[:20]}, not one of {sorted(_WRAP_BY_CODE)}")
    return _WRAP_BY_CODE[code]  # type: ignore[index]


def _shown(image: dict[str, Any], source: int) -> str:
    """Name of a picture for people."""
    uri = image.get("uri")
    name = uri if isinstance(uri, str) and not uri.startswith("data:") else image.get("name")
    return f"'{str(name)[:60]}'" if name else f"{source}"
