"""Finished scenarios: their folder in a work folder, and the scenario that it was made from."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.workspace import OPTIONS_NAME, Workspace
from lightsim.core.frame_labels import FrameLabels
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import ArtefactError, InputError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import StaticScene, make_static_scene, place
from lightsim.scenario.apply import driven_beside
from lightsim.scenario.edits import Insert, ScenarioRequest, read_scenario_request
from lightsim.simulation.claims import image_scale_of, opened_for
from lightsim.simulation.edited import asset_library, edited_scenario
from lightsim.simulation.labels import actor_labels, has_labels, read_labels
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.store.artefact import RECORD_NAME, json_ready, require_whole
from lightsim.store.entries import Entries
from lightsim.store.scenario import SCENARIO_NAME, scenario_entries

_REMEDY = "Run the same lightsim relight or simulate again."
# Maximum difference between numbers in scenario.json and in the scenario that is made again from
# its edits, in metres or radians: rounding depends on the processor.
_SAME = 1e-6


@dataclass(frozen=True)
class ScenarioPlace:
    """Place of a finished scenario: WORK/scenarios/NAME, or WORK/scenarios/NAME/<sky>."""

    work: Path
    name: str
    folder: Path


def finished_scenarios(folder: Path) -> list[Path]:
    """Return the folders of the scenarios in a work folder, or in its folder `scenarios`."""
    base = folder if folder.name == "scenarios" else folder / "scenarios"
    if not (base.parent / OPTIONS_NAME).is_file():
        return []
    records = [*base.glob(f"*/{RECORD_NAME}"), *base.glob(f"*/*/{RECORD_NAME}")]
    return sorted(path.parent for path in records if not path.parent.name.startswith("."))


def find_scenario(folder: Path) -> ScenarioPlace | None:
    """Return the place of a scenario's folder; None for a folder outside of a work folder.

    Raises:
        InputError: the folder has no finished scenario, or those of several skies.
    """
    folder = folder.resolve()
    for base in (folder, folder.parent):
        work = base.parent.parent
        if base.parent.name == "scenarios" and (work / OPTIONS_NAME).is_file():
            break
    else:
        return None
    if (folder / RECORD_NAME).is_file():
        return ScenarioPlace(work, base.name, folder)
    skies = sorted(path.parent.name for path in folder.glob(f"*/{RECORD_NAME}"))
    if skies:
        raise InputError(
            "the scenario has several skies",
            where=folder,
            expected=f"the folder of one: {folder}/ followed by {' or '.join(skies)}",
        )
    raise InputError("the folder has no finished scenario", where=folder, remedy=_REMEDY)


@dataclass(frozen=True, eq=False)
class FinishedScenario:
    """A finished scenario with the objects that it was made from.

    Args:
        folder: WORK/scenarios/NAME.
        workspace: the twin.
        log: the recording at the image size of the scenario.
        recorded: the log without edits, in the chosen frames.
        scenario: made from it by edits; the same object if there are none.
        written: scenario.json.
        key: artefact key of the frames.
    """

    folder: Path
    workspace: Workspace
    log: DrivingLog
    recorded: Scenario
    scenario: Scenario
    written: Mapping[str, Any]
    key: str

    def labels(self, frame: CameraFrame) -> FrameLabels:
        """Return the labels of a picture from its files, or render them from the twin if the
        scenario was made without --labels; both are equal."""
        if has_labels(self.folder, frame):
            return read_labels(self.folder, frame)
        camera = self.scenario.cameras[frame.camera_name]
        scene = place(self._static, self.scenario, frame.time_ns)
        # The buffer distinguishes static surfaces from none, both negative; files do not.
        shown = np.maximum(render_gbuffers(scene, camera, frame).actor_index, -1)
        return FrameLabels(tuple(actor_labels(self.scenario, frame, camera, shown)), shown)

    @cached_property
    def _static(self) -> StaticScene:
        return make_static_scene([self.workspace.twin.assets.background])


@contextmanager
def opened_scenario(
    where: ScenarioPlace, library: Path | None, *, allow_stale: bool
) -> Generator[FinishedScenario]:
    """Open a finished scenario while no other process makes a scenario of its name.

    Args:
        library: folder of the asset library of the scenario; None for the user's.

    Raises:
        ArtefactError: the scenario or the twin is damaged, or the twin or an asset has changed.
        InputError: an asset is unknown.
    """
    record = require_whole(where.folder, _REMEDY)
    if record is None or record["stage"] != "relight":
        raise InputError("the folder has no finished scenario", where=where.folder, remedy=_REMEDY)
    file = Entries.of_file(where.folder / SCENARIO_NAME, _REMEDY)
    options = _options(file, where.name, allow_stale=allow_stale)
    with opened_for(where.work, options) as workspace:
        if record["inputs"].get("twin") != workspace.record("twin")["key"]:
            raise ArtefactError(
                "the twin has been built again since the scenario was made",
                where=where.folder,
                remedy=_REMEDY,
            )
        recorded = replayed(workspace, options)
        scenario_request = read_scenario_request(where.folder / SCENARIO_NAME)
        scenario = _made_again(workspace, recorded, scenario_request, library, record)
        if options.ego_offset is not None:
            scenario = driven_beside(scenario, options.ego_offset)
        _check_same(scenario, file.mapping(), where.folder)
        log = workspace.log_at(image_scale_of(workspace, options))
        yield FinishedScenario(
            where.folder, workspace, log, recorded, scenario, file.mapping(), record["key"]
        )


def _options(file: Entries, name: str, *, allow_stale: bool) -> RelightOptions:
    """Return the options that select the frames of a scenario."""
    options = file.object("options")
    offset = options.numbers("ego_offset_m", (3,)) if "ego_offset_m" in options else ()
    return RelightOptions(
        name=name,
        cameras=options.texts("cameras"),
        frames=options.text("frames"),
        image_scale=options.number("image_scale"),
        ego_offset_m=",".join(repr(float(value)) for value in offset),
        seed=int(file.number("seed")),
        allow_stale=allow_stale,
    )


def _made_again(
    workspace: Workspace,
    recorded: Scenario,
    scenario_request: ScenarioRequest,
    library: Path | None,
    record: Mapping[str, Any],
) -> Scenario:
    """Return the scenario of the edits in scenario.json.

    Raises:
        ArtefactError: an asset has changed.
    """
    if not scenario_request.edits:
        return recorded
    assets = asset_library(library, scenario_request.source.parent)
    keys = record["config"].get("assets", {})
    for edit in scenario_request.edits:
        if isinstance(edit, Insert) and assets.key(edit.asset) != keys.get(edit.asset):
            raise ArtefactError(
                "the asset has changed since the scenario was made",
                where=f"asset '{edit.asset}'",
                remedy=f"Give the --library of the scenario. Otherwise: {_REMEDY}",
            )
    return edited_scenario(workspace, recorded, scenario_request, assets)


def _check_same(scenario: Scenario, written: Mapping[str, Any], folder: Path) -> None:
    """Check that a scenario has the poses, boxes and cameras of scenario.json."""
    again = json_ready(scenario_entries(scenario))
    other = [name for name, value in again.items() if not _is_same(value, written.get(name))]
    if other:
        raise ArtefactError(
            "the scenario differs from the one that the frames were made of",
            where=folder,
            got=f"other entries in scenario.json: {', '.join(other)}",
            remedy=_REMEDY,
        )


def _is_same(one: Any, other: Any) -> bool:
    """Return whether two JSON values are equal but for rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_is_same(one[k], other[k]) for k in one)
    if isinstance(one, list) and isinstance(other, list):
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(_is_same(a, b) for a, b in pairs)
    if isinstance(one, float) and isinstance(other, float | int):
        return bool(np.isclose(one, other, rtol=0.0, atol=_SAME))
    return one == other
