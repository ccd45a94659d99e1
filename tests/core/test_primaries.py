"""Colour spaces: published matrices, white, and numbers that are no colour space."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.primaries import (
    BY_INTEROP_ID,
    CIE_XYZ,
    SRGB,
    are_srgb,
    luminance_weights,
    name_of_primaries,
    srgb_from_primaries,
)

D65_XYZ = np.array([0.3127 / 0.3290, 1.0, (1 - 0.3127 - 0.3290) / 0.3290])
PUBLISHED = {
    # IEC 61966-2-1, 4 digits.
    "CIE XYZ": (CIE_XYZ, [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415],
                          [0.0557, -0.2040, 1.0570]]),
    # ITU-R BT.2087-0, annex 2.
    "Rec.2020": (BY_INTEROP_ID["lin_rec2020_scene"],
                 [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083],
                  [-0.0182, -0.1006, 1.1187]]),
    # Academy TB-2014-004 (Bradford).
    "ACES2065-1": (BY_INTEROP_ID["lin_ap0_scene"],
                   [[2.5217, -1.1341, -0.3876], [-0.2765, 1.3727, -0.0962],
                    [-0.0154, -0.1530, 1.1684]]),
    "ACEScg": (BY_INTEROP_ID["lin_ap1_scene"],
               [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0106],
                [-0.0240, -0.1290, 1.1530]]),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_matrices_are_the_published_ones(name: str) -> None:
    primaries, expected = PUBLISHED[name]
    np.testing.assert_allclose(srgb_from_primaries(primaries), expected, atol=1.2e-3)
    assert name_of_primaries(primaries) == name
    assert not are_srgb(primaries)


@pytest.mark.parametrize("name", sorted(set(BY_INTEROP_ID) - {"lin_ciexyzd65_scene"}))
def test_white_stays_white(name: str) -> None:
    matrix = srgb_from_primaries(BY_INTEROP_ID[name])
    np.testing.assert_allclose(matrix @ np.ones(3), np.ones(3), atol=1e-12)


def test_colours_in_xyz_stay_what_they_are() -> None:
    np.testing.assert_allclose(srgb_from_primaries(CIE_XYZ) @ D65_XYZ, np.ones(3), atol=1e-12)
    np.testing.assert_allclose(luminance_weights(SRGB), LUMINANCE_WEIGHTS, atol=2e-4)


@pytest.mark.parametrize("scale", [1.0, 1.0 + 1e-7])
def test_srgb_is_known_by_its_numbers(scale: float) -> None:
    rounded = tuple(float(np.float32(value * scale)) for value in SRGB)
    assert are_srgb(rounded)
    np.testing.assert_allclose(srgb_from_primaries(rounded), np.eye(3), atol=1e-5)
    assert not are_srgb((*SRGB[:6], 1 / 3, 1 / 3))


@pytest.mark.parametrize(
    "primaries",
    [
        (0.0,) * 8,
        (0.3,) * 8,
        (*SRGB[:6], 0.3127, 0.0),
        (*SRGB[:6], 0.9, 0.1),
        (*SRGB[:4], *SRGB[2:4], *SRGB[6:]),
        (np.nan, *SRGB[1:]),
        (1e30, *SRGB[1:]),
        SRGB[:7],
    ],
)
def test_numbers_that_are_no_colour_space(primaries: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"primaries|white point"):
        srgb_from_primaries(primaries)
