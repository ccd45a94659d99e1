"""`lightsim check`: findings, the page, and boxes drawn where they are."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.datasets.mini_log import write_mini_log

from lightsim import cli
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.view.log_overlay import draw_overlay


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_mini_log(tmp_path / "log")


def test_a_whole_log_can_be_built(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["check", str(folder), "--image-scale", "1", "--out", str(tmp_path / "page")])
    said = capsys.readouterr().out
    page = (tmp_path / "page" / "check.html").read_text()
    assert "front_camera" in page
    assert page.count("data:image") >= 3
    assert "cannot" not in said


def test_a_log_without_sweeps_fails_with_a_remedy(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(folder / "lidar")
    shutil.rmtree(folder / "annotations")
    with pytest.raises(SystemExit) as stop:
        cli.main(["check", str(folder), "--image-scale", "1", "--out", str(tmp_path / "page")])
    assert stop.value.code == 1
    said = capsys.readouterr()
    assert "no LiDAR sweep" in said.err
    assert "no labelled boxes" in said.out
    # The page exists nevertheless: it shows what there is.
    assert (tmp_path / "page" / "check.html").is_file()


def test_returns_and_boxes_lie_on_the_picture(folder: Path) -> None:
    """Returns are drawn where `project` places them, and nothing else changes the picture."""
    log = read_log(LogReading(source=str(folder)))
    frame = log.frames_of("front_camera")[1]
    camera = log.cameras["front_camera"]
    sweep = next(s for s in log.sweeps if s.stem == frame.stem).load()
    overlay = draw_overlay(log, frame, sweep, camera.width_px)
    uv, is_inside = frame.project(camera, sweep.points_world.astype(np.float64))
    assert overlay.returns == is_inside.sum() > 0
    is_changed = (overlay.image != frame.load_srgb8()).any(axis=2)
    column, row = np.floor(uv[is_inside]).astype(int).T
    # A line of a box may cover a return, so a changed pixel is all that each return requires.
    assert is_changed[row, column].mean() > 0.95
