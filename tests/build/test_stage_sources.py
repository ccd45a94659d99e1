"""A changed constant makes the stages that use it stale, and no others."""

from __future__ import annotations

import ast
import json
import re
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from lightsim.build import workspace
from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import PUBLISHED, STAGES, artefact_keys
from lightsim.build.sources import (
    RECORDING,
    UNCOUNTED,
    WORKSPACE,
    simulation_sources,
    stage_sources,
)
from lightsim.core.reading import OWN_DATASETS, LogReading
from lightsim.relighting.methods import module_of_method
from lightsim.store.artefact import ArtefactKey, make_artefact, read_record, state_of
from lightsim.store.source_hash import SourceTree, imported_names
from lightsim.store.staleness import explain_staleness

PACKAGE = Path(workspace.__file__).parents[1]
OPTIONS = BuildOptions(reading=LogReading(source="x"))
ALL = tuple(stage.name for stage in STAGES)
FROM_SKY = ("sky", "twin", "measures", "report")
FROM_GEOMETRY = ("geometry", "assets", "panorama", *FROM_SKY)
FROM_MASKS = ("masks", "held_out_masks", "neural", *FROM_GEOMETRY)
CHANGES = [
    # File, text, text instead; stages whose own sources it is in; stages that are stale by it.
    ("masks/ego_vehicle.py", "_IMAGES = 12", "_IMAGES = 9", ("log",), ALL),
    ("masks/sky.py", "_SWEEP_STEP = 6", "_SWEEP_STEP = 5", FROM_MASKS[:2], FROM_MASKS),
    (
        "reconstruct/field/sampling.py",
        "_MARCHED_SAMPLES = 25",
        "_MARCHED_SAMPLES = 16",
        ("neural", "measures", "report"),
        ("neural", *FROM_GEOMETRY),
    ),
    (
        "geometry/completion/kerbs.py",
        "sample_m = 0.1 ",
        "sample_m = 0.2 ",
        ("geometry", "assets", "sky", "twin"),
        FROM_GEOMETRY,
    ),
    ("lighting/sun/posterior.py", "_SUNNY_PRIOR = 0.5", "_SUNNY_PRIOR = 0.6", ("sky",), FROM_SKY),
    (
        "appearance/intrinsic/hidden_surfaces.py",
        "_LEVEL_M = 0.3",
        "_LEVEL_M = 0.4",
        ("sky", "twin"),
        FROM_SKY,
    ),
    ("view/templates/report.html.jinja", "</html>", "</html>\n", ("report",), ("report",)),
    (
        "data/weights/manifest.json",
        '"sky-small.safetensors": "',
        '"sky-small.safetensors": "00',
        ("sky",),
        FROM_SKY,
    ),
    ("relighting/physical/ratio.py", "import annotations", "import annotations as _", (), ()),
    ("errors.py", '"""An artefact folder', '"""A folder', (), ()),
    ("errors.py", "from __future__ import annotations", "_ADDED = 1", (), ()),
    ("masks/sky.py", "_SWEEP_STEP = 6", "_SWEEP_STEP = 6  # Each sixth.", (), ()),
]
"""Of the rows of `STAGES`, with the default options."""


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package's sources and the list of its weights."""
    root = tmp_path_factory.mktemp("sources") / "lightsim"
    left_out = shutil.ignore_patterns("__pycache__", "street", "*.safetensors")
    shutil.copytree(PACKAGE, root, ignore=left_out)
    return root


def keys_of(root: Path) -> dict[str, ArtefactKey]:
    return artefact_keys(OPTIONS, "source", SourceTree({"lightsim": root}))


@pytest.fixture(scope="module")
def keys(copied: Path) -> dict[str, ArtefactKey]:
    """Keys of the unchanged sources; the installed package has the same."""
    found = keys_of(copied)
    assert found == artefact_keys(OPTIONS, "source")
    return found


@pytest.mark.parametrize(("path", "old", "new", "own", "stale"), CHANGES)
def test_a_change_makes_its_stages_stale_and_no_others(
    copied: Path,
    keys: dict[str, ArtefactKey],
    path: str,
    old: str,
    new: str,
    own: tuple[str, ...],
    stale: tuple[str, ...],
) -> None:
    file = copied / path
    text = file.read_text()
    assert text.count(old) == 1
    try:
        file.write_text(text.replace(old, new))
        after = keys_of(copied)
    finally:
        file.write_text(text)
    assert {name for name in ALL if after[name].sources != keys[name].sources} == set(own)
    assert {name for name in ALL if after[name].key != keys[name].key} == set(stale)


def test_lists_name_modules_of_the_package() -> None:
    for name in (*UNCOUNTED, WORKSPACE, *RECORDING):
        assert (PACKAGE.parent / f"{name.replace('.', '/')}.py").is_file(), name


def test_packages_on_the_way_to_a_module_hold_no_code() -> None:
    """Importing a module executes the `__init__.py` above it, which counts where it is named."""
    with_code = {
        path.parent.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("__init__.py")
        if any(not isinstance(node, ast.Expr) for node in ast.parse(path.read_text()).body)
    }
    assert with_code == {".", "cli"}


