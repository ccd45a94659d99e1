"""Conversion of diffuse and specular colour to base colour and metallic factor.

Reference: KHR_materials_pbrSpecularGlossiness and its conversion in the Khronos glTF repository
(extensions/2.0/Archived). Unlike there, non-metals retain their diffuse colour, and a specular
colour in the range of non-metals does not give a metal.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from lightsim.core.colour import linear_from_srgb8, luminance, srgb8_from_linear
from lightsim.store.primitives import ImageTexture

# Reflectance of non-metals at normal incidence in the metallic-roughness model.
_DIELECTRIC = 0.04
# Specular reflectance up to which a surface is not a metal: diamond, the highest of usual
# non-metals, has 0.17. Chosen; sensitivity not measured.
_MAX_NON_METAL = 0.2
# Specular reflectance from which the metallic factor has full weight: the darkest usual metals have
# some 0.5. Chosen; sensitivity not measured.
_MIN_METAL = 0.4
# Number of rows of a picture that are converted at once; it bounds memory.
_ROWS = 256


def metal_from_specular(
    diffuse: Float64[np.ndarray, "*n 3"], specular: Float64[np.ndarray, "*n 3"]
) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
    """Return linear base colour and metallic factor of linear diffuse and specular colours."""
    bright, shiny = luminance(diffuse), luminance(specular)
    strength = specular.max(axis=-1)
    # Positive root of the quadratic equation of the Khronos conversion.
    b = bright * (1 - strength) / (1 - _DIELECTRIC) + shiny - 2 * _DIELECTRIC
    root = np.sqrt(np.maximum(b * b + 4 * _DIELECTRIC * (shiny - _DIELECTRIC), 0.0))
    metallic = np.clip((root - b) / (2 * _DIELECTRIC), 0.0, 1.0)
    metallic *= np.clip((strength - _MAX_NON_METAL) / (_MIN_METAL - _MAX_NON_METAL), 0.0, 1.0)
    m = metallic[..., None]
    of_diffuse = diffuse / np.maximum(1 - m, 1e-6)
    of_specular = (specular - _DIELECTRIC * (1 - m)) / np.maximum(m, 1e-6)
    return np.clip(of_diffuse * (1 - m**2) + of_specular * m**2, 0.0, 1.0), np.asarray(metallic)


def convert_pictures(
    diffuse: ImageTexture | None,
    diffuse_factor: Float64[np.ndarray, " 3"],
    specular: ImageTexture | None,
    specular_factor: Float64[np.ndarray, " 3"],
) -> tuple[ImageTexture, ImageTexture]:
    """Return pictures of base colour (with the alpha of `diffuse`) and metallic factor.

    Both pictures of the material have the same coordinates; the smaller one is enlarged.
    """
    first = diffuse if diffuse is not None else specular
    assert first is not None
    shapes = [texture.pixels.shape[:2] for texture in (diffuse, specular) if texture is not None]
    height, width = max(shapes, key=lambda shape: shape[0] * shape[1])
    base = np.empty((height, width, first.pixels.shape[2] if diffuse is not None else 3), np.uint8)
    metal = np.empty((height, width, 1), np.uint8)
    for start in range(0, height, _ROWS):
        rows = np.arange(start, min(start + _ROWS, height))
        of_diffuse = _enlarged(diffuse, rows, height, width)
        of_specular = _enlarged(specular, rows, height, width)
        colour, metallic = metal_from_specular(
            _linear(of_diffuse) * diffuse_factor, _linear(of_specular) * specular_factor
        )
        base[rows, :, :3] = srgb8_from_linear(colour.astype(np.float32))
        if base.shape[2] == 4:
            base[rows, :, 3] = of_diffuse[..., 3]
        metal[rows, :, 0] = np.rint(metallic * 255)
    return (
        ImageTexture(base, first.wrap, first.is_nearest),
        ImageTexture(metal, first.wrap, first.is_nearest),
    )


def _enlarged(
    texture: ImageTexture | None, rows: np.ndarray, height: int, width: int
) -> UInt8[np.ndarray, "r w _"]:
    if texture is None:
        return np.full((len(rows), width, 3), 255, np.uint8)
    h, w = texture.pixels.shape[:2]
    return texture.pixels[(rows * h // height)[:, None], np.arange(width) * w // width]


def _linear(pixels: UInt8[np.ndarray, "r w _"]) -> Float32[np.ndarray, "r w 3"]:
    return linear_from_srgb8(pixels[..., :3]).astype(np.float32)
