"""`lightsim export` of scenarios of a built street, as a user runs it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.build.test_simulate import ahead_of_ego, request
from tests.conftest import BuiltStreet
from tests.export.devkit import probed

from lightsim import cli
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError
from lightsim.export.nuscenes.log import VERSION
from lightsim.export.nuscenes.tables import Tables
from lightsim.progress import SilentProgress
from lightsim.simulation import export
from lightsim.simulation.export import scenario_log
from lightsim.simulation.finished import ScenarioPlace, find_scenario, opened_scenario
from lightsim.simulation.options import ExportOptions
from lightsim.store.artefact import RECORD_NAME
from lightsim.store.images import read_png16, read_srgb8

AHEAD_M = 20.0
"""The whole car is in the picture, and the sides of its box differ little from its outline."""


@pytest.fixture(scope="module")
def folder(built_street: BuiltStreet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everybody is gone, and a red car stands in the way; with labels and, elsewhere, without."""
    work = built_street.work
    edits = [
        {"do": "remove", "actor": "all"},
        {
            "do": "insert",
            "asset": "car-red",
            "id": "mine",
            "at": ahead_of_ego(work, AHEAD_M),
        },
    ]
    path = request(tmp_path_factory.mktemp("exported"), "exported", edits)
    words = ["simulate", str(work), str(path), "--sky", "sun:120,30", "--frames", "2:4"]
    cli.main([*words, "--labels"])
    cli.main([*words, "--name", "unlabelled"])
    return work / "scenarios" / "exported"


def exported(folder: Path, out: Path, *words: str) -> Path:
    cli.main(["export", str(folder), "--out", str(out), *words])
    return out


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        cli.main(["export", *words])
    assert stopped.value.code == 1
    return capsys.readouterr().err


def test_every_format_carries_its_provenance(folder: Path, tmp_path: Path) -> None:
    for kind in ("nuscenes", "kitti", "coco", "pandaset", "lightsim"):
        out = exported(folder, tmp_path / kind, "--format", kind)
        value = json.loads((out / "provenance.json").read_text())
        assert value["format"] == kind
        assert (value["scenario"], value["sky"]["sky"]) == ("exported", "sun:120,30")
        assert [edit["do"] for edit in value["edits"]] == ["remove", "insert"]
        assert {p["source"] for p in value["pictures"]} == {"composite"}
        assert all((out / p["file"]).is_file() for p in value["pictures"])
        assert len(value["pictures"]) == (2 if kind == "kitti" else 4)
        assert value["sweeps"] == {"02": "simulated", "03": "simulated"}
        assert "sun:120,30" in (out / "README.md").read_text()
        assert (out / RECORD_NAME).is_file()
        assert not list(out.rglob("*.partial*"))


def test_labels_are_those_of_the_twin_where_none_were_written(folder: Path) -> None:
    place, other = find_scenario(folder), find_scenario(folder.with_name("unlabelled"))
    assert isinstance(place, ScenarioPlace)
    assert isinstance(other, ScenarioPlace)
    with opened_scenario(place, None, allow_stale=False) as finished:
        frame = finished.scenario.frames[0]
        written = finished.labels(frame)
        shown = folder / "labels" / frame.camera_name / f"{frame.stem}.actor.png"
        assert (written.actor_index == read_png16(shown).astype(int) - 1).all()
    with opened_scenario(other, None, allow_stale=False) as finished:
        made = finished.labels(finished.scenario.frames[0])
    assert made.actors == written.actors
    assert (made.actor_index == written.actor_index).all()
    assert [label.actor_id for label in made.actors] == ["mine"]


def test_the_log_is_that_of_the_scenario(folder: Path, built_street: BuiltStreet) -> None:
    place = find_scenario(folder)
    assert place is not None
    with opened_scenario(place, None, allow_stale=False) as finished:
        made = scenario_log(finished, SilentProgress())
        frame = made.log.frames[0]
        path = folder / "frames" / frame.camera_name / f"{frame.stem}.png"
        assert (frame.load_srgb8() == read_srgb8(path)).all()
        assert [track.actor_id for track in made.log.actors] == ["mine"]
        (mine,) = made.log.actors
        # Beams that meet the car end in it; others met a removed car or are the recorded ones.
        sweep = made.log.sweeps[0].load()
        recorded = finished.log.sweeps[2].load()
        pose = mine.world_from_actor(sweep.time_ns, 0.2)
        local = pose.inverse().apply(sweep.points_world.astype(np.float64))
        inside = (np.abs(local) < mine.size_lwh_m / 2 + 0.15).all(axis=1)
        assert inside.sum() > 20
        assert np.isin(sweep.points_world[~inside], recorded.points_world).mean() > 0.6
        assert sweep.intensity.max() <= 1.0
        assert set(sweep.ring[inside].tolist()) == {-1}
    geo = made.log.geo
    assert geo is not None
    sun = geo.sun_at(frame.time_ns)
    assert sun is not None
    assert (sun.azimuth_deg, sun.elevation_deg) == pytest.approx((120.0, 30.0), abs=0.01)
    assert Workspace(built_street.work).log.geo is not None


