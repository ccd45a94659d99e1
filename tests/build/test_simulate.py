"""`lightsim simulate` on a built street, as a user runs it."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.conftest import BuiltStreet

from lightsim import cli
from lightsim.build.workspace import Workspace
from lightsim.scenario.edits import read_scenario_request
from lightsim.store.images import read_grey8, read_srgb8
from lightsim_lab.studies.demo import next_steps

ONE_FRAME = ("--frames", "0:1", "--cameras", "front_camera")


def request(folder: Path, name: str, edits: list[dict[str, Any]], **more: Any) -> Path:
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"version": 1, "name": name, "edits": edits, **more}))
    return path


def picture(work: Path, name: str) -> np.ndarray:
    return read_srgb8(work / "scenarios" / name / "frames" / "front_camera" / "00.png")


def ahead_of_ego(work: Path, ahead_m: float) -> dict[str, float]:
    log = Workspace(work).log
    pose = log.ego.at(log.frames_of("front_camera")[0].time_ns, 0.2)
    x, y = (pose.translation_m + ahead_m * pose.rotation[:, 0])[:2].tolist()
    return {"x_m": x, "y_m": y, "yaw_deg": float(np.degrees(pose.yaw_rad))}


def test_a_scenario_without_edits_is_a_relight(built_street: BuiltStreet, tmp_path: Path) -> None:
    work = built_street.work
    cli.main(["relight", str(work), "--name", "plain", "--sky", "sun:120,30", *ONE_FRAME])
    path = request(tmp_path, "nothing", [], sky="sun:120,30")
    cli.main(["simulate", str(work), str(path), *ONE_FRAME])
    assert (picture(work, "plain") == picture(work, "nothing")).all()
    page = (work / "scenarios" / "nothing" / "report.html").read_text()
    assert "lightsim relight, sun:120,30" in page


def test_pictures_do_not_depend_on_the_number_of_jobs(built_street: BuiltStreet) -> None:
    work = built_street.work
    words = ["relight", str(work), "--sky", "sun:120,30", "sun:240,20", "--frames", "0:2"]
    for jobs in ("1", "3"):
        cli.main([*words, "--name", f"jobs{jobs}", "--jobs", jobs])
    alone, shared = work / "scenarios" / "jobs1", work / "scenarios" / "jobs3"
    pictures = [path.relative_to(alone) for path in alone.rglob("frames/**/*.png")]
    assert len(pictures) >= 4
    for path in pictures:
        assert (alone / path).read_bytes() == (shared / path).read_bytes(), path


def test_edits_are_made_written_down_and_kept(built_street: BuiltStreet, tmp_path: Path) -> None:
    """Everything is made once; other edits of the same name are refused; what is written can be
    read, and given again."""
    work = built_street.work
    edits = [
        {"do": "remove", "actor": "all"},
        {"do": "insert", "asset": "car-red", "id": "mine", "at": ahead_of_ego(work, 9.0)},
    ]
    path = request(tmp_path, "edited", edits)
    words = ["simulate", str(work), str(path), "--labels", *ONE_FRAME]
    cli.main(words)
    folder = work / "scenarios" / "edited"
    made = {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}
    cli.main(words)
    assert made == {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}

    assert "lightsim simulate, source" in (folder / "report.html").read_text()

    labels = json.loads((folder / "labels/front_camera/00.json").read_text())
    (mine,) = labels["actors"]
    assert mine["actor_id"] == "mine"
    assert mine["visibility"] == 1.0
    left, top, right, bottom = mine["visible_box"]
    shown = picture(work, "edited")[top:bottom, left:right].reshape(-1, 3).astype(float)
    red = (shown[:, 0] > 1.5 * shown[:, 2]).mean()
    assert red > 0.25

    twin = Workspace(work).twin
    scenario = json.loads((folder / "scenario.json").read_text())
    frame = scenario["frames"][0]
    assert frame["source"] == "composite"
    assert [actor["actor_id"] for actor in frame["actors"]] == ["mine"]
    removed = {actor["actor_id"] for actor in scenario["actors"] if actor["is_removed"]}
    assert removed == {track.actor_id for track in twin.log.actors}
    assert frame["actors"][0]["number"] == len(twin.log.actors)

    again = ["simulate", str(work), str(folder / "scenario.json"), "--name", "again", *ONE_FRAME]
    cli.main(again)
    assert (picture(work, "edited") == picture(work, "again")).all()
    request(tmp_path, "edited", edits[:1])
    with pytest.raises(SystemExit) as stopped:
        cli.main(words)
    assert stopped.value.code == 1


def test_another_ego_path_is_seen_through_the_pictures(
    built_street: BuiltStreet, tmp_path: Path
) -> None:
    work = built_street.work
    path = request(tmp_path, "beside", [{"do": "ego", "offset_m": [0.0, 0.0, 0.0]}])
    moved = request(tmp_path, "left", [{"do": "ego", "offset_m": [0.0, 1.0, 0.0]}])
    for each in (path, moved):
        cli.main(["simulate", str(work), str(each), "--labels", *ONE_FRAME])
    frame = json.loads((work / "scenarios/left/scenario.json").read_text())["frames"][0]
    assert frame["source"] == "rendered"
    log = Workspace(work).log
    recorded = log.frames_of("front_camera")[0]
    ego = log.ego.at(recorded.time_ns, 0.2)
    step_m = np.array(frame["world_from_camera"])[:3, 3] - recorded.world_from_camera.translation_m
    np.testing.assert_allclose(step_m, ego.rotation[:, 1], atol=1e-6)
    # From its own place the picture comes back; a metre beside it another one does.
    truth = recorded.load_srgb8().astype(float)
    errors = [np.abs(picture(work, n) - truth).mean() for n in ("beside", "left")]
    assert errors[0] < 1.5 < 5 < errors[1]
    name = f"labels/front_camera/{recorded.stem}.observed.png"
    observed = [read_grey8(work / "scenarios" / n / name) > 0 for n in ("beside", "left")]
    assert 1 >= observed[0].mean() > observed[1].mean() > 0.8


def test_an_impossible_street_is_told_and_with_strict_refused(
    built_street: BuiltStreet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of the two is an actor of a twin, as another log's would be."""
    work = built_street.work
    at, other = ahead_of_ego(work, 12.0), next(iter(Workspace(work).twin.assets.actors))
    assets = {"a": "van", "b": f"{work}#{other}"}
    twice = [{"do": "insert", "asset": assets[name], "id": name, "at": at} for name in assets]
    path = request(tmp_path, "twice", twice)
    with pytest.raises(SystemExit) as stopped:
        cli.main(["simulate", str(built_street.work), str(path), "--strict", *ONE_FRAME])
    assert stopped.value.code == 1
    reported = capsys.readouterr().err
    assert "'a' and 'b' overlap: frame 00" in reported
    assert not (built_street.work / "scenarios/twice").exists()


