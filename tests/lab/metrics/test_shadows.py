"""Shadows read off pictures whose shadows are known."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask
from lightsim.core.colour import srgb8_from_linear
from lightsim_lab.metrics.left_shadows import score_left_shadows
from lightsim_lab.metrics.shadows import TrueShadows, count_shadows, score_shadows

REST = 0.25


def picture(rng_texture: np.ndarray, is_shadowed: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    light = np.where(is_shadowed, REST, 1.0)[..., None]
    return srgb8_from_linear((rng_texture * light * exposure).astype(np.float32))


def columns(first: int, last: int) -> np.ndarray:
    """A shadow over some of forty columns."""
    x = np.arange(40)
    return np.broadcast_to((x >= first) & (x < last), (30, 40))


@pytest.fixture
def texture(rng: np.random.Generator) -> np.ndarray:
    """Base colours from 0.2 to 0.7: more contrast than the shadow's."""
    return rng.uniform(0.2, 0.7, (30, 40, 1)).repeat(3, axis=2)


@pytest.fixture
def true() -> TrueShadows:
    is_decided = np.ones((30, 40), bool)
    is_decided[:5] = False
    return TrueShadows(columns(10, 20), is_decided, np.full((30, 40), REST, np.float32))


@pytest.mark.parametrize(
    ("shadow", "iou"), [((10, 20), 1.0), ((15, 25), 5 / 15), ((0, 0), 0.0), ((0, 40), 10 / 40)]
)
def test_intersection_over_union_of_a_shadow_beside_the_true_one(
    texture: np.ndarray, true: TrueShadows, shadow: tuple[int, int], iou: float
) -> None:
    truth = picture(texture, columns(10, 20))
    made = picture(texture, columns(*shadow))
    task = FrameTask("noon", "front", "00", lambda: truth, {"ours": lambda: made})
    (row,) = score_shadows([task], lambda task: true, FramesReport(()))
    assert row.pixels == 25 * 40
    assert row.iou == pytest.approx(iou)
    assert score_shadows([task], lambda task: None, FramesReport(())) == ()


def test_exposure_is_no_shadow(texture: np.ndarray, true: TrueShadows) -> None:
    truth, dark = (picture(texture, columns(10, 20), e) for e in (1.0, 0.3))
    assert count_shadows(dark, truth, true)[1:].tolist() != [250, 250, 250]
    assert count_shadows(dark, truth, true, 1 / 0.3).tolist() == [1000, 250, 250, 250]


def test_shadows_that_would_not_show_do_not_count(texture: np.ndarray, true: TrueShadows) -> None:
    weak = TrueShadows(true.is_shadowed, true.is_decided, np.full((30, 40), 0.9, np.float32))
    truth = picture(texture, columns(10, 20))
    assert count_shadows(truth, truth, weak).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("left", [0.0, 0.3, -0.2])
def test_what_is_left_of_a_shadow_is_told_whatever_texture_and_exposure(
    texture: np.ndarray, true: TrueShadows, left: float
) -> None:
    truth = srgb8_from_linear(texture.astype(np.float32))
    ghost = np.where(columns(10, 20), 1 - left, 1.0)[..., None]
    made = srgb8_from_linear((0.8 * texture * ghost).astype(np.float32))
    task = FrameTask("overcast", "front", "00", lambda: truth, {"ours": lambda: made})
    (row,) = score_left_shadows([task], lambda task: true)
    assert row.contrast == pytest.approx(left, abs=5e-3)
    # Ten columns of shadow, eight beside each of its edges.
    assert row.pixels == 25 * (10 + 16)
    assert score_left_shadows([task], lambda task: None) == ()