def test_a_complete_export_is_not_made_again_and_nothing_is_replaced(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = exported(folder, tmp_path / "out", "--format", "coco")
    made = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    exported(folder, out, "--format", "coco")
    assert made == {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    words = (str(folder), "--format", "kitti", "--out")
    assert "an export of other frames" in refused(capsys, *words, str(out))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "dear.txt").write_text("dear")
    assert "other files" in refused(capsys, *words, str(tmp_path / "mine"))
    assert (tmp_path / "mine" / "dear.txt").read_text() == "dear"
    assert "--out" in refused(capsys, *words, str(folder / "out"))
    assert "--camera" in refused(capsys, *words, str(tmp_path / "new"), "--camera", "rear")
    assert "no options of reading" in refused(
        capsys, *words, str(tmp_path / "new"), "--frames", "2:3"
    )
    assert "WORK/scenarios/NAME" in refused(
        capsys, str(tmp_path), *words[1:], str(tmp_path / "new")
    )


def test_an_interrupted_export_continues(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(export, "write_provenance", stopped)
        with pytest.raises(SystemExit) as error:
            exported(folder, tmp_path / "out", "--format", "coco")
        assert error.value.code == 130
    assert not (tmp_path / "out").exists()
    half = tmp_path / ".out.partial"
    made = {p.name: p.stat().st_mtime_ns for p in half.rglob("*.jpg")}
    assert len(made) == 2
    out = exported(folder, tmp_path / "out", "--format", "coco")
    assert made == {p.name: p.stat().st_mtime_ns for p in out.rglob("*.jpg")}
    assert not half.exists()


def test_scenarios_that_no_longer_hold_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--format", "coco", "--out", str(tmp_path / "out"))
    copy = folder.with_name("copied")
    try:
        shutil.copytree(folder, copy)
        path = copy / "frames" / "front_camera" / "02.png"
        path.write_bytes(path.read_bytes()[:-20])
        assert "damaged" in refused(capsys, str(copy), *words)
    finally:
        shutil.rmtree(copy)
    with pytest.raises(InputError, match="no finished scenario"):
        find_scenario(folder.with_name("absent"))
    assert find_scenario(tmp_path) is None
    with pytest.raises(InputError, match="--camera"):
        ExportOptions(format="coco", camera="front_camera")


def test_the_pandaset_export_is_the_written_log(folder: Path, tmp_path: Path) -> None:
    out = exported(folder, tmp_path / "out", "--format", "pandaset")
    log = read_log(LogReading(source=str(out)))
    assert [track.actor_id for track in log.actors] == ["mine"]
    assert len(log.sweeps) == 2
    assert any("simulated" in note for note in log.notes)


def test_the_lightsim_export_is_the_log_of_the_scenario(folder: Path, tmp_path: Path) -> None:
    out = exported(folder, tmp_path / "out")
    log = read_log(LogReading(source=str(out)))
    assert [track.actor_id for track in log.actors] == ["mine"]
    assert len(log.frames) == 4
    place = find_scenario(folder)
    assert place is not None
    with opened_scenario(place, None, allow_stale=False) as finished:
        made = scenario_log(finished, SilentProgress()).log
        for own in made.frames:
            (frame,) = [f for f in log.frames_of(own.camera_name) if f.time_ns == own.time_ns]
            assert (own.load_srgb8() == frame.load_srgb8()).all()
        counts = [len(sweep.load().points_world) for sweep in made.sweeps]
    assert counts == [len(sweep.load().points_world) for sweep in log.sweeps]


def test_the_devkit_draws_boxes_on_the_car(folder: Path, tmp_path: Path) -> None:
    """Its boxes are ours, and the car's outline is that of the box within 2 px."""
    out = exported(folder, tmp_path / "out", "--format", "nuscenes")
    found = probed("devkit_probe.py", tmp_path / "out.json", str(out), VERSION)
    place = find_scenario(folder)
    assert place is not None
    with opened_scenario(place, None, allow_stale=False) as finished:
        made = scenario_log(finished, SilentProgress())
        (mine,) = made.log.actors
        token = Tables(made.key).token("instance", "mine")
        boxes: dict[str, Any] = {box["file"]: box for box in found["boxes"]}
        pictures = json.loads((out / "provenance.json").read_text())["pictures"]
        seen = [p for p in pictures if p["file"] in boxes and p["camera"] == "front_camera"]
        assert len(seen) == 2
        for picture in seen:
            box = boxes[picture["file"]]
            assert (box["instance"], box["category"]) == (token, "vehicle.car")
            (frame,) = [f for f in made.log.frames_of("front_camera") if f.stem == picture["frame"]]
            corners = np.array(box["corners_px"]) + 0.5
            own, _ = frame.project(
                made.log.cameras["front_camera"],
                mine.world_from_actor(frame.time_ns).apply(mine.corners_actor),
            )
            gap = np.linalg.norm(own[:, None] - corners, axis=2).min(axis=1)
            assert gap.max() < 0.01
            label = finished.labels(frame).by_actor["mine"]
            assert label.visibility == 1.0
            # The mirrors, which are widest, are in the middle of the length of the box.
            middle, _ = frame.project(
                made.log.cameras["front_camera"],
                mine.world_from_actor(frame.time_ns).apply(mine.corners_actor * [0.0, 1.0, 1.0]),
            )
            left, top, right, bottom = label.visible_box or (0, 0, 0, 0)
            sides = np.array([left, right]) - [middle[:, 0].min(), middle[:, 0].max()]
            ends = np.array([top, bottom]) - [corners[:, 1].min(), corners[:, 1].max()]
            assert max(np.abs(sides).max(), np.abs(ends).max()) < 2.0
            assert box["lidar"] > 20
