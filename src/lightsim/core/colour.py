"""Colour: the sRGB curve and luminance (CONVENTIONS: Colour and light)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped, UInt8

# Number of values that are coded at once: bounds the memory of intermediate results, which are
# several arrays of the size of the input.
_CHUNK = 1 << 20
# Luminance of linear sRGB (ITU-R BT.709-6, item 3.2).
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
# 8-bit code from which a channel counts as saturated: JPEG changes 255 by a few codes. Chosen;
# sensitivity not measured.
CLIPPED_CODE = 250


def srgb_from_linear(linear: Shaped[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Apply the sRGB transfer curve (IEC 61966-2-1); values are clipped to [0, 1] first."""
    x = np.clip(linear, 0.0, 1.0)
    # Both branches are computed for all values; the lower bound of the power avoids 0.
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-8), 1 / 2.4) - 0.055
    ).astype(np.float32)


def linear_from_srgb(srgb: Shaped[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Apply the inverse of the sRGB curve to values, clipped to [0, 1]."""
    x = np.clip(srgb, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4)).astype(np.float32)


# Look-up table: 8-bit pictures have 256 values, and a power costs more than a look-up.
_LINEAR_BY_CODE = linear_from_srgb(np.arange(256) / 255.0)


def linear_from_srgb8(srgb8: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return linear float32 values in [0, 1] of 8-bit sRGB codes."""
    return _LINEAR_BY_CODE[srgb8]


def srgb8_from_linear(linear: Shaped[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Return 8-bit sRGB codes, rounded to the nearest."""
    flat = linear.reshape(-1)
    codes = np.empty(flat.shape, np.uint8)
    for start in range(0, len(flat), _CHUNK):
        part = slice(start, start + _CHUNK)
        codes[part] = np.round(srgb_from_linear(flat[part]) * 255.0)
    return codes.reshape(linear.shape)


def luminance(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Return the relative luminance of linear sRGB, in the unit of the input."""
    return np.asarray(linear @ LUMINANCE_WEIGHTS)