def test_no_module_of_ours_is_imported_by_a_computed_name() -> None:
    """The walk over imports would not find it."""
    computed = re.compile(r"\b(import_module|__import__|exec)\(")
    importing = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if computed.search(path.read_text())
    }
    # Readers of data sets are named in RECORDING; the two others import installed libraries.
    assert importing == {"datasets/reader.py", "errors.py", "render/reference/cycles_worker.py"}
    assert {f"lightsim.datasets.{name}.log" for name in OWN_DATASETS} <= set(RECORDING)


def made_by(stages: Iterable[str]) -> set[str]:
    """Paths of the sources of stages and of all that they need, under any preset."""
    rows = [row for row in (*STAGES, *PUBLISHED) if row.name in stages]
    found = {p for row in rows for p in stage_sources(row.make, is_first=not row.needs)}
    needs = {name for row in rows for name in row.needs} - set(stages)
    return found | (made_by({*stages, *needs}) if needs else set())


def test_what_reads_an_artefact_is_in_the_sources_of_what_wrote_it() -> None:
    """So the work folder's imports need not count: the key of the artefact has them."""
    tree = ast.parse(Path(workspace.__file__).read_text())
    imports = {
        member: f"{module}.{member}" if is_module(f"{module}.{member}") else module
        for module, member in imported_names(tree, "lightsim.build")
        if module.startswith("lightsim.") and module not in UNCOUNTED
    }
    (owner,) = (n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == "Workspace")
    checked = set()
    for function in (node for node in owner.body if isinstance(node, ast.FunctionDef)):
        sources = made_by(stages_in(function) or {"log"})
        for node in ast.walk(ast.Module(function.body, [])):
            module = imports.get(node.id) if isinstance(node, ast.Name) else None
            if module is not None:
                assert f"{module.replace('.', '/')}.py" in sources, (function.name, module)
                checked.add(module)
    readers = ("store.sky", "store.assets", "datasets.reader", "masks.ego_vehicle")
    assert {f"lightsim.{name}" for name in readers} <= checked


def is_module(name: str) -> bool:
    return (PACKAGE.parent / f"{name.replace('.', '/')}.py").is_file()


def stages_in(function: ast.FunctionDef) -> set[str]:
    """Stages of the decorator `made_of`."""
    calls = [d for d in function.decorator_list if isinstance(d, ast.Call)]
    return {str(a.value) for call in calls for a in call.args if isinstance(a, ast.Constant)}


def test_a_registered_method_counts_with_its_own_package() -> None:
    relight = "lightsim.simulation.relight"
    own = simulation_sources(relight, module_of_method("physical"))
    theirs = simulation_sources(relight, "lightsim_lab.baselines.methods")
    assert own.items() <= theirs.items()
    assert {path.split("/")[0] for path in own} == {"lightsim"}
    assert "lightsim_lab/baselines/epe.py" in theirs


def test_the_cause_is_told(tmp_path: Path, copied: Path, keys: dict[str, ArtefactKey]) -> None:
    sky = keys["sky"]
    record = make_artefact(tmp_path / "sky", sky, lambda folder: ())
    assert record == read_record(tmp_path / "sky")
    changed = {path: "" if "posterior" in path else digest for path, digest in sky.sources.items()}
    assert explain_staleness(record, replace(sky, sources=changed)) == (
        "made by other code: lightsim/lighting/sun/posterior.py changed",
    )
    more = {**dict.fromkeys(list(sky.sources)[:4], ""), "lightsim/new.py": ""}
    (reported,) = explain_staleness(record, replace(sky, sources={**changed, **more}))
    assert re.fullmatch(r"made by other code: (\S+ changed, ){2}\S+ changed and 3 more", reported)
    config = {**sky.config, "model": "paper", "sun": {**sky.config["sun"], "gps": "none"}}
    other = replace(sky, config=config, seed=1, inputs={**sky.inputs, "geometry": "0"})
    assert explain_staleness(record, other) == (
        "made with other settings: sun.gps = 'all', now 'none', model = 'analytic', now 'paper'",
        "its inputs have changed: geometry",
        "made with seed 0 instead of 1",
    )
    old = {name: value for name, value in record.items() if name != "sources"}
    assert explain_staleness({**old, "schema": 14, "package_version": "0.2.0"}, sky) == (
        "made by LightSim 0.2.0, which did not record its code",
    )


@pytest.mark.parametrize("sources", [[], {"a.py": 1}, "a", None])
def test_a_record_with_damaged_sources_is_broken(tmp_path: Path, sources: object) -> None:
    folder, key = tmp_path / "toy", ArtefactKey("toy", {"a.py": "1"}, {}, {}, 0)
    record = make_artefact(folder, key, lambda folder: ())
    (folder / "artefact.json").write_text(json.dumps({**record, "sources": sources}))
    assert state_of(folder, key) == "broken"
