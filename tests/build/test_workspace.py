"""A stage reads what it declares to need, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lightsim.build.pipeline import PUBLISHED, STAGES
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.errors import ArtefactError
from lightsim.masks import ego_vehicle
from lightsim_lab.synthetic import shipped_street


@pytest.mark.parametrize(
    ("value", "stages"),
    [
        ("log", ("log", "alignment")),
        ("training_log", ("log", "alignment")),
        ("recorded_log", ("log",)),
        ("fields", ("neural",)),
        ("scene_field", ("log", "alignment", "fields", "neural")),
        ("twin", ("log", "alignment", "sky", "twin")),
    ],
)
def test_what_a_stage_does_not_declare_is_closed_to_it(
    tmp_path: Path, value: str, stages: tuple[str, ...]
) -> None:
    work = Workspace(tmp_path)
    for closed in stages:
        rest = [stage.name for stage in STAGES if stage.name != closed]
        with pytest.raises(AssertionError, match=f"'{closed}' is not declared"), work.opened(rest):
            getattr(work, value)
    with pytest.raises(ArtefactError, match="has not been made"), work.opened(stages):
        getattr(work, value)


def test_a_value_read_before_is_closed_too(tmp_path: Path) -> None:
    """What an earlier stage read is kept, but not for a stage that does not declare it."""
    work = Workspace(tmp_path)
    work.__dict__["_values"] = {"panorama": "read before"}
    assert work.panorama == "read before"
    with pytest.raises(AssertionError, match="'panorama'"), work.opened(["log"]):
        _ = work.panorama


def test_a_folder_without_a_build_is_not_offered_as_its_target(tmp_path: Path) -> None:
    """The error of `relight RECORDING` proposed to build into the recording."""
    for root, found in ((tmp_path, "a folder without build.json"), (tmp_path / "no", "no such")):
        with pytest.raises(ArtefactError, match=f"got {found}") as caught:
            Workspace(root).need("twin")
        assert str(root) not in str(caught.value.remedy)


def test_every_need_is_an_earlier_stage() -> None:
    names = [stage.name for stage in STAGES]
    for stage in (*STAGES, *PUBLISHED):
        assert set(stage.needs) <= set(names[: names.index(stage.name)]), stage.name


def test_the_recording_car_is_not_looked_for_in_held_out_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: set[str] = set()

    def look(views: Any, ego: Any) -> tuple[dict, tuple[str, ...]]:
        seen.update(frame.stem for _, frames in views for frame in frames)
        return {}, ()

    monkeypatch.setattr(ego_vehicle, "ego_vehicle_masks", look)
    source = shipped_street() / "log"
    reading = LogReading(source=str(source), cameras=("front_camera",), frames="0:8", hold_out=4)
    work = Workspace(tmp_path, reading, {})
    assert work.held_out == {"02", "06"}
    assert seen & work.held_out == set()
    assert len(seen) == len(list((source / "camera" / "front_camera").glob("*.jpg"))) - 2
