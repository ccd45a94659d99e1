"""Frame reports: right means, right regions, baselines, clear errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lightsim.errors import InputError
from lightsim.evaluate.frames import FramesConfig, evaluate_frames
from lightsim.store.images import write_grey8, write_png

QUICK = FramesConfig(with_lpips=False)


@pytest.fixture
def folders(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Two cameras with two frames each; predictions are 10 codes too bright below the sky."""
    for camera in ("front", "back"):
        for name in ("predicted", "truth", "source", "masks"):
            (tmp_path / name / camera).mkdir(parents=True)
        for stem in ("00", "01"):
            truth = rng.integers(60, 180, (24, 32, 3)).astype(np.uint8)
            predicted = truth + np.uint8(10)
            predicted[:8] = 0
            sky = np.zeros((24, 32), np.uint8)
            sky[:8] = 255
            for name, image in (("predicted", predicted), ("truth", truth), ("source", truth)):
                write_png(tmp_path / name / camera / f"{stem}.png", image)
            write_grey8(tmp_path / "masks" / camera / f"{stem}.png", sky)
    return tmp_path


def test_scores_of_a_known_error(folders: Path) -> None:
    report = evaluate_frames(
        folders / "predicted", folders / "truth", QUICK, masks=folders / "masks"
    )
    wanted = -20 * np.log10(10 / 255)
    assert report.mean("truth", "relit", "masked").psnr_db == pytest.approx(wanted, abs=1e-3)
    assert report.mean("truth", "relit", "whole").psnr_db < 15
    assert report.mean("truth", "relit", "masked", True).psnr_db > wanted
    assert len(report.rows) == 8
    assert "| truth | masked | raw | relit | 28.13 |" in report.to_table()


def test_baselines_stand_beside(folders: Path) -> None:
    report = evaluate_frames(
        folders / "predicted",
        folders / "truth",
        QUICK,
        source=folders / "source",
        baselines={"copy": lambda source, truth, is_valid: source},
    )
    assert report.methods == ("relit", "copy")
    assert report.mean("truth", "copy", "whole").psnr_db == float("inf")
    rows = json.loads(report.to_json())["rows"]
    raw = [row for row in rows if row["method"] == "copy" and not row["is_exposed"]]
    assert {row["scores"]["psnr_db"] for row in raw} == {None}


def test_lpips_is_in_the_table(folders: Path) -> None:
    report = evaluate_frames(folders / "truth", folders / "truth", FramesConfig())
    assert report.mean("truth", "relit", "whole").lpips == 0.0


def test_bad_folders_are_named(folders: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        evaluate_frames(folders / "nowhere", folders / "truth", QUICK)
    (folders / "empty").mkdir()
    with pytest.raises(InputError, match="share no frame"):
        evaluate_frames(folders / "empty", folders / "truth", QUICK)
    write_png(folders / "predicted" / "front" / "00.png", np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="another size"):
        evaluate_frames(folders / "predicted", folders / "truth", QUICK)
