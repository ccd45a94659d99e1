"""A stage reads what it declares to need, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightsim.errors import ArtefactError
from lightsim.pipeline.build import STAGES
from lightsim.pipeline.workspace import Workspace


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


def test_every_need_is_an_earlier_stage() -> None:
    names = [stage.name for stage in STAGES]
    for number, stage in enumerate(STAGES):
        assert set(stage.needs) <= set(names[:number]), stage.name
