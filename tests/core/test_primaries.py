"""Colour spaces: published matrices, white, and numbers that are no colour space."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.primaries import (
    CIE_XYZ,
    SRGB,
    Primaries,
    are_srgb,
    luminance_weights,
    name_of_primaries,
    primaries_of_name,
    srgb_from_primaries,
)


def space(name: str) -> Primaries:
    found = primaries_of_name(name)
    assert found is not None
    return found


D65_XYZ = np.array([0.3127 / 0.3290, 1.0, (1 - 0.3127 - 0.3290) / 0.3290])
PUBLISHED = {
    # IEC 61966-2-1, 4 digits.
    "CIE XYZ": (CIE_XYZ, [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415],
                          [0.0557, -0.2040, 1.0570]]),
    # ITU-R BT.2087-0, annex 2.
    "Rec.2020": (space("lin_rec2020_scene"),
                 [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083],
                  [-0.0182, -0.1006, 1.1187]]),
    # Academy TB-2014-004 (Bradford).
    "ACES2065-1": (space("lin_ap0_scene"),
                   [[2.5217, -1.1341, -0.3876], [-0.2765, 1.3727, -0.0962],
                    [-0.0154, -0.1530, 1.1684]]),
    "ACEScg": (space("lin_ap1_scene"),
               [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0106],
                [-0.0240, -0.1290, 1.1530]]),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_matrices_are_the_published_ones(name: str) -> None:
    primaries, expected = PUBLISHED[name]
    np.testing.assert_allclose(srgb_from_primaries(primaries), expected, atol=1.2e-3)
    assert name_of_primaries(primaries) == name
    assert not are_srgb(primaries)


@pytest.mark.parametrize(
    "name",
    [
        "lin_rec709_scene",
        "ACEScg",
        "lin_ap0",
        "lin_rec2020",
        "lin_p3d65_scene",
        "lin_adobergb_scene",
    ],
)
def test_white_stays_white(name: str) -> None:
    matrix = srgb_from_primaries(space(name))
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


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("ACEScg", "acescg", "ACES - ACEScg", "lin_ap1", "lin_ap1_scene", "Linear AP1"), "ACEScg"),
        (("ACES2065-1", "ACES - ACES2065-1", "lin_ap0_scene"), "ACES2065-1"),
        (("Linear Rec.2020", "Utility - Linear - Rec.2020", "lin_rec2020", "Linear BT.2020"),
         "Rec.2020"),
        (("Linear P3-D65", "Linear DCI-P3 D65", "lin_p3d65_scene"), "P3-D65"),
        (("Linear AdobeRGB", "Utility - Linear - AdobeRGB", "lin_adobergb"), "Adobe RGB"),
        (("Linear CIE-XYZ D65", "lin_ciexyzd65_scene"), "CIE XYZ"),
    ],
)  # fmt: skip
def test_a_space_has_many_names(names: tuple[str, ...], expected: str) -> None:
    assert {name_of_primaries(space(name)) for name in names} == {expected}


def test_linear_srgb_has_many_names() -> None:
    for name in ("Linear Rec.709 (sRGB)", "lin_rec709", "lin_srgb", "Utility - Linear - sRGB"):
        assert space(name) == SRGB


@pytest.mark.parametrize("name", ["sRGB", "g22_rec709_scene", "Rec709", "ACEScct", "ACES", ""])
def test_spaces_with_a_curve_are_not_linear(name: str) -> None:
    assert primaries_of_name(name) is None
