"""Scores of base colour on made-up frames."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.errors import InputError
from lightsim_lab.metrics.base_colour import BaseColourTask, score_base_colour


def _task() -> BaseColourTask:
    """Upper half facade, lower half ground; the left half lit; one column is not valid."""
    shape = (40, 60)
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.1, 0.6, (*shape, 3)).astype(np.float32)
    lit = np.zeros(shape, np.float32)
    lit[:, :30] = 1.0
    normal = np.zeros((*shape, 3), np.float32)
    normal[:20, :, 0], normal[20:, :, 2] = 1.0, 1.0
    valid = np.ones(shape, dtype=bool)
    valid[:, 5] = False
    broken = truth.copy()
    broken[:, 5] = 1e3
    light = np.where(lit[..., None] > 0, np.float32(4.0), np.float32(1.0))
    estimates = {"scaled": 1.5 * broken, "radiance": broken * light}
    loads = {name: lambda image=image: image for name, image in estimates.items()}
    return BaseColourTask(truth, lit, normal, valid, loads)


def test_a_common_factor_and_a_shadow_are_told_apart():
    report = score_base_colour([_task(), _task()])
    rows = {(row.method, row.region): row for row in report.rows}
    for region in ("all", "ground", "facades"):
        scaled = rows["scaled", region]
        assert scaled.factor == pytest.approx(1.5, rel=1e-5)
        assert scaled.log_rmse == pytest.approx(np.log(1.5), rel=1e-5)
        assert scaled.si_log_rmse == pytest.approx(0.0, abs=1e-6)
        assert scaled.lit_shadow_ratio == pytest.approx(1.0, rel=1e-5)
        assert rows["radiance", region].lit_shadow_ratio == pytest.approx(4.0, rel=1e-5)
    assert rows["scaled", "all"].pixels == 2 * 40 * 59
    assert report.to_table().count("\n") == 7


def test_nothing_to_compare_is_an_error():
    with pytest.raises(InputError, match="no pixel"):
        score_base_colour([])
