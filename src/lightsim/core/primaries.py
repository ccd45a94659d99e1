"""RGB primaries: from the CIE chromaticities of a file to linear sRGB (ITU-R BT.709, white D65).

The matrix of a colour space from its chromaticities is that of SMPTE RP 177-1993; white points are
adapted by the linear Bradford transform (ICC.1:2022, annex E; B. Lindbloom, "Chromatic
Adaptation"). CIE XYZ values are colours themselves, under no white: they are not adapted.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Primaries = tuple[float, ...]
"""Eight CIE 1931 chromaticities: x and y of red, green, blue and white."""
SRGB: Primaries = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""ITU-R BT.709-6, table 1.3; IEC 61966-2-1."""
CIE_XYZ: Primaries = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
"""Tristimulus values X, Y, Z in the place of R, G, B; their unit is written as white E."""
ACES_AP0: Primaries = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
"""SMPTE ST 2065-1."""
# Academy S-2014-004.
_ACES_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
# White of sRGB.
_D65 = SRGB[6:]
# Names for notes; the numbers alone decide. ACES: SMPTE ST 2065-1, Academy S-2014-004; ITU-R
# BT.2020; SMPTE EG 432-1 and RP 431-2; Adobe RGB (1998); Radiance's color.h.
_NAMED: dict[str, Primaries] = {
    "ACES2065-1": ACES_AP0,
    "ACEScg": _ACES_AP1,
    "CIE XYZ": CIE_XYZ,
    "Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "P3-D65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "DCI-P3": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    "Adobe RGB": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
    "Radiance RGB": (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 1 / 3, 1 / 3),
}
# Linear spaces by the name that `primaries_of_name` reduces names to. Color Interop Forum ("Color
# Space Encodings for Texture Assets and CG Rendering", 2024): lin_ap1_scene; OpenColorIO's ACES
# configurations: ACEScg, "ACES - ACEScg", "Utility - Linear - Rec.2020"; Blender: "Linear
# Rec.2020".
_BY_NAME: dict[str, Primaries] = {
    **dict.fromkeys(("rec709", "bt709", "srgb", "rec709srgb"), SRGB),
    **dict.fromkeys(("ap0", "aces20651"), ACES_AP0),
    **dict.fromkeys(("ap1", "acescg"), _ACES_AP1),
    **dict.fromkeys(("rec2020", "bt2020"), _NAMED["Rec.2020"]),
    **dict.fromkeys(("p3d65", "dcip3d65"), _NAMED["P3-D65"]),
    "adobergb": _NAMED["Adobe RGB"],
    "ciexyzd65": CIE_XYZ,
}
# Spaces whose names need no word for linear.
_ALWAYS_LINEAR = ("acescg", "aces20651")
# Chromaticities this close are equal: standards round to 4 digits, some write D65 with 5.
_SAME = 2e-4
# For names in notes: Radiance files hold 3 digits.
_NAME_TOLERANCE = 2e-3
# Beyond any primary in use; ACES AP0 has a y of -0.077, camera spaces have x up to 1.
_LARGEST = 2.0
# Largest coefficient that is accepted; ACES AP0, the widest space in use, has 2.5.
_MAX_GAIN = 100.0
# XYZ to cone responses (ICC.1:2022, annex E).
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def are_srgb(primaries: Sequence[float]) -> bool:
    """Return whether colours with these primaries are linear sRGB as they are."""
    return _are_same(primaries, SRGB, _SAME)


def name_of_primaries(primaries: Sequence[float]) -> str:
    """Return the usual name of a colour space, or its chromaticities where it has none."""
    for name, known in _NAMED.items():
        if _are_same(primaries, known, _NAME_TOLERANCE):
            return name
    return "primaries " + " ".join(f"{value:.4g}" for value in primaries)


def primaries_of_name(name: str) -> Primaries | None:
    """Return the primaries of a linear colour space by one of its usual names; None if unknown.

    Case, punctuation, the role "scene" and the group "Utility" or "ACES" are ignored.
    """
    words = re.findall("[a-z0-9]+", name.lower())
    key = "".join(word for word in words if word not in ("utility", "scene", "lin", "linear"))
    # "ACES - ACEScg" names the group first, "ACES2065-1" has no group.
    key = key.removeprefix("aces") if key.startswith("acesaces") else key
    is_linear = key in _ALWAYS_LINEAR or not {"lin", "linear"}.isdisjoint(words)
    return _BY_NAME.get(key) if is_linear else None


def srgb_from_primaries(primaries: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that converts linear colours (columns) to linear sRGB.

    White stays white, except of CIE XYZ, whose colours stay what they are (white D65 becomes 1, 1,
    1).

    Args:
        primaries: x and y of red, green, blue and white.

    Raises:
        ValueError: they are not eight numbers that span a colour space.
    """
    xyz = xyz_from_primaries(primaries)
    if not _are_same(primaries, CIE_XYZ, _SAME):
        xyz = _adaptation(_white(primaries), _white(SRGB)) @ xyz
    matrix = np.linalg.solve(xyz_from_primaries(SRGB), xyz)
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > _MAX_GAIN:
        raise ValueError(f"the primaries {_spelt(primaries)} span no colour space")
    return matrix


def luminance_weights(primaries: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Return the weights of red, green and blue in the luminance Y; they sum to 1.

    Raises:
        ValueError: as `srgb_from_primaries`.
    """
    return xyz_from_primaries(primaries)[1]


def xyz_from_primaries(primaries: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear RGB to CIE XYZ, with Y = 1 for white.

    Raises:
        ValueError: as `srgb_from_primaries`.
    """
    values = np.asarray(primaries, dtype=np.float64)
    problem = f"the primaries {_spelt(primaries)} span no colour space"
    if values.shape != (8,) or not np.isfinite(values).all() or np.abs(values).max() > _LARGEST:
        raise ValueError(problem)
    x, y = values[:6:2], values[1:6:2]
    columns = np.stack([x, y, 1.0 - x - y])
    if abs(np.linalg.det(columns)) < 1.0 / _MAX_GAIN**2:
        raise ValueError(problem)
    scales = np.linalg.solve(columns, _white(primaries))
    # White lies within the triangle of the primaries, else no light of them is white.
    if not (scales > 0).all() or scales.max() > _MAX_GAIN:
        raise ValueError(problem)
    return columns * scales


def _are_same(primaries: Sequence[float], others: Sequence[float], tolerance: float) -> bool:
    return bool(np.abs(np.subtract(primaries, others)).max() < tolerance)


def _white(primaries: Sequence[float]) -> Float[np.ndarray, "3"]:
    """XYZ of white, Y = 1."""
    x, y = primaries[6:]
    if not y > 1.0 / _MAX_GAIN:
        raise ValueError(f"the white point {x:g}, {y:g} is no colour of light")
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


def _adaptation(
    white: Float[np.ndarray, "3"], wanted: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """XYZ under one white to XYZ under another (linear Bradford)."""
    cones, cones_wanted = _BRADFORD @ white, _BRADFORD @ wanted
    if not (cones > 0).all():
        raise ValueError("the white point is no colour of light")
    return np.linalg.solve(_BRADFORD, (cones_wanted / cones)[:, None] * _BRADFORD)


def _spelt(primaries: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in primaries)
