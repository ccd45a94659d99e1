"""The ego vehicle is searched for once; later commands read it from the artefact `log`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.workspace import Workspace
from lightsim.core.lidar_returns import EgoBox
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.masks import ego_body, ego_vehicle
from lightsim.progress import SilentProgress
from lightsim_lab.synthetic import shipped_street


def test_the_ego_vehicle_is_searched_for_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searches: list[str] = []
    box = EgoBox(np.array([-2.0, -1.0, 0.2]), np.array([2.5, 1.0, 1.8]))

    def look(views: Any, ego: Any) -> tuple[dict, tuple[str, ...]]:
        searches.append("pictures")
        camera = views[0][0]
        mask = np.zeros((camera.height_px, camera.width_px), dtype=bool)
        mask[-20:, 3:-5] = True
        return {camera.name: mask}, ("a note",)

    def with_body(log: DrivingLog, held_out: frozenset[str] = frozenset()) -> DrivingLog:
        searches.append("sweeps")
        return replace(log, ego_box=box, notes=(*log.notes, "a box"))

    monkeypatch.setattr(ego_vehicle, "ego_vehicle_masks", look)
    monkeypatch.setattr(ego_body, "with_ego_body", with_body)
    source = str(shipped_street() / "log")
    reading = LogReading(source=source, cameras=("front_camera",), frames="0:4")
    options = BuildOptions(reading=reading)
    made = build(tmp_path, options, SilentProgress(), until="log").recorded_log
    again = Workspace(tmp_path).recorded_log
    assert searches == ["pictures", "sweeps"]
    assert again.notes == made.notes
    assert {"a note", "a box"} <= set(again.notes)
    np.testing.assert_array_equal(
        again.ego_vehicle_masks["front_camera"], made.ego_vehicle_masks["front_camera"]
    )
    assert again.ego_box is not None
    np.testing.assert_array_equal(again.ego_box.low_m, box.low_m)
    np.testing.assert_array_equal(again.ego_box.high_m, box.high_m)
    # A stale artefact is not believed: the stage searches anew.
    options = BuildOptions(reading=replace(reading, frames="0:5"))
    build(tmp_path, options, SilentProgress(), until="log")
    assert len(searches) == 4
