"""Noise leaves where it would be amplified, and nothing else does."""

import numpy as np
import pytest

from lightsim.relighting.physical.denoise import denoised_where_amplified, noise_std

SIGMA = 0.02


def _wall(rng: np.random.Generator | None) -> np.ndarray:
    """Bricks: two tones with sharp joints; the noise is even on the root."""
    row, column = np.mgrid[:60, :80]
    is_joint = (row % 8 == 0) | ((column + 6 * (row // 8 % 2)) % 12 == 0)
    root = np.where(is_joint, 0.25, 0.4)[..., None].repeat(3, axis=2)
    noise = 0.0 if rng is None else SIGMA * rng.standard_normal(root.shape)
    return np.square(root + noise).astype(np.float32)


def test_noise_is_measured_beside_texture(rng: np.random.Generator):
    flat = 0.5 + SIGMA * rng.standard_normal((90, 120, 3))
    assert noise_std(flat.astype(np.float32)) == pytest.approx(SIGMA, rel=0.05)
    assert noise_std(np.sqrt(_wall(rng))) == pytest.approx(SIGMA, rel=0.5)


def test_only_what_is_amplified_changes(rng: np.random.Generator):
    noisy, clean = _wall(rng), _wall(None)
    factor = np.ones(noisy.shape[:2], np.float32)
    assert denoised_where_amplified(noisy, factor) is noisy
    factor[:, 40:] = 4.0
    done = denoised_where_amplified(noisy, factor)
    np.testing.assert_array_equal(done[:, :40], noisy[:, :40])
    before, after = (np.sqrt(np.mean((x - clean)[:, 44:] ** 2)) for x in (noisy, done))
    assert after < 0.6 * before
    assert np.mean(done[:, 40:]) == pytest.approx(float(np.mean(clean[:, 40:])), rel=0.01)


def test_a_picture_without_noise_stays():
    clean = _wall(None)
    done = denoised_where_amplified(clean, np.full(clean.shape[:2], 8.0, np.float32))
    np.testing.assert_allclose(done, clean, atol=1e-6)


@pytest.mark.parametrize("where", [np.s_[30:32, 40:41], np.s_[:, 79:], np.s_[:1, :]])
def test_a_narrow_part_takes_its_surroundings_with_it(rng: np.random.Generator, where):
    """A part of one column once stopped relighting: the filter wants an area."""
    noisy = _wall(rng)
    factor = np.ones(noisy.shape[:2], np.float32)
    factor[where] = 4.0
    done = denoised_where_amplified(noisy, factor)
    is_changed = (done != noisy).any(axis=2)
    assert is_changed[where].any()
    assert not is_changed[factor == 1].any()
