"""Reader of glTF textures: pictures, samplers and texture coordinates.

Reference: Khronos glTF 2.0 specification, section 3.8; KHR_texture_transform, EXT_texture_webp,
KHR_texture_basisu, EXT_texture_avif, MSFT_texture_dds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from lightsim.errors import InputError
from lightsim.store.gltf_document import GltfCode, GltfDocument, extensions, whole
from lightsim.store.gltf_extensions import BASISU
from lightsim.store.images import decode_texture
from lightsim.store.primitives import MAX_TEXTURE_PIXELS, ImageTexture, Wrap

_WRAP_BY_CODE = {
    GltfCode.CLAMP_TO_EDGE: Wrap.CLAMP,
    GltfCode.MIRRORED_REPEAT: Wrap.MIRROR,
    GltfCode.REPEAT: Wrap.REPEAT,
}
# Extensions with a second picture that cannot be decoded here.
_OTHER_FORMATS = {
    BASISU: "KTX2 pictures (KHR_texture_basisu)",
    "EXT_texture_avif": "AVIF pictures (EXT_texture_avif)",
    "MSFT_texture_dds": "DDS pictures (MSFT_texture_dds)",
}
# Largest texture coordinate; beyond it, float64 numbers do not resolve a pixel.
LARGEST_UV = 1e9


class Textures:
    """Decoder of the pictures of one document, each decoded once."""

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self._pixels: dict[int, UInt8[np.ndarray, "h w _"] | str] = {}
        self._textures: dict[int, ImageTexture | str] = {}
        self._n_pixels = 0

    def texture(self, index: object) -> ImageTexture | str:
        """Return a texture, or a clause with the reason why its picture is not read."""
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
        """Yield the indices of a texture's pictures, the preferred one first."""
        if "EXT_texture_webp" in extensions(texture):
            yield whole(extensions(texture)["EXT_texture_webp"]["source"])
        if "source" in texture:
            yield whole(texture["source"])

    def _sampled(self, texture: dict[str, Any], pixels: UInt8[np.ndarray, "h w _"]) -> ImageTexture:
        sampler: dict[str, Any] = {}
        if "sampler" in texture:
            sampler = self._document.item("samplers", texture["sampler"])
        wrap = [_wrap(sampler.get(axis, GltfCode.REPEAT)) for axis in ("wrapS", "wrapT")]
        is_nearest = sampler.get("magFilter") == GltfCode.NEAREST
        return ImageTexture(pixels, (wrap[0], wrap[1]), is_nearest)

    def _picture(self, source: int) -> UInt8[np.ndarray, "h w _"] | str:
        """Return the pixels of a picture, or the reason why it is not read."""
        if source not in self._pixels:
            image = self._document.item("images", source)
            name = _shown(image, source)
            try:
                if self._n_pixels > MAX_TEXTURE_PIXELS:
                    raise ValueError(f"all pictures have more than {MAX_TEXTURE_PIXELS} pixels")
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
    """Apply KHR_texture_transform to texture coordinates: scale, then rotation, then offset.

    A rotation turns the coordinates (v downwards) counter-clockwise, like the extension's example
    and its sample viewer.
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
    """Return the number n of the attribute TEXCOORD_n that a texture uses."""
    transform = extensions(reference).get("KHR_texture_transform", {})
    return whole(transform.get("texCoord", reference.get("texCoord", 0)))


def _wrap(code: object) -> Wrap:
    if code not in _WRAP_BY_CODE:
        codes = sorted(int(known) for known in _WRAP_BY_CODE)
        raise ValueError(f"a sampler wraps by {str(code)[:20]}, not one of {codes}")
    return _WRAP_BY_CODE[code]  # type: ignore[index]


def _shown(image: dict[str, Any], source: int) -> str:
    """Return the name of a picture for notes."""
    uri = image.get("uri")
    name = uri if isinstance(uri, str) and not uri.startswith("data:") else image.get("name")
    return f"'{str(name)[:60]}'" if name else f"{source}"
