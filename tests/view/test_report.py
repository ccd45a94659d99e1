"""The report is one file, escapes what it is given, and is well-formed."""

from __future__ import annotations

import base64
import io
import re
import shlex
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightsim.errors import InputError
from lightsim.view.report import (
    Card,
    Comparison,
    Figure,
    Section,
    Table,
    Video,
    render_report,
    viewer_command,
    write_report,
)

_VOID = {"meta", "img", "br", "link", "input"}


class _Balance(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_one_file_with_everything_inside(tmp_path: Path) -> None:
    image = np.zeros((20, 40, 3), np.uint8)
    image[:, :20] = [250, 10, 10]
    section = Section(
        "Part <one>",
        "First & best.\n\nSecond.",
        cards=[Card("PSNR", "24.3 dB", "held out")],
        tables=[Table(("stage", "s"), [("a", 1234.5), ("b", None), ("c", 0.012345)])],
        figures=[Figure('a "quoted" caption', image)],
        videos=[Video("film", "video/front.mp4")],
    )
    write_report(tmp_path / "r.html", "T<script>", [section], subtitle="s", cards=[Card("n", "1")])
    page = (tmp_path / "r.html").read_text()
    parser = _Balance()
    parser.feed(page)
    assert parser.open == []
    assert "script" not in parser.tags
    assert not re.search(r"(src|href)=\"(https?:)?//", page)
    for text in ("T<script>", "Part <one>", "First & best.", "24.3 dB", "1,234", "–", "0.01235"):
        assert text in parser.text
    data = re.findall(r"data:image/jpeg;base64,([A-Za-z0-9+/=]+)", page)
    assert len(data) == 1
    with Image.open(io.BytesIO(base64.b64decode(data[0]))) as picture:
        assert np.abs(np.array(picture)[10, 5].astype(int) - [250, 10, 10]).max() < 8
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]


def test_wrong_rows_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="differ in length"):
        Table(("a", "b"), [("only one",)])
    with pytest.raises(InputError, match="does not exist"):
        write_report(tmp_path / "no" / "r.html", "t", [])


def test_pictures_are_compared_under_a_slider() -> None:
    images = {name: np.full((20, 40, 3), code, np.uint8) for code, name in enumerate("abc")}
    page = render_report("t", [Section("s", comparisons=[Comparison("front <1>", images)])])
    parser = _Balance()
    parser.feed(page)
    assert parser.open == []
    assert [parser.tags.count(tag) for tag in ("img", "select", "option", "script")] == [3, 2, 6, 1]
    assert re.findall(r'<img class="(\w+)"[^>]*alt="front &lt;1&gt;: (\w)"', page) == [
        ("left", "a"),
        ("right", "b"),
    ]
    for wrong in ({"a": images["a"]}, {"a": images["a"], "b": images["b"][:10]}):
        with pytest.raises(InputError, match="cannot be compared"):
            Comparison("c", wrong)


def test_the_header_has_the_line_that_opens_the_viewer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    work = tmp_path / "my street's <work>"
    line = viewer_command(Path(work.name), "day/sun 1")
    assert shlex.split(line) == ["lightsim", "view", str(work), "--scenario", "day/sun 1"]
    assert shlex.split(viewer_command(work)) == ["lightsim", "view", str(work)]
    parser = _Balance()
    parser.feed(render_report("t", [], viewer=line))
    assert line in parser.text
    assert "code" not in render_report("t", []).split("<body>")[1]
