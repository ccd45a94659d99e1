"""Every effective setting is in an artefact's key: changing any default makes it stale."""

from __future__ import annotations

import ast
import copy
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest

import lightsim.build.stages as stages_package
import lightsim.build.stages.published.sky as published_sky
from lightsim.build.options import PRESETS, BuildOptions, Preset, SkyModel
from lightsim.build.pipeline import STAGES, artefact_keys, stages_of
from lightsim.core.reading import LogReading
from lightsim.simulation.relighter import RelightConfig
from lightsim.store.artefact import ArtefactKey, json_ready


def options(preset: Preset) -> BuildOptions:
    return BuildOptions(reading=LogReading(source="x"), preset=preset)


def with_one_change(config: Any) -> Iterator[tuple[str, Any]]:
    """The config with each of its leaves changed, nested ones too, and the leaf's name; a stage
    without settings has none: its constants are in its sources (test_stage_sources.py)."""
    if config is None:
        return
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            changes = with_one_change(value)
        else:
            changes = iter([("", (value, "changed"))])
        for name, other in changes:
            changed = copy.copy(config)
            object.__setattr__(changed, field.name, other)  # Past checks: any change will do.
            yield f"{field.name}.{name}", changed


def key(config: Any) -> str:
    return ArtefactKey("stage", {}, {"config": json_ready(config)}, {}, 0).key


@pytest.mark.parametrize("preset", PRESETS)
def test_every_setting_of_a_stage_decides_its_key(preset: Preset) -> None:
    chosen = options(preset)
    configs: dict[str, Any] = {s.name: s.config(chosen) for s in stages_of(chosen)}
    configs["relight"] = RelightConfig()
    seen = 0
    for stage, config in configs.items():
        for name, changed in with_one_change(config):
            assert key(changed) != key(config), f"{stage}: {name}"
            seen += 1
    assert seen > 60


def test_the_sky_model_decides_the_sky_and_what_needs_it() -> None:
    plain, paper = (
        artefact_keys(dataclasses.replace(options("draft"), sky_model=model), "source")
        for model in get_args(SkyModel)
    )
    changed = {name for name in plain if plain[name].key != paper[name].key}
    assert changed == {"sky", "twin", "measures", "report"}


def test_the_content_of_weights_decides_the_sky_and_what_needs_it(tmp_path: Path) -> None:
    file, moved = tmp_path / "a", tmp_path / "b"
    for preset in PRESETS:
        for option in ("sky_weights", "inpaint_weights"):
            plain = artefact_keys(options(preset), "source")
            found = []
            for path, content in ((file, b"one"), (moved, b"one"), (moved, b"two")):
                path.write_bytes(content)
                chosen = dataclasses.replace(options(preset), **{option: path})
                found.append(artefact_keys(chosen, "source"))
            given, elsewhere, changed = found
            # The place of the file does not matter.
            assert {k.key for k in given.values()} == {k.key for k in elsewhere.values()}
            for other in (plain, changed):
                stale = {name for name in given if given[name].key != other[name].key}
                assert stale == {"sky", "twin", "measures", "report"}


def test_shipped_weights_of_the_published_form_are_a_file_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`--preset paper` uses weights of this name, which the package has, and no other preset."""
    monkeypatch.setattr(published_sky, "list_weights", dict)
    before = {p: artefact_keys(options(p), "source")["sky"].key for p in PRESETS}
    monkeypatch.undo()
    after = {p: artefact_keys(options(p), "source")["sky"].key for p in PRESETS}
    assert {p for p in PRESETS if before[p] != after[p]} == {"paper"}


def test_the_cameras_of_the_field_leave_the_panoramas_settings() -> None:
    for preset in PRESETS:
        chosen = dataclasses.replace(options(preset), field_cameras=("front_camera",))
        plain, other = (artefact_keys(o, "source") for o in (options(preset), chosen))
        stale = {name for name in plain if plain[name].key != other[name].key}
        assert "neural" in stale
        assert not stale & {"log", "masks", "held_out_masks", "alignment", "fields"}
        assert other["panorama"].config == plain["panorama"].config


def test_the_papers_system_shares_the_recording_and_its_alignment_alone() -> None:
    """What the paper takes from its data set is common ground; all that follows is another's."""
    ours, theirs = (artefact_keys(options(preset), "source") for preset in ("standard", "paper"))
    shared = {name for name in ours if ours[name].key == theirs[name].key}
    assert shared == {"log", "masks", "held_out_masks", "alignment"}
    assert [stage.name for stage in stages_of(options("paper"))] == [s.name for s in STAGES]


def made_in_functions(source: str) -> list[str]:
    """Configs that a function makes for itself, behind the back of the recipe."""
    return [
        f"{call.func.id} in line {call.lineno}"
        for function in ast.walk(ast.parse(source))
        if isinstance(function, ast.FunctionDef)
        for call in ast.walk(function)
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id.endswith("Config")
    ]


def test_stages_make_no_settings_of_their_own() -> None:
    assert made_in_functions("def f():\n    return g(SkyConfig())") == ["SkyConfig in line 2"]
    assert not made_in_functions("x: A = field(default_factory=lambda: AConfig(1))")
    for path in sorted(Path(stages_package.__path__[0]).rglob("*.py")):
        assert not made_in_functions(path.read_text()), path.name
