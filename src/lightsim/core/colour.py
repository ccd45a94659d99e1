"""Colour: the sRGB curve and luminance (CONVENTIONS: Colour and light)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped, UInt8

_CHUNK = 1 << 20
"""Values coded together: the curve's intermediate results are six times as large as they are."""
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
# 8-bit code from which a channel counts as saturated: JPEG blurs 255 by a few codes. Not measured.
CLIPPED_CODE = 250


def srgb_from_linear(linear: Shaped[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The sRGB transfer curve (IEC 61966-2-1); values are clipped to [0, 1] first."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-8), 1 / 2.4) - 0.055
    ).astype(np.float32)


def linear_from_srgb(srgb: Shaped[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Inverse of the sRGB curve, for values in [0, 1]."""
    x = np.clip(srgb, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4)).astype(np.float32)


_LINEAR_BY_CODE = linear_from_srgb(np.arange(256) / 255.0)


def linear_from_srgb8(srgb8: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear float32 in [0, 1] of 8-bit sRGB codes."""
    return _LINEAR_BY_CODE[srgb8]


def srgb8_from_linear(linear: Shaped[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """8-bit sRGB codes, rounded to nearest."""
    flat = linear.reshape(-1)
    codes = np.empty(flat.shape, np.uint8)
    for start in range(0, len(flat), _CHUNK):
        part = slice(start, start + _CHUNK)
        codes[part] = np.round(srgb_from_linear(flat[part]) * 255.0)
    return codes.reshape(linear.shape)


def luminance(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Relative luminance of linear sRGB (weights of ITU-R BT.709), in the unit of the input."""
    return np.asarray(linear @ LUMINANCE_WEIGHTS)
