"""The detector's experiment: its commands, its bookkeeping, and labels against exact buffers."""

from __future__ import annotations

import json
import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.lab.detect.conftest import PROJECTION
from tests.lab.studies.fake_commands import FakeBatch, after

from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.artefact import write_json
from lightsim.store.exr import read_exr
from lightsim.store.images import read_srgb8, write_png
from lightsim_lab.cli.evaluate_detector import DetectorTable
from lightsim_lab.detect import labels as label_module
from lightsim_lab.detect.labels import View, read_views
from lightsim_lab.studies import detector as module
from lightsim_lab.studies import detector_data as data_module
from lightsim_lab.studies.benchmark_options import HELD_OUT, STYLE_VALIDATION, TRAINING
from lightsim_lab.studies.detector import prepare_detector, run_detector
from lightsim_lab.studies.detector_options import (
    METHODS,
    ROWS,
    SIZES,
    TEST_LIGHTS,
    DetectorPrepareOptions,
    DetectorRunOptions,
    DetectorTableOptions,
)
from lightsim_lab.studies.detector_table import detector_table
from lightsim_lab.synthetic import shipped_street
from lightsim_lab.synthetic.reader import read_true_meshes, true_scenario

QUIET = SilentProgress()


def test_the_streets_are_no_streets_of_training_or_benchmark() -> None:
    cities = {str(n) for n in (*TRAINING, *HELD_OUT["validation"], *HELD_OUT["test"])}
    styled = {f"{style}-{n}" for style, seeds in STYLE_VALIDATION.items() for n in seeds}
    for protocol in SIZES.values():
        assert not protocol.train.keys() & protocol.test.keys()
        assert not protocol.streets.keys() & (cities | styled)
        assert not set(protocol.lights) & set(TEST_LIGHTS)
    full = SIZES["full"]
    assert (len(full.train), len(full.test), full.seeds) == (16, 10, 5)
    assert {style for style, _ in full.test.values()} == {style for style, _ in full.train.values()}
    assert set(METHODS) == {"colour-transfer", "self-osr", "epe", "paper", "physical", "network"}
    # All rows have equal optimiser steps, except for the paper's baseline of equal epochs.
    assert {name for name, row in ROWS.items() if row.steps != 1} == {"real-half-steps"}


