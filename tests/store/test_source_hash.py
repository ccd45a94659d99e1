"""The hash of a result's sources changes with its code and its data, and with nothing else."""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from lightsim.store.source_hash import SourceTree, installed_sources

MAIN = '''"""Computes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pack.room import inner
from pack.room.constants import STEP_M

if TYPE_CHECKING:
    from pack.types import Only

NAME = "small"
"""Text beside a constant."""


def run(x: float) -> float:
    """Adds."""
    import pack.late

    if x == 'a':
        from .room.deep import relative
    return x + STEP_M  # in metres
'''
FILES = {
    "__init__.py": "",
    "main.py": MAIN,
    "types.py": "class Only: ...\n",
    "late.py": "from pack import errors\n",
    "errors.py": "import pack.other\n",
    "other.py": "A = 1\n",
    "unused.py": "A = 1\n",
    "room/__init__.py": "",
    "room/inner.py": "from . import constants\nfrom ..pages import PAGE\n",
    "room/constants.py": "STEP_M = 0.1\n",
    "room/deep.py": "relative = 1\n",
    "pages.py": 'PAGE = "page.html"\n',
    "page.html": "<p>",
    "unnamed.html": "<p>",
    "data/weights/manifest.json": json.dumps({"small": {"a": "01"}, "large": {"b": "02"}}),
}
ALL = {
    "pack/main.py", "pack/late.py", "pack/errors.py", "pack/other.py", "pack/room/inner.py",
    "pack/room/constants.py", "pack/room/deep.py", "pack/pages.py", "pack/page.html",
    "pack/data/weights/small",
}  # fmt: skip


def written(folder: Path, changes: dict[str, str] | None = None) -> Path:
    for name, text in {**FILES, **(changes or {})}.items():
        path = folder / "pack" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "pack"


def hashes(root: Path, **options: tuple[str, ...]) -> dict[str, str]:
    return SourceTree({"pack": root}).hashes_of(["pack.main"], **options)


def test_all_that_a_module_imports_counts_and_what_it_names(tmp_path: Path) -> None:
    """Absolute, relative and late imports; a weights' name and a file's; no type checkers'."""
    found = hashes(written(tmp_path))
    assert set(found) == ALL
    assert list(found) == sorted(found)


def test_modules_can_be_left_out_or_not_followed(tmp_path: Path) -> None:
    root = written(tmp_path)
    left_out = hashes(root, uncounted=("pack.errors",))
    unfollowed = hashes(root, unfollowed=("pack.errors",))
    assert ALL - set(left_out) == {"pack/errors.py", "pack/other.py"}
    assert ALL - set(unfollowed) == {"pack/other.py"}


@pytest.mark.parametrize(
    ("name", "change", "changed"),
    [
        ("room/constants.py", lambda t: t.replace("0.1", "0.2"), "pack/room/constants.py"),
        ("main.py", lambda t: t.replace("x + STEP_M", "x - STEP_M"), "pack/main.py"),
        ("main.py", lambda t: t.replace("'a'", "'b'"), "pack/main.py"),
        ("page.html", lambda t: t + "</p>", "pack/page.html"),
        (
            "data/weights/manifest.json",
            lambda t: t.replace("01", "03"),
            "pack/data/weights/small",
        ),
    ],
)
def test_one_change_changes_one_hash(
    tmp_path: Path, name: str, change: Callable[[str], str], changed: str
) -> None:
    before = hashes(written(tmp_path / "a"))
    after = hashes(written(tmp_path / "b", {name: change(FILES[name])}))
    assert {path for path in ALL if before[path] != after[path]} == {changed}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("main.py", MAIN.replace("in metres", "in m").replace('"""Adds."""', '"""Sums."""')),
        ("main.py", MAIN.replace('"""Text beside a constant."""\n', "")),
        ("main.py", MAIN.replace('"""Computes."""\n', "# Computes.\n\n\n")),
        ("main.py", MAIN.replace("x + STEP_M", "(\n        x\n        + STEP_M\n    )")),
        ("main.py", MAIN.replace("'a'", '"a"')),
        ("main.py", MAIN.replace("import Only", "import Only, Other")),
        ("types.py", "class Only: x = 1\n"),
        ("unused.py", "A = 2\n"),
        ("unnamed.html", "<b>"),
        ("data/weights/manifest.json", json.dumps({"small": {"a": "01"}, "large": {"b": "03"}})),
    ],
)
def test_what_changes_no_result_changes_no_hash(tmp_path: Path, name: str, text: str) -> None:
    assert text != FILES[name]
    assert hashes(written(tmp_path / "a")) == hashes(written(tmp_path / "b", {name: text}))


def test_a_string_that_is_an_argument_is_no_docstring(tmp_path: Path) -> None:
    found = [
        hashes(written(tmp_path / word, {"other.py": f'f(\n    """{word}"""\n)\n'}))
        for word in ("one", "two")
    ]
    assert found[0] != found[1]


def test_a_zip_file_has_the_hashes_of_its_folder(tmp_path: Path) -> None:
    root = written(tmp_path)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for path in sorted(root.rglob("*")):
            archive.write(path, path.relative_to(tmp_path))
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        zipped = SourceTree({"pack": zipfile.Path(archive, "pack/")})
        assert zipped.hashes_of(["pack.main"]) == hashes(root)


def test_modules_without_sources_have_the_version(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = written(tmp_path)
    (root / "main.py").unlink()
    with caplog.at_level(logging.WARNING):
        (version,) = hashes(root).values()
    assert version.startswith("version ")
    assert "pack.main is installed without its source code" in caplog.text


def test_the_installed_package_is_read() -> None:
    """Its own hashes do not depend on where it lies: an editable installation is a folder, too."""
    found = installed_sources().hashes_of(["lightsim.store.source_hash"])
    assert set(found) == {"lightsim/store/source_hash.py", "lightsim/core/version.py"}
