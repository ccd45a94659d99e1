"""What error is expected: the network's word, times contrast, disagreement with the twin, and doubt
about the sun, each to its power."""

from __future__ import annotations

import pytest
import torch

from lightsim.relighting.network.expected_error import POWERS, expected_error
from lightsim.relighting.network.features import srgb_of
from lightsim.relighting.network.model import Correction

ROWS, COLUMNS = 20, 30


def expected(
    picture: torch.Tensor,
    modelled: torch.Tensor | None = None,
    log_error: float = -4.0,
    sun: float = 1.0,
) -> torch.Tensor:
    """Of a linear picture, where the twin's rendering is the same or another one, and so much of
    the target's sun is seen."""
    modelled = picture if modelled is None else modelled
    working = {
        "source": torch.zeros(1, 3, ROWS, COLUMNS),
        "base_colour": torch.ones(1, 3, ROWS, COLUMNS),
        "target_shaded": modelled,
        "target_reflected": torch.zeros(1, 3, ROWS, COLUMNS),
        "target_sun": torch.full((1, 1, ROWS, COLUMNS), sun),
    }
    found = Correction(picture, torch.full((1, 1, ROWS // 2, COLUMNS // 2), log_error))
    return expected_error(found, working)


def test_edges_are_expected_to_be_wrong() -> None:
    picture = torch.full((1, 3, ROWS, COLUMNS), 0.1)
    picture[..., 20:] = 0.8
    error = expected(picture)[0, 0]
    # Contrast reaches two pixels, one here.
    torch.testing.assert_close(error[:, :8], error[:1, :1].expand(ROWS // 2, 8))
    contrast = float(srgb_of(torch.tensor(0.8)) - srgb_of(torch.tensor(0.1)))
    ratio = ((contrast + 0.02) / 0.02) ** POWERS[1]
    assert float(error[0, 9] / error[0, 0]) == pytest.approx(ratio, rel=1e-3)


def test_disagreement_with_the_twin_is_doubt() -> None:
    picture = torch.full((1, 3, ROWS, COLUMNS), 0.3)
    agreed, near, far = (expected(picture, picture * f) for f in (1.0, 1.1, 2.0))
    for error, factor in ((near, 1.1), (far, 2.0)):
        gap = float(srgb_of(torch.tensor(0.3 * factor)) - srgb_of(torch.tensor(0.3)))
        ratio = ((gap + 0.02) / 0.02) ** POWERS[2]
        torch.testing.assert_close(error / agreed, torch.full_like(error, ratio))


def test_the_networks_word_is_a_factor() -> None:
    picture = torch.rand((1, 3, ROWS, COLUMNS), generator=torch.Generator().manual_seed(0))
    low, high = (expected(picture, log_error=value) for value in (-5.0, -4.0))
    torch.testing.assert_close(high / low, torch.full_like(low, torch.e ** POWERS[0]))
    assert expected(picture, log_error=3.0).max() <= 1


def test_a_sun_that_is_half_seen_is_doubt() -> None:
    picture = torch.full((1, 3, ROWS, COLUMNS), 0.3)
    seen, half, hidden = (expected(picture, sun=part) for part in (1.0, 0.5, 0.0))
    torch.testing.assert_close(seen, hidden)
    torch.testing.assert_close(half / seen, torch.full_like(seen, 3 ** POWERS[3]))


def test_larger_pictures_are_brought_to_the_working_size() -> None:
    small = torch.rand((1, 3, ROWS, COLUMNS), generator=torch.Generator().manual_seed(1))
    # Codes are averaged, and those of a block are the same.
    large = small.repeat_interleave(4, 2).repeat_interleave(4, 3)
    torch.testing.assert_close(expected(large, small), expected(small))
