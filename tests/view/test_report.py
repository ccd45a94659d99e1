"""The report is one file, escapes what it is given, and is well-formed."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightsim.errors import InputError
from lightsim.view.report import Card, Figure, Section, Table, Video, write_report

_VOID = {"meta", "img", "br", "link"}


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
