"""The whole way on a small part of the shipped street: build, interrupt, resume, relight."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import av
import numpy as np
import pytest
from scipy.spatial import KDTree

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.status import status
from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.mesh import Provenance
from lightsim.core.reading import LogReading
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import ArtefactError, InputError, MissingDependencyError
from lightsim.progress import SilentProgress
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.options import RendererChoice
from lightsim.render.renderers import TracedFrame
from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.buffers import render
from lightsim.simulation.options import RelightOptions, RenderOptions
from lightsim.simulation.relight import relight
from lightsim.simulation.skies import made_from_sky
from lightsim.store.images import read_exr, read_srgb8, read_srgb8_alpha, write_exr
from lightsim_lab.studies.true_surfaces import TrueSurfaces
from lightsim_lab.synthetic import shipped_street

T = TypeVar("T")
CAMERAS = ("front_camera", "left_camera")


def options() -> BuildOptions:
    """Those of the built street."""
    reading = LogReading(
        source=str((shipped_street() / "log").resolve()),
        cameras=CAMERAS,
        frames="0:4",
        hold_out=3,
        image_scale=0.25,
    )
    return BuildOptions(reading=reading, preset="standard", neural_steps=20)


@pytest.fixture
def work(built_street: Any) -> Path:
    return built_street.work


@pytest.mark.slow
def test_a_build_decodes_each_sweep_once(built_street: Any) -> None:
    sweeps = Workspace(built_street.work).log.sweeps
    assert built_street.decoded == {sweep.stem: 1 for sweep in sweeps}


class Interrupting(SilentProgress):
    """Raises KeyboardInterrupt at the n-th step of all tracked loops."""

    def __init__(self, after: int) -> None:
        self.left = after

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        for item in items:
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt
            yield item


def contents(folder: Path) -> dict[str, bytes]:
    """All files but those that hold times."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name not in ("artefact.json", "metrics.jsonl")
    }


@pytest.mark.slow
def test_an_interrupted_build_gives_the_same_mattes_and_fields(work: Path, tmp_path: Path) -> None:
    """Interrupted among the mattes, the rays and the training steps; stages that write their files
    at once are taken from the other build."""
    for stage in ("log", "alignment", "fields"):
        shutil.copytree(work / stage, tmp_path / stage)
    for after in (3, 8, 12, 25):
        try:
            build(tmp_path, options(), Interrupting(after), until="neural")
        except KeyboardInterrupt:
            continue
    build(tmp_path, options(), SilentProgress(), until="neural")
    for stage in ("masks", "held_out_masks", "neural"):
        assert contents(tmp_path / stage) == contents(work / stage), stage
    assert [p.name for p in tmp_path.glob(".*")] == [".lock"]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A copy of the street's log that a test may change."""
    folder = tmp_path / "recording"
    shutil.copytree(shipped_street() / "log", folder)
    return folder


def options_of(recording: Path, **changes: object) -> BuildOptions:
    reading = replace(options().reading, source=str(recording), **changes)
    return replace(options(), reading=reading)


def made_at(work: Path, stage: str) -> int:
    return (work / stage / "artefact.json").stat().st_mtime_ns


def test_a_work_folder_in_the_recording_is_refused(recording: Path) -> None:
    for work in (recording, recording / "work", recording / "lidar" / ".." / "w"):
        with pytest.raises(InputError, match="--work"):
            build(work, options_of(recording), SilentProgress(), until="log")
    assert sorted(p.name for p in recording.iterdir()) == sorted(
        p.name for p in (shipped_street() / "log").iterdir()
    )


def test_a_folder_of_no_known_layout_is_refused_before_it_is_read(tmp_path: Path) -> None:
    source = tmp_path / "disk"
    source.mkdir()
    (source / "huge").symlink_to("/dev/zero")
    os.mkfifo(source / "pipe")
    with pytest.raises(InputError, match="layout of a supported data set"):
        build(tmp_path / "work", options_of(source), SilentProgress(), until="log")
    assert not (tmp_path / "work").exists()


