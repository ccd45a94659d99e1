"""Standard errors of means over frames of several sequences, and tests of two methods.

Frames of one sequence are similar and not independent. Means therefore have the cluster-robust
standard error over sequences, and tests resample sequences instead of frames if there are enough.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Shaped
from scipy.stats import rankdata

from lightsim.errors import InputError

Unit = Literal["sequences", "frames"]
"""Unit that counts as independent."""
# Conventional level of significance.
SIGNIFICANT_BELOW = 0.05
# Least number of sequences with which the signed-rank test can reach p < 0.05: the smallest
# two-sided p-value of n differences is 2 / 2**n.
_FEWEST_SEQUENCES = 6
# Resamples of the bootstrap: for normal means, interval limits then vary by 0.7 % of the interval
# (standard error of a quantile).
_DRAWS = 10_000
Samples = Mapping[tuple[Any, str], float]
"""Values by (sequence, frame)."""


@dataclass(frozen=True)
class Spread:
    """Mean with its standard error, which is NaN for a single value.

    Args:
        count: number of units.
        unit: sequences, or the frames of a single sequence.
    """

    mean: float
    standard_error: float
    count: int
    unit: Unit

    def format(self, digits: int) -> str:
        """Return "mean" or "mean ± standard error"; a dash without values."""
        if np.isnan(self.mean):
            return "-"
        text = f"{self.mean:.{digits}f}"
        return (
            text if np.isnan(self.standard_error) else f"{text} ± {self.standard_error:.{digits}f}"
        )


@dataclass(frozen=True)
class PairedDifference:
    """Difference of two methods, second minus first, on their common frames.

    Args:
        low, high: 95 % interval of the mean difference, by bootstrap over the units.
        p_value: two-sided p-value of Wilcoxon's signed-rank test over the units; 1 for equal
            values, NaN for too few units.
    """

    first: float
    second: float
    difference: float
    low: float
    high: float
    p_value: float
    count: int
    unit: Unit


def clustered_mean(samples: Samples) -> Spread:
    """Return the mean over all frames, with the standard error over sequences (Liang & Zeger 1986,
    doi:10.1093/biomet/73.1.13, of a mean), or over frames for a single sequence.

    Raises:
        InputError: there is no value.
    """
    _need(samples)
    values = np.array(list(samples.values()), dtype=np.float64)
    sequences = {sequence for sequence, _ in samples}
    unit: Unit = "sequences" if len(sequences) > 1 else "frames"
    mean = float(values.mean())
    if not np.isfinite(mean):
        return Spread(mean, float("nan"), len(sequences), unit)
    # Deviations are summed within each unit before they are squared: errors that its frames have
    # in common then add up. The factor n / (n - 1) corrects for few units.
    totals: dict[Hashable, float] = {}
    for (sequence, frame), value in samples.items():
        key = sequence if unit == "sequences" else frame
        totals[key] = totals.get(key, 0.0) + value - mean
    count = len(totals)
    if count < 2:
        return Spread(mean, float("nan"), count, unit)
    squared = float(np.square(list(totals.values())).sum()) * count / (count - 1)
    return Spread(mean, float(np.sqrt(squared)) / len(values), count, unit)


def compare_paired(first: Samples, second: Samples) -> PairedDifference:
    """Compare two methods on their common frames.

    The unit is the sequence for six or more sequences, else the frame. The p-value over similar
    frames is too small.

    Raises:
        InputError: there is no common frame.
    """
    shared = {key: (first[key], second[key]) for key in first if key in second}
    shared = {key: pair for key, pair in shared.items() if np.isfinite(pair).all()}
    _need(shared)
    groups: dict[Hashable, list[float]] = {}
    unit: Unit = "frames"
    if len({sequence for sequence, _ in shared}) >= _FEWEST_SEQUENCES:
        unit = "sequences"
    for key, (one, other) in shared.items():
        groups.setdefault(key[0] if unit == "sequences" else key, []).append(other - one)
    # Sums and counts, not means of units: a resampled mean weighs frames alike, as the mean does.
    sums = np.array([sum(g) for g in groups.values()])
    counts = np.array([len(g) for g in groups.values()], dtype=np.float64)
    one, other = np.array(list(shared.values())).mean(axis=0).tolist()
    low, high = _bootstrap(sums, counts)
    return PairedDifference(
        one,
        other,
        float(sums.sum() / counts.sum()),
        low,
        high,
        _signed_rank(sums / counts),
        len(groups),
        unit,
    )


def _bootstrap(
    sums: Float64[np.ndarray, " g"], counts: Float64[np.ndarray, " g"]
) -> tuple[float, float]:
    """Return the 95 % percentile interval of the mean over resampled groups, with a fixed seed."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(sums), (_DRAWS, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5]).tolist()
    return low, high


def _signed_rank(differences: Float64[np.ndarray, " g"]) -> float:
    from scipy.stats import wilcoxon

    if not differences.any():
        return 1.0
    if len(differences) < _FEWEST_SEQUENCES:
        return float("nan")
    return float(np.asarray(wilcoxon(differences))[1])


def _need(samples: Mapping[tuple[Any, str], object]) -> None:
    if not samples:
        raise InputError(
            "there is no frame to compare", expected="one frame or more that both have measured"
        )


def rank_correlation(first: Shaped[np.ndarray, " n"], second: Shaped[np.ndarray, " n"]) -> float:
    """Return Spearman's correlation of paired values; ties have their mean rank."""
    return float(np.corrcoef(rankdata(first), rankdata(second))[0, 1])
