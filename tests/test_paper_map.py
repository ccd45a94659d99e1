"""The modules and functions that docs/paper-map.md names exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(
    set(re.findall(r"`([a-z_]+(?:\.\w+)+)`", (ROOT / "docs" / "paper-map.md").read_text()))
    - {"source.exr"}
)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_the_paper_map_exists(name: str) -> None:
    """A name is a package, a module, or is defined in one; without prefix it is the product's."""
    parts = name.split(".")
    folder = ROOT / "src" / (parts.pop(0) if parts[0] == "lightsim_lab" else "lightsim")
    while parts and (folder / parts[0]).is_dir():
        folder /= parts.pop(0)
    if not parts:
        return
    text = (folder / f"{parts[0]}.py").read_text()
    for part in parts[1:]:
        assert re.search(rf"\b(?:def|class) {part}\b|^\s*{part}\b[^\n]*[:=]", text, re.M), part


def test_both_packages_are_named() -> None:
    assert len(NAMES) > 40
    assert any(name.startswith("lightsim_lab.") for name in NAMES)
