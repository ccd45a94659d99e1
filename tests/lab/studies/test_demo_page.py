"""The page of the demo: compared pictures and the command line of the viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.report_pages import compared, viewer_words

from lightsim.build.quality.frame_report import FrameRow, FramesReport
from lightsim.build.quality.metrics import ImageScores
from lightsim.build.workspace import Workspace
from lightsim.store.images import write_png
from lightsim_lab.studies.report import write_demo_report


def test_the_demo_compares_with_the_truth(tmp_path: Path) -> None:
    work = tmp_path / "a street"
    made = work / "scenarios" / "demo" / "low_sun"
    folders = {
        "predicted": made / "frames",
        "truth": tmp_path / "truth",
        "source": tmp_path / "log",
    }
    for code, folder in enumerate(folders.values()):
        (folder / "front_camera").mkdir(parents=True)
        for stem in ("03", "07"):
            picture = np.full((9, 16, 3), 50 * code, np.uint8)
            write_png(folder / "front_camera" / f"{stem}.png", picture)
    row = FrameRow("low_sun", "front", "relit", "masked", False, 1.0, 1, ImageScores(21.5, 0.7))
    page = write_demo_report(
        tmp_path / "index.html",
        Workspace(work),
        {"low_sun": folders},
        FramesReport((row,)),
        [("what is made", "status 'a street'")],
    )
    names = ["recorded", "relit by LightSim", "truth"]
    assert compared(page) == {"low_sun, front_camera, frame 07": names}
    assert viewer_words(page) == ["lightsim", "view", str(work.resolve())]
    assert "21.5" in page.read_text()