def test_a_second_build_is_refused_while_one_is_at_work(recording: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    code = (
        "import sys, time; from pathlib import Path; from lightsim.store.lock import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    words = [sys.executable, "-c", code, str(work / ".lock")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        with pytest.raises(ArtefactError, match=f"process {first.pid}"):
            build(work, options_of(recording), SilentProgress(), until="log")
        first.kill()
    build(work, options_of(recording), SilentProgress(), until="log")


def test_a_renamed_recording_is_not_built_anew_and_a_changed_one_is(
    recording: Path, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    build(work, options_of(recording), SilentProgress(), until="log")
    before = made_at(work, "log")
    moved = tmp_path / "moved" / "elsewhere"
    moved.parent.mkdir()
    recording.rename(moved)
    with pytest.raises(InputError, match="Move it back"):
        _ = Workspace(work).recorded_log
    build(work, options_of(moved), SilentProgress(), until="log")
    assert made_at(work, "log") == before
    assert Workspace(work).recorded_log.frames

    picture = next((moved / "camera" / "front_camera").glob("*.jpg"))
    shutil.copy(sorted(picture.parent.glob("*.jpg"))[-1], picture)
    with pytest.raises(ArtefactError, match=f"{picture.name} was changed.*--allow-stale"):
        _ = Workspace(work).recorded_log
    assert Workspace(work, is_stale_allowed=True).recorded_log.frames
    assert {line.name: line.state for line in status(work)}["log"] == "stale"
    build(work, options_of(moved), SilentProgress(), until="log")
    assert made_at(work, "log") != before
    assert Workspace(work).recorded_log.frames


def test_a_calibration_beside_the_recordings_is_part_of_them(
    recording: Path, tmp_path: Path
) -> None:
    calibration = recording / "static_extrinsic_calibration.yaml"
    beside = calibration.rename(recording.parent / calibration.name)
    work = tmp_path / "work"
    build(work, options_of(recording), SilentProgress(), until="log")
    beside.write_text(beside.read_text() + "\n# another rig\n")
    with pytest.raises(ArtefactError, match=r"\.\./static_extrinsic_calibration\.yaml was changed"):
        _ = Workspace(work).recorded_log


def test_a_build_stops_where_told_also_when_that_stage_is_there(tmp_path: Path) -> None:
    for _ in range(2):
        build(tmp_path, options(), SilentProgress(), until="log")
    assert [path.parent.name for path in tmp_path.glob("*/artefact.json")] == ["log"]


@pytest.mark.slow
def test_a_second_build_makes_nothing_and_status_knows(work: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in work.glob("*/artefact.json")}
    build(work, options(), SilentProgress())
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert {line.state for line in status(work)} == {"made"}
    write_options = (work / "build.json").read_text()
    (work / "build.json").write_text(write_options.replace('"seed": 0', '"seed": 1'))
    assert {line.state for line in status(work)} == {"stale"}
    (work / "build.json").write_text(write_options)


@pytest.mark.slow
def test_faces_know_where_they_come_from(work: Path) -> None:
    """Measured faces lie where returns are, guessed ones mostly do not; every stage keeps them."""
    workspace = Workspace(work)
    meshes, log = workspace.meshes, workspace.training_log
    background = meshes.background
    returns = np.concatenate([lazy.load().points_world for lazy in log.sweeps])
    centres = background.vertices[background.faces].mean(axis=1)
    distance_m = KDTree(returns).query(centres)[0]
    measured = background.has_provenance(Provenance.MEASURED)
    proxy = background.has_provenance(Provenance.BACKGROUND_PROXY)
    assert np.percentile(distance_m[measured], 95) < 0.5
    assert np.median(distance_m[measured]) < 0.15
    assert np.median(distance_m[background.has_provenance(Provenance.INFERRED)]) > 0.3
    assert np.median(distance_m[proxy]) > 20.0
    assert background.has_provenance(Provenance.INTERPOLATED).any()
    assert workspace.inferred.has_provenance(Provenance.INFERRED).all()
    street, unseen = workspace.twin.assets.background, workspace.unobserved_occluders
    nearest = KDTree(street.vertices).query(unseen.vertices)[1]
    # No light is taken out of what no camera saw: the file rounds, no more.
    assert np.allclose(unseen.base_colour, street.base_colour[nearest], atol=0.01)
    vehicles = [a.mesh for a in meshes.actors.values() if a.kind.is_vehicle]
    assert any(
        mesh.has_provenance(Provenance.MIRRORED).any()
        and mesh.has_provenance(Provenance.MEASURED).any()
        for mesh in vehicles
    )
    persons = [a.mesh for a in meshes.actors.values() if a.kind.is_person]
    assert persons
    assert not any(mesh.has_provenance(Provenance.MIRRORED).any() for mesh in persons)
    for assets in (workspace.assets, workspace.twin.assets):
        pairs = [(assets.background, background)]
        pairs += [(assets.actors[a].mesh, actor.mesh) for a, actor in meshes.actors.items()]
        for later, first in pairs:
            areas = []
            for mesh in (later, first):
                assert mesh.face_provenance is not None
                areas.append(
                    np.bincount(mesh.face_provenance, mesh.face_areas_m2(), len(Provenance))
                )
            np.testing.assert_allclose(*areas, rtol=1e-4)


@pytest.mark.slow
def test_an_actor_has_one_number_everywhere(work: Path, tmp_path: Path) -> None:
    workspace = Workspace(work)
    number_by_actor = workspace.log.number_by_actor
    assert workspace.training_log.number_by_actor == number_by_actor
    assert workspace.twin.log.number_by_actor == number_by_actor
    assert workspace.scene_field.actor_ids == tuple(number_by_actor)
    render(work, tmp_path, RenderOptions(what=("actor",), frames="0:1"), SilentProgress())
    table = json.loads((tmp_path / "scenario.json").read_text())["actors"]
    assert {row["actor_id"]: row["number"] for row in table} == number_by_actor
    truth = shipped_street() / "truth"
    true_ids = json.loads((truth / "truth.json").read_text())["actors"]
    surfaces = TrueSurfaces(truth / "scene.npz", workspace)
    assert surfaces.scenario.number_by_actor == number_by_actor
    assert set(true_ids) == set(number_by_actor)


@pytest.mark.slow
def test_the_completed_panorama_lies_beside_the_stitched_one(work: Path) -> None:
    stitched, alpha = read_srgb8_alpha(work / "sky" / "panorama.png")
    completed, whole = read_srgb8_alpha(work / "sky" / "panorama_completed.png")
    assert completed.shape == stitched.shape
    assert (whole == 255).all()
    assert (alpha == 0).any()
    assert (completed[alpha == 0].max(axis=1) > 0).mean() > 0.9


@pytest.mark.slow
def test_sun_comes_from_gps_and_time(work: Path) -> None:
    sun = json.loads((work / "sky" / "sun.json").read_text())
    truth = json.loads((shipped_street() / "truth" / "skies" / "source.json").read_text())
    assert sun["origin"] == "gps+time"
    assert sun["azimuth_deg"] == pytest.approx(truth["azimuth_deg"], abs=0.5)
    assert sun["elevation_deg"] == pytest.approx(truth["elevation_deg"], abs=0.5)


@pytest.mark.slow
def test_relight_writes_what_the_interface_promises(work: Path) -> None:
    chosen = RelightOptions(name="noon", sky=("sun:180,60",), frames="0:2", linear=True)
    (folder,) = relight(work, chosen, SilentProgress())
    assert folder == work / "scenarios" / "noon"
    log = Workspace(work).log
    for camera in CAMERAS:
        stems = [p.stem for p in sorted((folder / "frames" / camera).iterdir())]
        assert stems == [f.stem for f in log.frames_of(camera)[:2]]
        image = read_srgb8(folder / "frames" / camera / f"{stems[0]}.png")
        linear = read_exr(folder / "linear" / camera / f"{stems[0]}.exr")
        assert image.shape == linear.shape == (68, 120, 3)
        assert np.isfinite(linear).all()
        with av.open(str(folder / "video" / f"{camera}.mp4")) as video:
            assert len(list(video.decode(video=0))) == 2
    scenario = json.loads((folder / "scenario.json").read_text())
    assert [frame["source"] for frame in scenario["frames"]] == ["recorded"] * 4
    assert read_scenario_request(folder / "scenario.json").sky == SkyChoice("sun:180,60")
    assert scenario["frames"][0]["actors"]
    before = contents(folder)
    assert relight(work, chosen, SilentProgress()) == [folder]
    for other in (replace(chosen, sky=("sun:90,30",)), replace(chosen, exposure_ev=1.0)):
        with pytest.raises(InputError, match=r"noon.*other settings.*--overwrite"):
            relight(work, other, SilentProgress())
    assert contents(folder) == before
    brighter = replace(chosen, exposure_ev=1.0, frames="0:1", overwrite=True)
    relight(work, brighter, SilentProgress())
    assert len(list((folder / "frames").rglob("*.png"))) == 2
    (folder / "artefact.json").write_text("{")
    relight(work, replace(brighter, overwrite=False), SilentProgress())
    assert (folder.parent / "noon.broken-1" / "frames").is_dir()
    assert len(list((folder / "frames").rglob("*.png"))) == 2


@pytest.mark.slow
def test_a_damaged_twin_is_not_read_and_is_made_anew(work: Path) -> None:
    paths = [work / "twin" / name for name in ("background.glb", "twin.json")]
    whole = [path.read_bytes() for path in paths]
    for path, content in zip(paths, whole, strict=True):
        path.write_bytes(content[:1000] + bytes([content[1000] ^ 1]) + content[1001:])
        with pytest.raises(ArtefactError, match=rf"{path.name} has other content.*lightsim build"):
            relight(work, RelightOptions(name="x"), SilentProgress())
        states = {line.name: line.state for line in status(work, is_hashed=True)}
        assert [stage for stage, state in states.items() if state != "made"] == ["twin"]
        path.unlink()
        assert {line.name: line.state for line in status(work)}["twin"] == "broken"
        path.write_bytes(content)
        assert {line.state for line in status(work, is_hashed=True)} == {"made"}
    for path in paths:
        path.unlink()
    build(work, options(), SilentProgress())
    assert [path.read_bytes() for path in paths] == whole


@pytest.mark.slow
def test_several_skies_are_traced_once_and_come_out_as_one_by_one(
    work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    traced: list[str] = []
    trace = FrameRenderer.trace

    def counting(
        self: FrameRenderer, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera
    ) -> TracedFrame:
        traced.append(frame.stem)
        return trace(self, scenario, frame, camera)

    monkeypatch.setattr(FrameRenderer, "trace", counting)
    skies = ("sun:180,60", "sun:90,20")
    # Scaling traces small pictures of its own (tests/simulation/test_seen_light.py).
    both = RelightOptions(
        name="day", sky=skies, sky_scale="none", cameras=("left_camera",), frames="0:1"
    )
    folders = relight(work, both, SilentProgress())
    assert folders == [work / "scenarios" / "day" / sky for sky in ("sun_180_60", "sun_90_20")]
    assert len(traced) == 1
    singly = [replace(both, name=f"alone-{n}", sky=(sky,)) for n, sky in enumerate(both.sky)]
    alone = [relight(work, one, SilentProgress())[0] for one in singly]
    assert len(traced) == 3
    pictures = [next((f / "frames").rglob("*.png")).read_bytes() for f in (*folders, *alone)]
    assert pictures[:2] == pictures[2:]
    assert pictures[0] != pictures[1]
    for other in (replace(both, sky=("source",)), replace(both, name="alone-0")):
        with pytest.raises(InputError, match="--overwrite"):
            relight(work, other, SilentProgress())
        made = relight(work, replace(other, overwrite=True), SilentProgress())
        assert all((folder / "artefact.json").is_file() for folder in made)
    assert not (work / "scenarios" / "alone-0" / "frames").exists()
    assert not (work / "scenarios" / "day" / "sun_90_20").exists()
    with pytest.raises(InputError, match="one folder"):
        replace(both, sky=("sun:180,60", "sun:180, 60"))


@pytest.mark.slow
def test_relighting_with_the_source_sky_returns_the_image(work: Path) -> None:
    chosen = RelightOptions(name="same", cameras=("left_camera",), frames="0:1")
    (folder,) = relight(work, chosen, SilentProgress())
    workspace = Workspace(work)
    frame = workspace.log.frames_of("left_camera")[0]
    source = frame.load_srgb8()
    relit = read_srgb8(folder / "frames" / "left_camera" / f"{frame.stem}.png")
    inside = (workspace.sky_matte(frame) == 0) & (source < 250).all(-1)
    difference = np.abs(relit.astype(int) - source.astype(int))[inside]
    assert np.percentile(difference, 99) <= 2


@pytest.mark.slow
def test_buffers_are_written_as_exr(work: Path, tmp_path: Path) -> None:
    what = ("depth", "normal", "albedo", "shadow", "ao")
    chosen = RenderOptions(what=what, cameras=("front_camera",), frames="0:1")
    render(work, tmp_path, chosen, SilentProgress())
    stem = Workspace(work).log.stems[0]
    depth = read_exr(tmp_path / "depth" / "front_camera" / f"{stem}.exr")
    normal = read_exr(tmp_path / "normal" / "front_camera" / f"{stem}.exr")
    shadow = read_exr(tmp_path / "shadow" / "front_camera" / f"{stem}.exr")
    assert (depth > 0).all()
    length = np.linalg.norm(normal, axis=-1)
    np.testing.assert_allclose(length[np.isfinite(depth)], 1.0, atol=1e-4)
    assert shadow.min() >= 0
    assert shadow.max() <= 1
    frames = json.loads((tmp_path / "scenario.json").read_text())["frames"]
    assert [(frame["frame"], frame["source"]) for frame in frames] == [(stem, "rendered")]
    assert json.loads((tmp_path / "sky.json").read_text())["facts"]["scale_factor"] == 1.0
    assert render(work, tmp_path, chosen, SilentProgress()).rendered == 0
    for other in (replace(chosen, seed=1), replace(chosen, sky=("sun:10,20",))):
        with pytest.raises(InputError, match="other settings"):
            render(work, tmp_path, other, SilentProgress())
    foreign = tmp_path / "depth" / "front_camera" / f"{stem}.exr"
    ours = foreign.read_bytes()
    write_exr(foreign, depth)
    with pytest.raises(InputError, match=f"{stem}.exr: a file that this run did not make"):
        render(work, tmp_path, chosen, SilentProgress())
    foreign.write_bytes(ours)
    no_blender = RendererChoice(renderer="cycles", blender_python=tmp_path / "nowhere")
    empty = tmp_path / "empty"
    with pytest.raises(MissingDependencyError, match="nowhere"):
        render(work, empty, replace(chosen, renderer=no_blender), SilentProgress())
    assert not empty.exists()


def test_wrong_words_are_named(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="lightsim build"):
        status(tmp_path)
    with pytest.raises(InputError, match="shiny"):
        RenderOptions(what=("depth", "shiny"))
    with pytest.raises(InputError, match=r"no such file.*sun:AZIMUTH"):
        made_from_sky(SkyChoice("no_such_file.hdr"))
    broken = replace(options().reading, source=str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no such folder"):
        build(tmp_path / "work", BuildOptions(reading=broken), SilentProgress())
