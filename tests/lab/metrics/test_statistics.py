"""Error bars and paired tests against closed forms and drawn data."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.build.quality.statistics import clustered_mean, compare_paired
from lightsim.errors import InputError


def drawn(rng: np.random.Generator, sequences: int, frames: int, shift: float = 0.0) -> dict:
    """Frames scatter by 0.1 about their sequence's value, sequences by 1 about the shift."""
    return {
        (name, f"{stem:02d}"): float(value + rng.normal(0, 0.1))
        for name, value in enumerate(shift + rng.normal(0, 1, sequences))
        for stem in range(frames)
    }


def test_standard_error_is_that_of_the_sequences_means() -> None:
    """Equal sequences: the deviation of their means over the root of their number, however many
    frames each has."""
    values = {"a": 1.0, "b": 2.0, "c": 6.0}
    samples = {(name, f"{i}"): v + d for name, v in values.items() for i, d in enumerate((-1, 1))}
    spread = clustered_mean(samples)
    wanted = np.std([1.0, 2.0, 6.0], ddof=1) / np.sqrt(3)
    assert (spread.mean, spread.count, spread.unit) == (3.0, 3, "sequences")
    assert spread.standard_error == pytest.approx(wanted)
    assert spread.format(1) == "3.0 ± 1.5"


def test_one_sequence_counts_its_frames_and_one_frame_has_no_error() -> None:
    spread = clustered_mean({("a", "00"): 1.0, ("a", "01"): 3.0})
    assert (spread.mean, spread.standard_error, spread.unit) == (2.0, 1.0, "frames")
    assert clustered_mean({("a", "00"): 1.0}).format(2) == "1.00"
    assert clustered_mean({("a", "00"): float("inf"), ("b", "00"): 1.0}).format(2) == "inf"
    with pytest.raises(InputError, match="no frame to compare"):
        clustered_mean({})


def test_intervals_cover_the_truth(rng: np.random.Generator) -> None:
    """Nineteen of twenty: over frames, which resemble each other, hardly any would."""
    inside = 0
    for _ in range(200):
        spread = clustered_mean(drawn(rng, 20, 5))
        inside += abs(spread.mean) < 2.09 * spread.standard_error
    assert 180 <= inside <= 199


def test_a_small_difference_shows_where_sequences_scatter_widely(
    rng: np.random.Generator,
) -> None:
    """Paired: what both share drops out."""
    first = drawn(rng, 12, 4)
    second = {key: value + 0.2 + rng.normal(0, 0.1) for key, value in first.items()}
    found = compare_paired(first, second)
    assert found.difference == pytest.approx(0.2, abs=0.05)
    assert found.low < 0.2 < found.high
    assert found.low > 0.1
    assert found.p_value < 0.01
    assert (found.count, found.unit) == (12, "sequences")
    assert compare_paired(first, second) == found
    apart = compare_paired(second, first)
    assert apart.difference == pytest.approx(-found.difference)
    assert apart.p_value == pytest.approx(found.p_value)


def test_equal_methods_differ_in_one_case_of_twenty(rng: np.random.Generator) -> None:
    significant = 0
    for _ in range(200):
        first = drawn(rng, 10, 3)
        # Frames of a sequence share their error: over frames, half of the cases would differ.
        errors = rng.normal(0, 0.3, 10)
        second = {(name, stem): v + errors[name] for (name, stem), v in first.items()}
        significant += compare_paired(first, second).p_value < 0.05
    assert 2 <= significant <= 22


def test_only_shared_frames_count() -> None:
    first = {("a", "00"): 1.0, ("a", "01"): float("inf"), ("b", "00"): 5.0}
    second = {("a", "00"): 2.0, ("a", "01"): 3.0}
    found = compare_paired(first, second)
    assert (found.first, found.second, found.count) == (1.0, 2.0, 1)
    assert np.isnan(found.p_value)
    assert compare_paired(first, first).p_value == 1.0
    with pytest.raises(InputError, match="no frame to compare"):
        compare_paired(first, {("c", "00"): 1.0})
