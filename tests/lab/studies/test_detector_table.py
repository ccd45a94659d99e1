"""The detector's table from made detections, against hand-computed figures."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lightsim_lab.studies.detector_options import TEST_LIGHTS
from lightsim_lab.studies.detector_table import Run, crossed_interval, holm, make_table


def made_run(found: dict[str, list[bool]]) -> Run:
    """Return a run whose pictures have one box each, 10, 30 or 50 m away.

    Args:
        found: whether the detection of each light's picture is right, by street. A wrong one has
            the better score, so that precision at the right ones is that of all detections.
    """
    keys = [(street, light) for street in found for light in TEST_LIGHTS]
    is_true = np.array([one for street in found.values() for one in street])
    number = np.arange(len(keys))
    distance = np.resize([10.0, 30.0, 50.0], len(keys))
    return Run({
        "street": np.array([street for street, _ in keys]),
        "light": np.array([light for _, light in keys]),
        "picture": number,
        "truth_picture": number,
        "scores": np.where(is_true, 0.5, 0.9),
        "is_true": np.repeat(is_true[:, None], 3, axis=1),
        "is_counted": np.ones((len(keys), 3), bool),
        "distance_m": np.repeat(distance[:, None], 3, axis=1),
        "truth_distance_m": distance,
    })  # fmt: skip


ALL, NO = [True] * 6, [False] * 6
# Right under the recorded light alone, and in two of the five others.
RECORDED, TWO = [True] + [False] * 5, [True, True, True, False, False, False]


def made_runs(copies: int) -> dict[str, dict[int, Run]]:
    """Return runs of three rows and two seeds on pairs of streets."""

    def run(first: list[bool], second: list[bool]) -> Run:
        pairs = ((f"a{k}", f"b{k}") for k in range(copies))
        return made_run(
            {name: one for pair in pairs for name, one in zip(pair, (first, second), strict=True)}
        )

    return {
        "real": {0: run(RECORDED, TWO), 1: run(RECORDED, TWO)},
        "network": {0: run(TWO, TWO), 1: run(TWO, ALL)},
        "path-traced": {0: run(ALL, ALL), 1: run(ALL, ALL)},
    }


def test_rows_have_their_differences_to_the_reference() -> None:
    table = make_table(made_runs(3), "real")
    real, network, oracle = table.rows
    # Two of five found, behind three wrong ones: precision 2/5 up to recall 2/5.
    two = 100 * (2 / 5) * (2 / 5)
    assert real.map_unseen == pytest.approx(two / 2)
    assert real.ap == pytest.approx([two / 2] * 3)
    assert network.map_unseen == pytest.approx((3 * two + 100) / 4)
    assert network.difference == pytest.approx((two + (100 - two) / 2) / 2)
    assert oracle.difference == pytest.approx(100 - two / 2)
    assert network.oracle_fraction == pytest.approx(network.difference / oracle.difference)
    assert (real.oracle_fraction, oracle.oracle_fraction) == (0, 1)
    # The smallest difference of a seed and street is 0, and the largest 100 - two.
    assert 0 <= network.low < network.difference < network.high <= 100 - two
    # All differences of the oracle are positive: the smallest p-value, doubled by Holm.
    assert oracle.p_value == pytest.approx(2 * 2 / 10_001)
    assert np.isnan(real.p_value)
    assert real.by_light["recorded"] == 100
    # The light is found on every second street, behind three wrong detections.
    assert real.by_light["overcast"] == pytest.approx(100 / 4)
    assert set(network.by_range) == {"0-20 m", "20-40 m", "40-80 m"}
    assert "| network | 2 |" in table.to_table()
    assert "| < .001 |" in table.to_table()
    written = json.loads(table.to_json())
    assert written["rows"][0]["p_value"] is None
    assert written["rows"][1]["map_unseen"] == pytest.approx(network.map_unseen)


def test_a_row_without_a_seed_of_the_reference_has_no_difference() -> None:
    runs = made_runs(3)
    table = make_table({**runs, "network": {7: runs["network"][0]}}, "real")
    row = table.rows[1]
    assert row.map_unseen > 0
    assert np.isnan([row.difference, row.low, row.p_value]).all()
    assert "nan" not in table.to_table()


def test_few_streets_have_no_intervals() -> None:
    table = make_table(made_runs(2), "real")
    _, network, oracle = table.rows
    assert network.difference > 0
    assert np.isnan([network.low, network.p_value, oracle.oracle_fraction]).all()
    assert "nan" not in table.to_table()


def test_ranges_divide_boxes_and_detections() -> None:
    run = made_run({"a": ALL})
    chosen = run.pictures(TEST_LIGHTS)
    assert chosen.all()
    assert run.precision(chosen, (0, 20))[0] == 1
    assert run.arrays["is_counted"].all()
    # The detections of one range are wrong; the others keep their precision.
    wrong = run.arrays["distance_m"][:, 0] == 30
    broken = Run({**run.arrays, "is_true": run.arrays["is_true"] & ~wrong[:, None]})
    assert broken.precision(chosen, (0, 20))[0] == 1
    assert broken.precision(chosen, (20, 40))[0] == 0
    assert np.isnan(run.precision(chosen, (60, 80))).all()
    # Detections that do not count change nothing.
    left_out = Run({**broken.arrays, "is_counted": ~np.repeat(wrong[:, None], 3, axis=1)})
    assert left_out.precision(chosen)[0] == pytest.approx(4 / 6)


def test_the_interval_of_two_streets_is_that_of_all_draws() -> None:
    # Of two streets, four equally likely draws: -1, 1, 1 and 3.
    low, high, p = crossed_interval(np.array([[-1.0, 3.0]]))
    assert (low, high) == (-1, 3)
    assert p == pytest.approx(2 * 0.25, abs=0.03)
    # Seeds and streets that are drawn independently: streets are +-1, seeds add nothing.
    both = crossed_interval(np.array([[-1.0, 3.0], [-1.0, 3.0]]))
    assert both[:2] == (-1, 3)
    # A street without a vehicle is left out.
    assert crossed_interval(np.array([[-1.0, np.nan, 3.0]]))[:2] == (-1, 3)
    assert np.isnan(crossed_interval(np.full((2, 2), np.nan))).all()


def test_the_interval_covers_the_mean_of_many_streets(rng: np.random.Generator) -> None:
    truths = 0
    for _ in range(40):
        differences = (
            2 + rng.normal(0, 3, (1, 12)) + rng.normal(0, 1, (5, 1)) + rng.normal(0, 1, (5, 12))
        )
        low, high, _ = crossed_interval(differences)
        truths += low <= 2 <= high
    assert truths >= 33


def test_holm_multiplies_by_the_number_of_remaining_values() -> None:
    assert holm([0.01, 0.04, 0.03, float("nan")])[:3] == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []
