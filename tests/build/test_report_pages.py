"""Pages of build, relight and simulate: compared pictures and the command line of the viewer."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest
from tests.conftest import BuiltStreet
from tests.report_pages import compared, viewer_words

from lightsim import cli
from lightsim.progress import SilentProgress
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight

T = TypeVar("T")
FRAME = ("--frames", "0:1", "--cameras", "front_camera")
RATIOS = ["shadow ratio, source sky", "shadow ratio, target sky"]


def test_the_build_compares_held_out_pictures_with_the_twin(built_street: BuiltStreet) -> None:
    page = built_street.work / "report" / "index.html"
    cameras = ("front_camera", "left_camera")
    assert compared(page) == {f"{c}, frame 01, held out": ["recorded", "twin"] for c in cameras}
    assert viewer_words(page) == ["lightsim", "view", str(built_street.work.resolve())]
    text = page.read_text()
    for camera in cameras:
        assert f"{camera}: base colour | source light | normals | depth | sky matte" in text


def test_simulate_compares_under_each_sky(built_street: BuiltStreet, tmp_path: Path) -> None:
    work, path = built_street.work, tmp_path / "empty street.json"
    edits = [{"do": "remove", "actor": "all"}]
    path.write_text(json.dumps({"version": 1, "name": "emptied", "edits": edits}))
    cli.main(["simulate", str(work), str(path), *FRAME, "--sky", "source", "sun:120,30"])
    shown = {
        "source": ["recorded", "edited"],
        "sun_120_30": ["recorded", "edited and relit", "edited, source sky", *RATIOS],
    }
    for sky, names in shown.items():
        page = work / "scenarios" / "emptied" / sky / "report.html"
        assert compared(page) == {"front_camera, frame 00": names}
        assert viewer_words(page)[3:] == ["--scenario", f"emptied/{sky}"]


class _Interrupting(SilentProgress):
    """Raises KeyboardInterrupt before the fourth item."""

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        for index, item in enumerate(items):
            if index == 3:
                raise KeyboardInterrupt
            yield item


def test_an_interrupted_relight_writes_the_whole_page(built_street: BuiltStreet) -> None:
    work = built_street.work
    options = RelightOptions(name="stopped", sky=("sun:120,30",), frames="0:2")
    with pytest.raises(KeyboardInterrupt):
        relight(work, options, _Interrupting())
    folder = work / "scenarios" / "stopped"
    assert not folder.exists()
    resumed = [(f / "report.html").read_bytes() for f in relight(work, options, SilentProgress())]
    assert compared(folder / "report.html") == {
        f"{camera}, frame 01": ["recorded", "relit", *RATIOS]
        for camera in ("front_camera", "left_camera")
    }
    assert viewer_words(folder / "report.html")[3:] == ["--scenario", "stopped"]
    shutil.rmtree(folder)
    made = relight(work, options, SilentProgress())
    assert resumed == [(f / "report.html").read_bytes() for f in made]
