"""Frame reports: right means, right regions, baselines, clear errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightsim.build.quality.frame_report import FrameRow, FramesReport
from lightsim.build.quality.frames import FramesConfig, score_frames
from lightsim.errors import InputError
from lightsim.store.images import write_png
from lightsim_lab.metrics.folders import folder_tasks
from lightsim_lab.metrics.lpips import ALL_MEASURES

QUICK = FramesConfig()


@pytest.fixture
def folders(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Two cameras with two frames each; predictions are 10 codes too bright below the sky."""
    for camera in ("front", "back"):
        for name in ("predicted", "truth", "source"):
            (tmp_path / name / camera).mkdir(parents=True)
        for stem in ("00", "01"):
            truth = rng.integers(60, 180, (32, 40, 3)).astype(np.uint8)
            predicted = truth + np.uint8(10)
            predicted[:8] = 0
            for name, image in (("predicted", predicted), ("truth", truth), ("source", truth)):
                write_png(tmp_path / name / camera / f"{stem}.png", image)
    return tmp_path


def _below_the_sky(camera: str, stem: str) -> np.ndarray:
    return np.arange(32)[:, None].repeat(40, 1) >= 8


def _scores(
    folders: Path, *names: str, config: FramesConfig = QUICK, **options: Any
) -> FramesReport:
    paired: dict[str, Path] = {}
    for role, name in zip(("relit", "truth", "source"), names, strict=False):
        paired[role] = folders / name
    return score_frames(folder_tasks("truth", ["relit"], paired, **options), config)


def test_scores_of_a_known_error(folders: Path) -> None:
    report = _scores(folders, "predicted", "truth", is_valid=_below_the_sky)
    wanted = -20 * np.log10(10 / 255)
    assert report.mean("truth", "relit", "masked").psnr_db == pytest.approx(wanted, abs=1e-3)
    assert report.mean("truth", "relit", "whole").psnr_db < 15
    assert report.mean("truth", "relit", "masked", True).psnr_db > wanted
    assert len(report.rows) == 8
    assert "| truth | masked | raw | relit | 28.13 ± 0.00 |" in report.to_table()


def test_classes_are_scored_apart_where_a_frame_shows_them(folders: Path) -> None:
    """The sky is wrong, the ground is not; only one camera sees a car, and nobody a lit tree."""

    def classes(camera: str, stem: str) -> dict[str, np.ndarray]:
        below = _below_the_sky(camera, stem)
        is_car = below & (camera == "front")
        return {"sky": ~below, "ground": below, "vehicle": is_car, "lit": below & False}

    tasks = folder_tasks(
        "truth",
        ["relit"],
        {"relit": folders / "predicted", "truth": folders / "truth"},
        load_classes=classes,
    )
    report = score_frames(tasks, QUICK)
    ground = report.spread("psnr_db", "truth", "relit", "ground")
    assert ground.mean == pytest.approx(-20 * np.log10(10 / 255), abs=1e-3)
    assert (ground.count, ground.unit) == (2, "sequences")
    assert report.mean("truth", "relit", "sky").psnr_db < 10
    assert {row.camera_name for row in report.rows if row.region == "vehicle"} == {"front"}
    with pytest.raises(InputError, match="no such row"):
        report.mean("truth", "relit", "lit")


def test_rows_come_back_from_json_with_their_frames(folders: Path) -> None:
    report = _scores(folders, "predicted", "truth", config=ALL_MEASURES)
    rows = json.loads(report.to_json())["rows"]
    again = FramesReport(tuple(FrameRow.from_json(row) for row in rows))
    assert again.to_table() == report.to_table()
    assert set(again.rows[0].scores_by_stem) == {"00", "01"}
    old = {k: v for k, v in rows[0].items() if k != "scores_by_stem"}
    old["scores"] = {k: v for k, v in old["scores"].items() if k != "lpips_alex"}
    first = FramesReport((FrameRow.from_json(old),))  # What version 0.2 wrote.
    assert "±" not in first.to_table()
    assert first.rows[0].scores.psnr_db == report.rows[0].scores.psnr_db


def test_baselines_stand_beside(folders: Path) -> None:
    baselines = {"copy": lambda source, truth, is_valid: source}
    report = _scores(folders, "predicted", "truth", "source", baselines=baselines)
    assert report.methods == ("relit", "copy")
    assert report.mean("truth", "copy", "whole").psnr_db == float("inf")
    rows = json.loads(report.to_json())["rows"]
    raw = [row for row in rows if row["method"] == "copy" and not row["is_exposed"]]
    assert {row["scores"]["psnr_db"] for row in raw} == {None}


def test_lpips_is_in_the_table(folders: Path) -> None:
    report = _scores(folders, "truth", "truth", config=ALL_MEASURES)
    scores = report.mean("truth", "relit", "whole")
    assert (scores.lpips, scores.lpips_alex) == (0.0, 0.0)


def test_bad_folders_are_named(folders: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        _scores(folders, "nowhere", "truth")
    (folders / "empty").mkdir()
    with pytest.raises(InputError, match="no frame in common"):
        _scores(folders, "empty", "truth")
    write_png(folders / "predicted" / "front" / "00.png", np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="another size"):
        _scores(folders, "predicted", "truth")
