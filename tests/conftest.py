"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import sys
import tomllib
from collections import Counter
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Shares tests out among processes (`pytest -n N --dist loadscope`): a module goes to one, and
    so do all that need the built street, which each process would build."""
    from xdist.scheduler import LoadScopeScheduling

    class ByModule(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _group(config.rootpath / nodeid.split("::")[0])

    return ByModule(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow groups begin."""
    groups = [_group(item.path) for item in items]
    slow = {g for g, item in zip(groups, items, strict=True) if item.get_closest_marker("slow")}
    first = {g: k for k, g in reversed(list(enumerate(groups)))}
    order = sorted(zip(groups, items, strict=True), key=lambda x: (x[0] not in slow, first[x[0]]))
    items[:] = [item for _, item in order]


@cache
def _group(module: Path) -> str:
    return "built_street" if "built_street" in module.read_text() else str(module)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real logs, skies and CAD models that is not part of the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LIGHTSIM_DATA", default))
    if not path.is_dir():
        pytest.skip(f"needs the development data at {path} (or $LIGHTSIM_DATA)")
    return path


@dataclass(frozen=True)
class BuiltStreet:
    """A twin of a small part of the shipped street, as a user builds it.

    Args:
        work: the work folder; whoever damages it mends it.
        words: of `lightsim` that made it.
        reads: (stage, stem) of every picture and sweep that was loaded meanwhile.
        decoded: how often each sweep was.
    """

    work: Path
    words: tuple[str, ...]
    reads: frozenset[tuple[str, str]]
    decoded: Mapping[str, int]


@pytest.fixture(scope="session")
def built_street(tmp_path_factory: pytest.TempPathFactory) -> BuiltStreet:
    """Preset `standard`: two cameras, four frames of 120x68 pixels, the frame 01 held out."""
    from lightsim import cli
    from lightsim_lab.synthetic import shipped_street

    work = tmp_path_factory.mktemp("street")
    words = (
        *("build", str(shipped_street() / "log"), "--work", str(work), "--frames", "0:4"),
        *("--cameras", "front_camera,left_camera", "--image-scale", "0.25"),
        *("--hold-out", "3", "--neural-steps", "20", "--preset", "standard"),
    )
    with recorded_reads() as reads:
        cli.main(words)
    pictures_and_sweeps, decoded = reads
    return BuiltStreet(work, words, frozenset(pictures_and_sweeps), decoded)


@contextmanager
def recorded_reads() -> Generator[tuple[set[tuple[str, str]], Counter[str]]]:
    """Collects (stage, stem) of the pictures and sweeps that a build loads, and how often
    each sweep was."""
    from lightsim.build.workspace import Workspace
    from lightsim.datasets.pandaset import cameras, log

    reads: set[tuple[str, str]] = set()
    decoded: Counter[str] = Counter()
    stage = ""
    opened, load_image, load_sweep = Workspace.opened, cameras.load_image, log.load_sweep

    def open_stage(work: Workspace, stages: Iterable[str]) -> Any:
        nonlocal stage
        names = tuple(stages)
        stage = names[-1]
        return opened(work, names)

    def read_image(path: Path, *size: int) -> Any:
        reads.add((stage, path.stem))
        return load_image(path, *size)

    def read_sweep(source: Any) -> Any:
        reads.add((stage, source.stem))
        decoded[source.stem] += 1
        return load_sweep(source)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Workspace, "opened", open_stage)
        patch.setattr(cameras, "load_image", read_image)
        patch.setattr(log, "load_sweep", read_sweep)
        yield reads, decoded


@pytest.fixture
def example_extension(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[None]:
    """The package in examples/extensions, as pip installs it: its sources and its entry points."""
    from lightsim.core.extensions import registered

    folder = Path(__file__).resolve().parents[1] / "examples" / "extensions"
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    name, version = project["name"], project["version"]
    info = tmp_path / "site" / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = project["entry-points"].items()
    entries = ["".join(f"{key} = {value}\n" for key, value in group.items()) for _, group in groups]
    lines = [f"[{group}]\n{text}" for (group, _), text in zip(groups, entries, strict=True)]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.setattr(sys, "path", [str(info.parent), str(folder), *sys.path])
    registered.cache_clear()
    yield
    registered.cache_clear()
