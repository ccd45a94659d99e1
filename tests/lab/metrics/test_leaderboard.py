"""A leaderboard's arithmetic, with known numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from lightsim.build.quality.frame_report import FrameRow, FramesReport
from lightsim.build.quality.metrics import ImageScores
from lightsim.errors import ArtefactError
from lightsim_lab.metrics.report import Cost, EvaluationReport
from lightsim_lab.studies.leaderboard import make_leaderboard, weakest

CAMERAS = [f"camera {i}" for i in range(4)]
GAINS = {"net": 2.0, "ours": 0.0}


def evaluation(
    path: Path, decibels: Mapping[str, Mapping[str, float]], seconds: Mapping[str, float]
) -> None:
    """PSNR by method and sky, the same in four cameras but for 0.1 dB; with what must not count."""
    rows = []
    for method, by_sky in decibels.items():
        for sky, level in by_sky.items():
            for n, camera in enumerate(CAMERAS):
                one = ImageScores(level + 0.1 * n, 0.5, 0.2)
                for region, is_exposed in (("masked", False), ("masked", True), ("whole", False)):
                    shown = (
                        one if (region, is_exposed) == ("masked", False) else ImageScores(99.0, 1.0)
                    )
                    frames = {"03": shown}
                    rows.append(
                        FrameRow(sky, camera, method, region, is_exposed, 1.0, 1, shown, frames)
                    )
    costs = {method: Cost(s, int(100 * s)) for method, s in seconds.items()}
    path.write_text(EvaluationReport(FramesReport(tuple(rows)), costs=costs).to_json())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two streets; a method that is 2 dB better everywhere, and a baseline."""
    for street, level, sky in (("7", 20.0, "beach"), ("12", 24.0, "forest")):
        shown = {m: {"noon": level + gain, sky: level + gain - 6} for m, gain in GAINS.items()}
        shown["copy"] = {"noon": 10.0, sky: 10.0}
        evaluation(tmp_path / f"{street}.json", shown, dict.fromkeys(GAINS, level / 10))
    return tmp_path


def test_means_errors_and_differences_are_known(folder: Path) -> None:
    wanted, notes = ("7", "12", "30"), ("a note",)
    board = make_leaderboard("Relighting", folder, "ours", ("dusk", "noon"), wanted, notes)
    assert board.streets == ("7", "12")
    assert board.conditions == ("noon", "measured", "mean")
    assert [entry.method for entry in board.entries] == ["ours", "net", "copy"]
    ours, net, copy = board.entries
    spread = ours.means["noon", "psnr_db"]
    # Streets at 20.15 and 24.15 dB: half of the difference is the standard error of their mean.
    assert (spread.mean, spread.standard_error) == pytest.approx((22.15, 2.0))
    assert (spread.count, spread.unit) == (2, "sequences")
    assert ours.means["measured", "psnr_db"].mean == pytest.approx(16.15)
    assert ours.means["mean", "psnr_db"].mean == pytest.approx(19.15)
    assert ours.against == {}
    found = net.against["psnr_db"]
    assert (found.found.difference, found.found.low, found.found.high) == pytest.approx((2, 2, 2))
    # Eight cameras of two streets, all of them better.
    assert (found.found.count, found.verdict) == (8, "better")
    assert copy.against["psnr_db"].found.difference == pytest.approx(10.15 - 19.15)
    assert net.against["ssim"].verdict == "not significant"
    assert ours.cost is not None
    assert (ours.cost.seconds_a_frame, ours.cost.peak_memory_mb) == (pytest.approx(2.2), 240)
    assert copy.cost is None
    text = board.to_table()
    assert "| net | 21.15 ± 2.00 | 0.500 ± 0.000 | 0.200 ± 0.000 | +2.00 [+2.00, +2.00] |" in text
    lacking = {f"Not measured: {method} on 30." for method in ("ours", "net", "copy")}
    assert set(board.notes) == {"a note", *lacking}
    assert "a note" in text
    assert json.loads(board.to_json())["entries"][0]["method"] == "ours"


def test_the_weakest_pictures_come_first(folder: Path) -> None:
    cases = weakest(folder, "ours", 3)
    assert [case[:3] for case in cases] == [("7", "beach", camera) for camera in CAMERAS[:3]]
    assert [case[-1] for case in cases] == pytest.approx([14.0, 14.1, 14.2])


def test_a_cost_that_was_edited_is_named(folder: Path) -> None:
    file = folder / "12.json"
    whole = json.loads(file.read_text())
    for cost in ({"seconds_a_frame": 2.0}, {"seconds_a_frame": "2", "peak_memory_mb": 200}, 2.0):
        file.write_text(json.dumps(whole | {"costs": {"ours": cost}}))
        with pytest.raises(ArtefactError, match=r"12\.json") as caught:
            make_leaderboard("Relighting", folder, "ours", ())
        assert "evaluate again" in str(caught.value)


def test_one_street_has_the_spread_of_its_pictures(folder: Path) -> None:
    (folder / "12.json").unlink()
    (ours, *_) = make_leaderboard("Relighting", folder, "ours", ("noon",)).entries
    spread = ours.means["noon", "psnr_db"]
    assert spread.unit == "frames"
    assert spread.standard_error == pytest.approx(np.std([0, 0.1, 0.2, 0.3], ddof=1) / 2)
