"""The trivial baselines do exactly what they promise."""

from __future__ import annotations

import numpy as np

from lightsim_lab.baselines.colour_transfer_tables import (
    BASELINES,
    copy_source,
    lab_from_rgb,
    oracle_affine,
    oracle_reinhard,
    rgb_from_lab,
)


def image(rng: np.random.Generator, low: float = 0.3, high: float = 0.6) -> np.ndarray:
    return rng.uniform(low, high, (20, 30, 3)).astype(np.float32)


def test_copy_is_the_source(rng: np.random.Generator) -> None:
    source = image(rng)
    assert copy_source(source, image(rng)) is source


def test_affine_oracle_recovers_an_exact_affine_map(rng: np.random.Generator) -> None:
    """Also when the pixels outside the mask say something else."""
    source = image(rng)
    gain, offset = np.array([0.5, 1.2, 0.8]), np.array([0.2, -0.1, 0.05])
    target = (source * gain + offset).astype(np.float32)
    np.testing.assert_allclose(oracle_affine(source, target), target, atol=1e-6)
    is_valid = np.zeros((20, 30), bool)
    is_valid[5:] = True
    spoilt = target.copy()
    spoilt[:5] = 1.0
    np.testing.assert_allclose(oracle_affine(source, spoilt, is_valid), target, atol=1e-6)


def test_affine_oracle_of_a_flat_source_is_the_mean(rng: np.random.Generator) -> None:
    target = image(rng)
    made = oracle_affine(np.full_like(target, 0.5), target)
    np.testing.assert_allclose(made, np.broadcast_to(target.mean((0, 1)), made.shape), atol=1e-6)


def test_reinhard_matches_mean_and_deviation_in_its_space(rng: np.random.Generator) -> None:
    source, target = image(rng), image(rng, 0.25, 0.45)
    made, wanted = lab_from_rgb(oracle_reinhard(source, target)), lab_from_rgb(target)
    np.testing.assert_allclose(made.mean((0, 1)), wanted.mean((0, 1)), atol=1e-5)
    np.testing.assert_allclose(made.std((0, 1)), wanted.std((0, 1)), rtol=1e-4)


def test_lab_round_trip_and_grey_is_almost_neutral(rng: np.random.Generator) -> None:
    """The published matrices put white within 1 % of the alpha and beta axes' zero."""
    rgb = image(rng).astype(np.float64)
    np.testing.assert_allclose(rgb_from_lab(lab_from_rgb(rgb)), rgb, rtol=1e-9)
    grey = lab_from_rgb(np.full((1, 3), 0.5))
    assert np.abs(grey[0, 1:]).max() < 0.01


def test_every_baseline_keeps_shape_and_range(rng: np.random.Generator) -> None:
    for baseline in BASELINES.values():
        made = baseline(image(rng, 0.0, 1.0), image(rng, 0.0, 1.0), None)
        assert made.shape == (20, 30, 3)
        assert made.min() >= 0
        assert made.max() <= 1
