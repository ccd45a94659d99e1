"""The rules of the house: imports run down, stages do not know each other, importing is cheap."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import lightsim
from lightsim import errors
from lightsim.store.source_hash import imported_names

SOURCES = Path(__file__).resolve().parents[1] / "src"
PRODUCT, LABORATORY = "lightsim", "lightsim_lab"
FLOORS = (
    "__main__", "cli", "api", "fleet", "app", "simulation", "export", "build", "view", "relighting",
    "lidar", "render", "scenario", "lighting", "appearance", "geometry", "reconstruct", "align",
    "masks", "datasets", "networks", "store", "core", "profiling", "progress", "errors",
)  # fmt: skip
"""Packages and modules at the top of the product, from the top down: imports only lead down."""
LAB_FLOORS = (
    "cli", "studies", "detect", "training", "baselines", "metrics", "synthetic", "weights",
)  # fmt: skip
"""The same of the laboratory; every room may import the product."""
STAGES = {
    "datasets", "masks", "align", "reconstruct", "geometry", "appearance", "lighting",
    "scenario", "render", "relighting", "view",
}  # fmt: skip
"""Steps of the build and of the simulation: they meet in build/ and simulation/ alone, through the
types of core."""
ERRORS = {
    name for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.LightSimError)
}  # fmt: skip
HEAVY = ("torch", "mitsuba", "bpy", "viser", "numba", "pandas", "av", "trimesh", "skimage")


def module_name(path: Path) -> str:
    parts = path.relative_to(SOURCES).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(source: str, modules: set[str]) -> set[str]:
    """Return the modules of this repository that a source imports, inside functions too."""
    names: set[str] = set()
    for module, member in imported_names(ast.parse(source), "", has_types=True):
        inner = f"{module}.{member}"
        names.add(inner if inner in modules else module)
    return {name for name in names if name.split(".")[0] in (PRODUCT, LABORATORY)}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """The imports of every module of both packages."""
    paths = {module_name(path): path for path in sorted(SOURCES.rglob("*.py"))}
    return {name: imports_of(path.read_text(), set(paths)) for name, path in paths.items()}


def package(module: str) -> str:
    return module.split(".")[0]


def room(module: str) -> str:
    return (module.split(".") + [""])[1]


@pytest.mark.parametrize(("name", "floors"), [(PRODUCT, FLOORS), (LABORATORY, LAB_FLOORS)])
def test_every_room_has_its_floor(
    name: str, floors: tuple[str, ...], imports: dict[str, set[str]]
) -> None:
    rooms = {room(module) for module in imports if package(module) == name}
    assert rooms - {""} == set(floors)


def test_the_product_has_at_most_24_rooms() -> None:
    assert len([name for name in FLOORS if (SOURCES / PRODUCT / name).is_dir()]) <= 24


def test_the_product_does_not_import_the_laboratory(imports: dict[str, set[str]]) -> None:
    up = [
        f"{module} -> {other}"
        for module, others in imports.items()
        for other in others
        if package(module) == PRODUCT and package(other) == LABORATORY
    ]
    assert not up


@pytest.mark.parametrize(("name", "floors"), [(PRODUCT, FLOORS), (LABORATORY, LAB_FLOORS)])
def test_imports_lead_down(
    name: str, floors: tuple[str, ...], imports: dict[str, set[str]]
) -> None:
    floor = {room_name: number for number, room_name in enumerate(floors)} | {"": len(floors)}
    up = [
        f"{module} -> {other}"
        for module, others in imports.items()
        for other in others
        if package(module) == package(other) == name
        and room(module)
        and floor[room(other)] < floor[room(module)]
    ]
    assert not up


def test_stages_do_not_know_each_other(imports: dict[str, set[str]]) -> None:
    known = [
        f"{module} -> {other}"
        for module, others in imports.items()
        for other in others
        if package(module) == package(other) == PRODUCT
        and {room(module), room(other)} <= STAGES
        and room(module) != room(other)
    ]
    assert not known


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Modules that import each other, by way of others too (Tarjan's components)."""
    import networkx

    graph = networkx.DiGraph([(a, b) for a, others in imports.items() for b in others])
    return [sorted(part) for part in networkx.strongly_connected_components(graph) if len(part) > 1]


def test_no_modules_import_each_other_in_circles(imports: dict[str, set[str]]) -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert not circles(imports)


def test_the_rules_are_read_from_the_sources() -> None:
    source = "import lightsim.core.mesh\ndef f():\n    from lightsim.store import images\n"
    modules = {"lightsim.core.mesh", "lightsim.store.images", "lightsim.store"}
    assert imports_of(source, modules) == {"lightsim.core.mesh", "lightsim.store.images"}


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


def test_mitsuba_is_imported_in_one_file() -> None:
    importing = [
        module_name(path)
        for path in sorted(SOURCES.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import) and "mitsuba" in {alias.name for alias in node.names}
    ]
    assert importing == ["lightsim.core.mitsuba_variants"]


def test_files_stay_short() -> None:
    long = {
        str(path): count
        for path in SOURCES.rglob("*.py")
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
        f"{path.relative_to(SOURCES)}:{line}"
        for path in sorted(SOURCES.rglob("*.py"))
        for line in helpless_errors(path.read_text())
    ]
    assert not helpless


def test_no_package_has_the_name_of_an_exported_function(imports: dict[str, set[str]]) -> None:
    """Importing such a package would replace the function (docs/decisions/0003)."""
    exported = set(lightsim.__all__)
    assert not exported & {room(module) for module in imports if package(module) == PRODUCT}
