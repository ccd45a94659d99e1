from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from lightsim.errors import InputError
from lightsim.view.charts import bar_chart, histogram, line_chart

SVG = "{http://www.w3.org/2000/svg}"


def test_bars_are_in_proportion() -> None:
    root = ElementTree.fromstring(bar_chart({"a & b": 10.0, "c": 5.0, "none": 0.0}, "s"))
    widths = [float(rect.attrib["width"]) for rect in root.iter(f"{SVG}rect")]
    assert widths[0] == pytest.approx(2 * widths[1], abs=0.2)
    assert "a & b" in [text.text for text in root.iter(f"{SVG}text")]
    with pytest.raises(InputError, match="non-negative"):
        bar_chart({"a": -1.0}, "s")


def test_lines_break_where_a_value_is_missing() -> None:
    points = np.array([[0, 1.0], [1, 2.0], [2, np.nan], [3, 4.0], [4, 3.0]])
    root = ElementTree.fromstring(line_chart({"x": points, "y": points + 1}, "time", "dB"))
    lines = [p.attrib["d"] for p in root.iter(f"{SVG}path") if p.attrib.get("fill") == "none"]
    assert [line.count("M") for line in lines] == [2, 2]
    assert [line.count("L") for line in lines] == [2, 2]
    with pytest.raises(InputError, match="finite"):
        line_chart({"x": points * np.nan}, "time", "dB")


@pytest.mark.parametrize("values", [[1.0], [3.0, 3.0], [-1e-9, 1e-9], [0.0, 1e7]])
def test_any_range_stays_inside(values: list[float]) -> None:
    points = np.stack([np.arange(len(values), dtype=float), np.array(values)], axis=1)
    root = ElementTree.fromstring(line_chart({"x": points}, "x", "y"))
    width, height = (float(v) for v in root.attrib["viewBox"].split()[2:])
    path = next(p.attrib["d"] for p in root.iter(f"{SVG}path") if p.attrib.get("fill") == "none")
    for pair in path.replace("M", "L").split("L")[1:]:
        x, y = (float(v) for v in pair.split())
        assert 0 <= x <= width
        assert 0 <= y <= height


def test_histogram_holds_all_values(rng: np.random.Generator) -> None:
    svg = histogram(rng.exponential(1.0, 1000), "error (m)", bins=10, limit=2.0)
    bars = [float(r.attrib["height"]) for r in ElementTree.fromstring(svg).iter(f"{SVG}rect")]
    assert len(bars) == 10
    assert bars[0] > bars[5]
    assert bars[-1] > bars[-2]
    with pytest.raises(InputError, match="finite"):
        histogram(np.array([np.nan]), "x")
