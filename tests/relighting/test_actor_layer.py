"""Layers of rendered actors over recorded backgrounds, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.relighting.physical.actor_layer import ActorLayer, as_recorded, cut_out
from lightsim.relighting.physical.blur_noise import CameraBlurNoise, blurred, sharpened

H, W = 40, 60
GAIN = np.array([1.1, 1.0, 0.9], np.float32)
ACTOR, BEHIND = np.array([0.6, 0.3, 0.2], np.float32), np.array([0.1, 0.2, 0.15], np.float32)
BOX = slice(12, 28), slice(20, 40)


def flat(rgb: np.ndarray) -> np.ndarray:
    return np.tile(rgb, (H, W, 1))


def covered(part: tuple[slice, slice] = BOX) -> np.ndarray:
    coverage = np.zeros((H, W), np.float32)
    coverage[part] = 1.0
    return coverage


def layer_of(coverage: np.ndarray) -> ActorLayer:
    return ActorLayer(coverage[..., None] * ACTOR, coverage)


def nowhere_moving(part: tuple[slice, slice] = BOX, motion: tuple[float, float] = (0, 0)):
    moved = np.full((H, W, 2), np.nan, np.float32)
    moved[part] = motion
    return moved


def test_an_actor_is_cut_out_of_its_background_and_put_over_another() -> None:
    """Also where the few samples of a rendered edge show more or less of it than its coverage."""
    coverage, sampled = covered(), covered()
    coverage[BOX[0], 20], sampled[BOX[0], 20] = 0.4375, 0.25
    coverage[BOX[0], 39], sampled[BOX[0], 39] = 0.5625, 0.75
    coverage[BOX[0], 40] = 0.125
    rendered = sampled[..., None] * ACTOR + (1 - sampled[..., None]) * BEHIND
    other = flat(np.array([0.4, 0.5, 0.7], np.float32))
    everywhere = np.ones_like(coverage, dtype=bool)
    made = cut_out(rendered, sampled, coverage, everywhere).over(other, CameraBlurNoise(), GAIN)
    wanted = coverage[..., None] * ACTOR + (1 - coverage[..., None]) * other
    np.testing.assert_allclose(made, wanted, atol=1e-6)
    assert (made[coverage == 0] == other[coverage == 0]).all()


@pytest.mark.parametrize("motion", [6.0, -6.0])
def test_a_moving_actor_fades_in_and_out_over_its_motion(motion: float) -> None:
    """Its coverage is that of the box, meaned over the exposure: a ramp as wide as the motion."""
    made = as_recorded(layer_of(covered()), CameraBlurNoise(), nowhere_moving(motion=(motion, 0.0)))
    u = np.arange(W) + 0.5
    wanted = np.clip((u - 17) / 6, 0, 1) * np.clip((43 - u) / 6, 0, 1)
    np.testing.assert_allclose(made.coverage[20], wanted, atol=0.02)
    assert made.coverage[[10, 29]].max() == 0
    np.testing.assert_allclose(made.radiance, made.coverage[..., None] * ACTOR, atol=1e-6)
    assert made.coverage.sum() == pytest.approx(covered().sum(), rel=1e-3)


def test_an_actor_that_stands_in_the_picture_stays_as_it_is() -> None:
    made = as_recorded(layer_of(covered()), CameraBlurNoise(), nowhere_moving(motion=(0.1, 0.1)))
    assert (made.coverage == covered()).all()


def test_blur_is_that_of_the_whole_picture() -> None:
    """Blurring the layer and blurring a picture of both are one over an even background."""
    blur_noise = CameraBlurNoise(spread_px2=1.0)
    made = as_recorded(layer_of(covered()), blur_noise, nowhere_moving()).over(
        flat(BEHIND), blur_noise, GAIN
    )
    sharp = layer_of(covered()).over(flat(BEHIND), CameraBlurNoise(), GAIN)
    np.testing.assert_allclose(made, blurred(sharp, blur_noise), atol=1e-4)


def test_sharpening_is_that_of_the_whole_picture_and_ends_beside_the_actor() -> None:
    blur_noise = CameraBlurNoise(spread_px2=-0.25)
    made = layer_of(covered()).over(flat(BEHIND), blur_noise, GAIN)
    plain = layer_of(covered()).over(flat(BEHIND), CameraBlurNoise(), GAIN)
    wanted = linear_from_srgb(sharpened(srgb_from_linear(plain * GAIN), blur_noise)) / GAIN
    np.testing.assert_allclose(made, wanted, atol=1e-5)
    assert abs(made - plain).max() > 0.02
    far = np.ones((H, W), bool)
    far[11:29, 19:41] = False
    assert (made[far] == plain[far]).all()
