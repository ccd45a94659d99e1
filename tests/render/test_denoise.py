"""Open Image Denoise through pyoidn."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.errors import InputError, MissingDependencyError
from lightsim.render.denoise import denoise


def _noisy(rng):
    """Two plates that meet at an edge, under noise of 30 %."""
    normal = np.zeros((64, 96, 3), np.float32)
    normal[:, :48, 2] = normal[:, 48:, 0] = 1
    clean = np.where(normal[..., :1] > 0, np.float32(0.3), np.float32(2.0)) * np.ones(3, np.float32)
    noisy = clean * rng.gamma(11.0, 1 / 11.0, (64, 96, 1)).astype(np.float32)
    return clean, noisy, normal


def test_noise_goes_and_edges_stay(rng):
    pytest.importorskip("pyoidn", reason="needs the extra `denoise`")
    clean, noisy, normal = _noisy(rng)
    out = denoise(noisy, np.ones_like(noisy), normal)
    assert np.abs(out / clean - 1).mean() < 0.15 * np.abs(noisy / clean - 1).mean()
    np.testing.assert_allclose(out[:, [45, 50]].mean(0), clean[:, [45, 50]].mean(0), rtol=0.05)
    np.testing.assert_allclose(
        denoise(1e4 * noisy, np.ones_like(noisy), normal) / 1e4, out, rtol=0.1
    )


def test_infinite_values_are_refused(rng):
    pytest.importorskip("pyoidn", reason="needs the extra `denoise`")
    _, noisy, normal = _noisy(rng)
    noisy[3, 4] = np.inf
    with pytest.raises(InputError, match="infinite"):
        denoise(noisy, np.ones_like(noisy), normal)


def test_the_remedy_is_named(monkeypatch, rng):
    monkeypatch.setitem(__import__("sys").modules, "pyoidn", None)
    _, noisy, normal = _noisy(rng)
    with pytest.raises(MissingDependencyError, match=r"lightsim\[denoise\]"):
        denoise(noisy, np.ones_like(noisy), normal)