def test_what_can_be_edited_and_inserted_is_listed(
    built_street: BuiltStreet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work, library = built_street.work, str(tmp_path / "library")
    cli.main(["actors", str(work)])
    reported, twin = capsys.readouterr().out, Workspace(work).twin
    assert all(track.actor_id in reported for track in twin.log.actors)
    page = (work / "actors.html").read_text()
    assert all(track.actor_id in page for track in twin.log.actors)
    assert "data:image/jpeg" in page

    cli.main(["assets", "harvest", str(work), "--library", library, "--least-seen", "0"])
    cli.main(["assets", "list", "--library", library])
    reported = capsys.readouterr().out
    assert f"{len(twin.assets.actors)} actors" in reported
    assert "cone" in reported

    out = tmp_path / "stalled.json"
    cli.main(["scenario", "stalled", str(work), "--out", str(out), "--ahead-m", "15"])
    assert len(read_scenario_request(out).edits) == 4
    # What the frames would lack is told before a file is written.
    missing = tmp_path / "missing.json"
    with pytest.raises(SystemExit):
        cli.main(["scenario", "cut-in", str(work), "--out", str(missing), "--asset", "none.glb"])
    assert "none.glb" in capsys.readouterr().err
    assert not missing.exists()


def test_what_the_demo_proposes_to_try_works(
    built_street: BuiltStreet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a street of fewer frames, so that only the frame numbers differ."""
    # Other tests have scenarios of the same names there.
    others = shutil.ignore_patterns("scenarios")
    shutil.copytree(built_street.work, tmp_path / "street", ignore=others)
    steps = next_steps(tmp_path)
    assert [words.split()[0] for _, words in steps] == [
        "status", "actors", "relight", "scenario", "simulate",
    ]  # fmt: skip
    for _, words in steps:
        cli.main(shlex.split(words.replace("--frames 4:6", "--frames 2:3")))
        capsys.readouterr()
    assert {edit["do"] for edit in read_scenario_request(tmp_path / "cut.json").spelt} >= {"insert"}
    for name in ("noon", "cut"):
        folder = tmp_path / "street" / "scenarios" / name
        assert [p.stem for p in (folder / "frames" / "front_camera").glob("*.png")] == ["02"]
    notes = json.loads((tmp_path / "street/scenarios/cut/scenario.json").read_text())["notes"]
    assert not notes
