"""docs/paper-map.md names what is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(
    set(re.findall(r"`([a-z_]+(?:\.\w+)+)`", (ROOT / "docs" / "paper-map.md").read_text()))
)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_the_paper_map_exists(name: str) -> None:
    """It is a module or package of lightsim, or is defined in the one that it names."""
    folder, parts = ROOT / "src" / "lightsim", name.split(".")
    while parts and (folder / parts[0]).is_dir():
        folder /= parts.pop(0)
    if not parts:
        return
    text = (folder / f"{parts[0]}.py").read_text()
    for part in parts[1:]:
        assert re.search(rf"\b(?:def|class) {part}\b|^\s*{part}\b[^\n]*[:=]", text, re.M), part
