"""The rules of the house: stages meet only in pipeline.py, and importing is cheap."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from lightsim import errors

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "lightsim"
STAGES = {
    "align", "ingest", "reconstruct", "assets", "lighting", "assemble", "edit", "render",
    "relighting", "baselines", "video", "evaluate", "view",
}  # fmt: skip
ERRORS = {
    name for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.LightSimError)
}  # fmt: skip
HEAVY = ("torch", "mitsuba", "bpy", "viser", "numba", "pandas", "av", "trimesh", "skimage")


def imported_modules(path: Path) -> set[str]:
    """Every lightsim module a file imports, inside functions too."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return {name for name in found if name.startswith("lightsim.")}


def python_files(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((PACKAGE / folder).rglob("*.py"))]


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_stages_do_not_import_each_other(stage: str) -> None:
    for path in python_files(stage):
        others = {name.split(".")[1] for name in imported_modules(path)} & (STAGES - {stage})
        assert not others, f"{path.name} imports {others}"


def test_core_imports_no_stage_and_no_store() -> None:
    for path in python_files("core"):
        names = {name.split(".")[1] for name in imported_modules(path)}
        assert names <= {"core", "errors"}, path.name


def test_only_the_top_imports_the_viewer_and_the_pipeline() -> None:
    for path in python_files("core", "store", *STAGES):
        names = {name.split(".")[1] for name in imported_modules(path)}
        assert not names & {"pipeline", "cli"}, path.name


@pytest.mark.parametrize("code", ["import lightsim", "from lightsim.cli import main; main(['-h'])"])
def test_importing_is_light(code: str) -> None:
    script = (
        "import sys\n"
        "try:\n"
        f"    {code}\n"
        "except SystemExit as stop:\n"
        "    assert not stop.code\n"
        f"heavy = sorted(m for m in {HEAVY!r} if m in sys.modules)\n"
        "print('LOADED', heavy)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().endswith("LOADED []"), done.stdout


def test_files_stay_short() -> None:
    long = {
        path.name: count
        for path in PACKAGE.rglob("*.py")
        if (count := len(path.read_text().splitlines())) > 400
    }
    assert not long


def helpless_errors(source: str) -> list[int]:
    """Lines that make an error of ours with neither `expected` nor `remedy`."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "id", None) or getattr(node.func, "attr", None)
        given = {keyword.arg for keyword in node.keywords if not is_none(keyword.value)}
        if name in ERRORS and not given & {"expected", "remedy"}:
            lines.append(node.lineno)
    return lines


def is_none(value: ast.expr) -> bool:
    return isinstance(value, ast.Constant) and value.value is None


def test_errors_say_what_was_expected_or_what_to_do() -> None:
    assert helpless_errors('raise InputError("a", where=x, got=y)\nraise error.at(path)') == [1]
    assert helpless_errors('raise errors.InputError("a", remedy=None)') == [1]
    assert not helpless_errors('raise ArtefactError("a", remedy="Build again.")')
    helpless = [
        f"{path.relative_to(PACKAGE)}:{line}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line in helpless_errors(path.read_text())
    ]
    assert not helpless
