"""Evaluations written to JSON are compared in pairs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.build.quality.frame_report import FrameRow, FramesReport
from lightsim.build.quality.metrics import ImageScores
from lightsim.errors import InputError
from lightsim_lab.metrics.compare import ComparisonReport, compare_evaluations

CAMERAS = [f"camera {i}" for i in range(8)]


def evaluation(path: Path, decibels: dict[str, float], rng: np.random.Generator) -> Path:
    """Two skies, eight cameras, three frames each; scenes differ by 3 dB, frames by 0.1."""
    scenes = np.random.default_rng(1).normal(0, 3, len(CAMERAS))
    rows = []
    for sky in ("noon", "dusk"):
        for camera, scene in zip(CAMERAS, scenes, strict=True):
            for method, level in decibels.items():
                values = level + scene + rng.normal(0, 0.1, 3)
                by_stem = {
                    f"{i:02d}": ImageScores(v, 0.5, np.nan) for i, v in enumerate(values.tolist())
                }
                mean = ImageScores(float(values.mean()), 0.5, np.nan)
                rows.append(FrameRow(sky, camera, method, "masked", False, 1.0, 3, mean, by_stem))
    path.write_text(FramesReport(tuple(rows)).to_json())
    return path


def test_small_differences_show_and_equal_scores_do_not(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    first = evaluation(tmp_path / "a.json", {"ours": 20.0, "copy": 15.0}, rng)
    second = evaluation(tmp_path / "b.json", {"ours": 20.3, "copy": 15.0}, rng)
    report = compare_evaluations(first, second)
    found = {(row.method, row.score): row for row in report.rows}
    assert set(found) == {(m, s) for m in ("ours", "copy") for s in ("psnr_db", "ssim")}
    ours = found["ours", "psnr_db"]
    assert ours.found.difference == pytest.approx(0.3, abs=0.1)
    assert (ours.found.count, ours.found.unit) == (8, "sequences")
    assert ours.verdict == "better"
    assert found["copy", "psnr_db"].verdict == "not significant"
    assert found["ours", "ssim"].verdict == "not significant"
    assert "| masked | raw | ours | psnr_db |" in report.to_table()
    rows = json.loads(report.to_json())["rows"]
    assert [row["verdict"] for row in rows] == [row.verdict for row in report.rows]


@pytest.mark.parametrize(
    ("q_value", "shown"), [(1e-9, "< .001"), (0.04, "0.040"), (float("nan"), "-")]
)
def test_no_probability_is_shown_as_nothing(
    tmp_path: Path, rng: np.random.Generator, q_value: float, shown: str
) -> None:
    file = evaluation(tmp_path / "a.json", {"ours": 20.0}, rng)
    row = replace(compare_evaluations(file, file).rows[0], q_value=q_value)
    assert f"| {shown} |" in ComparisonReport((row,)).to_table()


def test_methods_of_other_names_are_paired(tmp_path: Path, rng: np.random.Generator) -> None:
    both = evaluation(tmp_path / "a.json", {"ours": 20.0, "copy": 15.0}, rng)
    report = compare_evaluations(both, both, ("ours", "copy"))
    assert {row.method for row in report.rows} == {"ours -> copy"}
    assert report.rows[0].verdict == "worse"
    with pytest.raises(InputError, match="no frame of one method"):
        compare_evaluations(both, both, ("ours", "theirs"))
    with pytest.raises(InputError, match="in pairs"):
        compare_evaluations(both, both, ("ours",))


def test_folders_hold_a_log_in_each_file(tmp_path: Path, rng: np.random.Generator) -> None:
    for side, level in (("a", 20.0), ("b", 19.0)):
        (tmp_path / side).mkdir()
        for log in ("001", "002"):
            evaluation(tmp_path / side / f"{log}.json", {"ours": level}, rng)
    report = compare_evaluations(tmp_path / "a", tmp_path / "b")
    assert {(row.found.count, row.found.unit) for row in report.rows} == {(16, "sequences")}
    assert report.rows[0].verdict == "worse"


def test_what_is_no_evaluation_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"cells": []}')
    with pytest.raises(InputError, match=r"a\.json: the file is no evaluation"):
        compare_evaluations(tmp_path / "a.json", tmp_path / "a.json")