def test_prepare_runs_documented_commands_and_labels_all_streets(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch, labelled = FakeBatch(rng), []
    monkeypatch.setattr("lightsim_lab.studies.study.run_batch", batch)
    monkeypatch.setattr(module, "check_installed", lambda: None)
    monkeypatch.setattr(data_module, "label_street", lambda path, *_: labelled.append(path.name))
    chosen = DetectorPrepareOptions(out=tmp_path, size="test", rows=("real", "physical", "network"))
    prepare_detector(chosen, QUIET)
    train, test = batch.of("synthesize")
    assert "--more-skies" in test
    assert "--more-skies" not in train
    assert [after(line, "--seed") for line in (train, test)] == ["801", "851"]
    # Test streets have no twin: nothing relights them.
    (built,) = batch.of("build")
    assert built[1] == str(tmp_path / "test" / "streets" / "801" / "log")
    relit = batch.of("relight")
    assert [after(line, "--method") for line in relit] == ["physical", "network"]
    assert after(relit[0], "--frames") == "3:4:1"
    assert [Path(word).stem for word in relit[0][relit[0].index("--sky") + 1 :]] == ["high_sun"]
    assert labelled == ["801", "851"]


def test_a_failed_step_of_prepare_names_its_output(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lightsim_lab.studies.study.run_batch", FakeBatch(rng, "/801/log"))
    monkeypatch.setattr(module, "check_installed", lambda: None)
    monkeypatch.setattr(data_module, "label_street", lambda *_: None)
    chosen = DetectorPrepareOptions(out=tmp_path, size="test", rows=("physical",))
    with pytest.raises(InputError, match=r"log.*step of the experiment failed, got it failed"):
        prepare_detector(chosen, QUIET)


@pytest.fixture
def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DetectorRunOptions:
    """The shipped street as training and as test street, with one labelled view of one frame and
    its true pictures; trainings have two steps."""
    monkeypatch.setattr("lightsim_lab.detect.trunk.PACKAGE", "no_such_package")
    short = replace(SIZES["test"], steps=2, seeds=2)
    monkeypatch.setattr("lightsim_lab.studies.detector_options.SIZES", {"test": short})
    options = DetectorRunOptions(out=tmp_path, size="test", device="cpu")
    box = np.array([[12.0, 1.0, -0.9, 4.4, 1.9, 1.4, 0.2]])
    view = View("front_camera/03", (480, 270), PROJECTION * 3, box, np.zeros((0, 7)))
    for name in short.streets:
        street = options.street(name)
        street.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(shipped_street(), street)
        for light in {*TEST_LIGHTS[1:], "high_sun"} - {"low_sun", "overcast"}:
            shutil.rmtree(street / "truth/relit" / light, ignore_errors=True)
            shutil.copytree(street / "truth/relit/overcast", street / "truth/relit" / light)
        options.labels(name).parent.mkdir(parents=True, exist_ok=True)
        write_json(options.labels(name), [view])
    frames = options.work("801") / "scenarios" / "detector-physical" / "frames" / "front_camera"
    frames.mkdir(parents=True)
    write_png(frames / "03.png", np.full((270, 480, 3), 90, np.uint8))
    return options


def test_runs_are_resumed_and_tabulated(
    prepared: DetectorRunOptions, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    chosen = replace(prepared, rows=("real-half-steps", "real", "colour-augmentation", "physical"))
    with caplog.at_level(logging.INFO):
        run_detector(replace(chosen, seeds=(0,)), QUIET)
    assert "The trunk has random weights" in caplog.text
    # 3.5 trainings of 2 steps, announced before the first of them.
    assert "4 trainings" in caplog.text
    assert "tests on 6 pictures" in caplog.text
    record = json.loads((prepared.run_folder("physical", 0) / "run.json").read_text())
    assert (record["steps"], record["trunk"]) == (2, "random")
    assert record["pictures"] == {"recorded": 1, "second": 1, "test": 6}
    half = json.loads((prepared.run_folder("real-half-steps", 0) / "run.json").read_text())
    assert half["steps"] == 1
    # Four random changes of each recorded picture.
    changed = prepared.run_folder("colour-augmentation", 0) / "run.json"
    assert json.loads(changed.read_text())["pictures"]["second"] == 4
    before = changed.stat().st_mtime_ns
    run_detector(chosen, QUIET)
    assert changed.stat().st_mtime_ns == before
    assert prepared.run_folder("real", 1).is_dir()
    table = detector_table(DetectorTableOptions(out=prepared.out, size="test"))
    assert [(row.name, row.seeds) for row in table.rows] == [(name, 2) for name in chosen.rows]
    chosen_rows = DetectorTableOptions(out=prepared.out, size="test", rows=("physical",))
    assert [row.name for row in detector_table(chosen_rows).rows] == ["real", "physical"]
    out = tmp_path / "table.json"
    DetectorTable(out=prepared.out, size="test", json=out).run()
    assert json.loads(out.read_text())["reference"] == "real"
    pictures = tmp_path / "pictures"
    DetectorTable(out=prepared.out, size="test", pictures=pictures, compared="physical").run()
    # One view of one street: both halves, at 720 pixels each.
    assert sorted(path.name for path in pictures.iterdir()) == ["gain-1.jpg", "loss-1.jpg"]
    assert read_srgb8(pictures / "gain-1.jpg").shape == (405, 1440, 3)
    with pytest.raises(InputError, match=r"runs: .*no finished training of a common seed.*epe"):
        DetectorTable(out=prepared.out, size="test", pictures=pictures, compared="epe").run()


def test_rows_without_pictures_are_left_out_or_an_error(prepared: DetectorRunOptions) -> None:
    experiment = module.Experiment.of(prepared, QUIET)
    has = {name for name in ROWS if experiment.has(ROWS[name])}
    assert has == {"real", "real-half-steps", "exposure-jitter", "colour-augmentation", "physical",
                   "path-traced"}  # fmt: skip
    with pytest.raises(
        InputError, match=r"detector-epe.*1 of 1 pictures \(epe\) of the log 801.*detector prepare"
    ):
        run_detector(replace(prepared, rows=("epe",)), QUIET)
    with pytest.raises(InputError, match="no finished training"):
        detector_table(DetectorTableOptions(out=prepared.out, size="test"))
    with pytest.raises(InputError, match="--rows"):
        DetectorRunOptions(out=prepared.out, rows=("reel",))
    prepared.labels("851").unlink()
    with pytest.raises(InputError, match=r"851\.json.*labels of the log 851 are missing"):
        run_detector(replace(prepared, rows=("real",)), QUIET)
    with pytest.raises(InputError, match="--seeds"):
        DetectorRunOptions(out=prepared.out, seeds=(-1,))
    with pytest.raises(InputError, match=r"no\.pth.*weights of the trunk are missing"):
        run_detector(replace(prepared, trunk=prepared.out / "no.pth"), QUIET)


def test_rows_differ_in_light_and_colour_only(prepared: DetectorRunOptions) -> None:
    # The street's frames 3 and 7 are recorded, and frame 3 is relit and has true pictures.
    for name in ("801", "851"):
        (view,) = read_views(prepared.labels(name))
        write_json(prepared.labels(name), [view, replace(view, name="front_camera/07")])
    experiment = module.Experiment.of(prepared, QUIET)
    recorded = experiment.recorded()
    assert [s.view.name for s in recorded] == ["front_camera/03", "front_camera/07"]
    for name, count in (("real", 1), ("colour-augmentation", 4), ("physical", 1)):
        second = experiment.second(ROWS[name], recorded)
        assert [s.view.name for s in second] == count * ["front_camera/03"]
    tested = experiment.tested()
    assert [(s.light, s.view.name) for s in tested] == [
        (light, "front_camera/03") for light in TEST_LIGHTS
    ]


def test_a_missing_light_is_an_error(prepared: DetectorRunOptions) -> None:
    shutil.rmtree(prepared.street("851") / "truth/relit/veiled_sun")
    with pytest.raises(InputError, match=r"veiled_sun.*1 of 5 pictures \(path-traced\)"):
        run_detector(replace(prepared, rows=("real",)), QUIET)


@pytest.fixture
def pandaset(tmp_path: Path) -> Path:
    """Return a folder with the shipped street, whose layout is PandaSet's, as two sequences: 001 is
    one of the paper's training, 084 one of its test."""
    folder = tmp_path / "pandaset"
    for name in ("001", "084"):
        shutil.copytree(shipped_street() / "log", folder / name)
    return folder


def test_pandaset_is_split_as_in_the_paper_and_relit_to_given_skies(
    pandaset: Path,
    tmp_path: Path,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    batch = FakeBatch(rng)
    monkeypatch.setattr("lightsim_lab.studies.study.run_batch", batch)
    monkeypatch.setattr("lightsim_lab.detect.trunk.PACKAGE", "no_such_package")
    short = replace(SIZES["test"], steps=2, every=4)
    monkeypatch.setattr("lightsim_lab.studies.detector_options.SIZES", {"test": short})
    out, rows, sky = tmp_path / "out", ("real", "physical"), tmp_path / "a.hdr"
    sky.touch()
    chosen = {"out": out, "size": "test", "pandaset": pandaset, "skies": ("sun:200,10", str(sky))}
    prepared = DetectorPrepareOptions(**chosen, rows=rows)
    prepare_detector(prepared, QUIET)
    assert "1 sequences train and 1 test; the paper has 68 and 35" in caplog.text
    assert batch.of("synthesize") == []
    (built,), (relit,) = batch.of("build"), batch.of("relight")
    assert built[1:] == (str(pandaset / "001"), "--work", str(prepared.work("001")))
    assert after(relit, "--frames") == "::4"
    assert relit[relit.index("--sky") + 1 :] == ("sun:200,10", str(sky))
    # Every fourth of ten frames.
    views = read_views(prepared.labels("084"))
    assert [view.name for view in views] == [f"front_camera/0{n}" for n in (0, 4, 8)]
    for light in ("sun_200_10", "a"):
        path = prepared.work("001") / "scenarios/detector-physical" / light / "frames"
        for view in views:
            write_png(path / f"{view.name}.png", np.full((135, 240, 3), 90, np.uint8))
    run_detector(DetectorRunOptions(**chosen, device="cpu"), QUIET)
    assert "Left out: path-traced" in caplog.text
    record = DetectorRunOptions(**chosen).run_folder("physical", 0) / "run.json"
    assert json.loads(record.read_text())["pictures"] == {"recorded": 3, "second": 6, "test": 3}
    table = detector_table(DetectorTableOptions(**chosen))
    assert {tuple(row.by_light) for row in table.rows} == {("recorded",)}
    assert "1 test logs; mAP under the recorded lights." in table.to_table()
    # Relit pictures, prepared inputs and trainings of other skies would be mixed.
    with pytest.raises(InputError, match=r"skies\.json.*other target skies.*another --out"):
        prepare_detector(replace(prepared, skies=("sun:200,30", str(sky))), QUIET)


def test_pandaset_needs_both_sides_and_skies(pandaset: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="need each other"):
        DetectorPrepareOptions(out=tmp_path, pandaset=pandaset)
    with pytest.raises(InputError, match="need each other"):
        DetectorPrepareOptions(out=tmp_path, skies=("source",))
    with pytest.raises(InputError, match=r"no true pictures.*path-traced"):
        DetectorRunOptions(
            out=tmp_path, pandaset=pandaset, skies=("source",), rows=("path-traced",)
        )
    # Found before the first build.
    for skies, message in (
        (("a/sky.hdr", "b/sky.hdr"), "two skies would be written to one folder"),
        (("source", str(tmp_path / "a.hdr")), "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            prepare_detector(
                DetectorPrepareOptions(out=tmp_path, pandaset=pandaset, skies=skies), QUIET
            )
    shutil.rmtree(pandaset / "084" / "camera" / "front_camera")
    with pytest.raises(InputError, match=r"sequences of the training and of the test.*got 001"):
        prepare_detector(
            DetectorPrepareOptions(out=tmp_path, pandaset=pandaset, skies=("source",)), QUIET
        )


def test_labels_of_a_recording_are_those_of_the_truth_where_returns_decide(
    tmp_path: Path,
) -> None:
    street = shipped_street()
    label_module.label_log(street / "log", "front_camera", 3, tmp_path / "a.json", QUIET)
    log = read_log(LogReading(source=str(street / "log"), image_scale=1.0))
    meshes = read_true_meshes(street / "truth" / "scene.npz")
    scenario = true_scenario(meshes, log.actors)
    static = make_embree_caster([meshes["background"]])
    counted = 0
    for view in read_views(tmp_path / "a.json"):
        name, stem = view.name.split("/")
        frame = next(f for f in log.frames if (f.camera_name, f.stem) == (name, stem))
        true = label_module._view(scenario, static, frame, log.cameras[name])
        assert view.projection == pytest.approx(true.projection)
        # Each counted vehicle is one that the truth knows: seen, or hidden in part.
        known = np.concatenate([true.boxes, true.ignored])
        for box in view.boxes:
            assert np.abs(known[:, :3] - box[:3]).sum(axis=1).min() < 0.3
        found = [np.abs(view.boxes[:, :3] - box[:3]).sum(axis=1).min() < 0.3 for box in true.boxes]
        counted += sum(found)
    assert counted >= 6


def test_labels_are_those_of_the_exact_buffers(tmp_path: Path) -> None:
    street, camera_name = shipped_street(), "front_camera"
    log = read_log(LogReading(source=str(street / "log"), cameras=(camera_name,), image_scale=1.0))
    meshes = read_true_meshes(street / "truth" / "scene.npz")
    scenario = true_scenario(meshes, log.actors)
    static = make_embree_caster([meshes["background"]])
    frame = next(f for f in log.frames if f.stem == "03")
    camera = log.cameras[camera_name]
    index = label_module._actor_index(scenario, static, frame, camera)
    exact = read_exr(street / "truth" / "actor_index" / camera_name / "03.exr")
    exact = np.round(exact.reshape(index.shape)).astype(int)
    # The truth numbers actors in its own order: both have the same number of actors' pixels.
    assert ((index >= 0) == (exact >= 0)).mean() > 0.998
    view = label_module._view(scenario, static, frame, camera)
    path = tmp_path / "labels.json"
    write_json(path, [view])
    (read,) = read_views(path)
    assert read.boxes == pytest.approx(view.boxes)
    assert len(view.boxes) >= 3
    for box in view.boxes:
        u, v, w = view.projection @ [*box[:3], 1.0]
        row, column = int(v / w), int(u / w)
        if 0 <= row < 270 and 0 <= column < 480:
            assert (index[max(row - 6, 0) : row + 6, max(column - 6, 0) : column + 6] >= 0).any()
    assert read_srgb8(street / "log/camera" / f"{view.name}.jpg").shape[:2] == view.size_px[::-1]


@pytest.mark.skipif(
    "LIGHTSIM_REHEARSE" not in os.environ, reason="takes 20 minutes; set LIGHTSIM_REHEARSE=1"
)
@pytest.mark.slow
def test_the_experiment_runs_end_to_end(tmp_path: Path) -> None:
    rows = ("real", "colour-augmentation", "physical", "network", "path-traced")
    prepare_detector(DetectorPrepareOptions(out=tmp_path, size="test", rows=rows), QUIET)
    run_detector(DetectorRunOptions(out=tmp_path, size="test", rows=rows), QUIET)
    table = detector_table(DetectorTableOptions(out=tmp_path, size="test"))
    assert [row.name for row in table.rows] == list(rows)
    for row in rows:
        folder = DetectorRunOptions(out=tmp_path, size="test").run_folder(row, 0)
        lines = [json.loads(x) for x in (folder / "metrics.jsonl").read_text().splitlines()]
        assert lines[-1]["loss"] < 0.6 * lines[0]["loss"]
