"""Weighted medians against plain ones of repeated values."""

from __future__ import annotations

import numpy as np

from lightsim.core.statistics import weighted_median


def test_a_weighted_median_is_that_of_repeated_values(rng: np.random.Generator) -> None:
    values, weight = rng.standard_normal((40, 3)), rng.integers(0, 5, 40)
    weight[0] += 1 - weight.sum() % 2
    repeated = np.median(np.repeat(values, weight, axis=0), axis=0)
    np.testing.assert_array_equal(weighted_median(values, weight), repeated)
