"""Pictures against each other and by class, on a world whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import plane, sun_sky
from tests.tiny_world import (
    ABOVE,
    AHEAD,
    LENS,
    STEMS,
    TinyWorkspace,
    driving_box,
    in_shadow,
    on_ground,
    overlap,
    sees_surface,
    tiny_world,
)

from lightsim import cli
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.simulation.options import RelightOptions
from lightsim.store.images import write_exr, write_png
from lightsim_lab.metrics.options import MeasureOptions
from lightsim_lab.studies import against_truth, evaluation
from lightsim_lab.studies.picture_consistency import picture_consistency
from lightsim_lab.studies.true_surfaces import TrueSurfaces

SKY = sun_sky(np.radians(40.0), 35.0, 0.2)
SIZE = (LENS.height_px, LENS.width_px)


def write_frames(folder: Path, code_by_stem: Mapping[str, int]) -> Path:
    (folder / "above").mkdir(parents=True)
    for stem, code in code_by_stem.items():
        write_png(folder / "above" / f"{stem}.png", np.full((*SIZE, 3), code, np.uint8))
    return folder


def test_flicker_is_the_warp_error(tmp_path: Path) -> None:
    """Grey pictures that step by 10 codes, beside recorded ones that step by 5 and still ones."""
    folders = {
        name: write_frames(tmp_path / name, dict(zip(STEMS, codes, strict=True)))
        for name, codes in {
            "ours": (100, 110, 120),
            "still": (100, 100, 100),
            "recorded": (100, 105, 110),
        }.items()
    }
    rows = picture_consistency(tiny_world(SKY), "noon", folders, SilentProgress())
    found = {row.method: row for row in rows}
    assert {(row.pairs, row.count) for row in rows} == {("frames", 2)}
    assert found["still"].warp_error == pytest.approx(0.0, abs=1e-6)
    assert found["still"].delta_e == pytest.approx(0.0, abs=1e-4)
    # The gains of the camera, 1.1 to 0.9, are taken out: codes change by a few percent.
    assert found["ours"].warp_error == pytest.approx(10 / 255, rel=0.02)
    assert found["ours"].relative_warp_error == pytest.approx(2.0, rel=0.02)
    assert 2.0 < found["ours"].delta_e < 5.0


def test_motion_is_followed(tmp_path: Path) -> None:
    """A bright box that drives over dark ground does not flicker."""
    work = tiny_world(SKY)
    (tmp_path / "ours" / "above").mkdir(parents=True)
    for frame in work.log.frames:
        picture = np.where(on_ground(frame)[..., None], 60, 200).astype(np.uint8)
        path = tmp_path / "ours" / "above" / f"{frame.stem}.png"
        write_png(path, picture.repeat(3, axis=2))
    (row,) = picture_consistency(work, "noon", {"ours": tmp_path / "ours"}, SilentProgress())
    # What is left are edge pixels of the box, whose samples mix both.
    assert row.warp_error < 1.5 / 255
    assert np.isnan(row.relative_warp_error)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Ground and box as `lightsim synthesize` writes them."""
    meshes = {"background": plane(60.0), "car": driving_box()[0].mesh}
    arrays = {
        f"{name}/{part}": getattr(mesh, part)
        for name, mesh in meshes.items()
        for part in ("vertices", "faces")
    }
    np.savez(tmp_path / "scene.npz", allow_pickle=False, **arrays)
    return tmp_path / "scene.npz"


@pytest.mark.parametrize("view", [ABOVE, AHEAD])
def test_classes_are_the_closed_form(scene: Path, view: RigidTransform) -> None:
    work = tiny_world(SKY, view)
    overcast = SkyDome(SKY.radiance, None)
    true = TrueSurfaces(scene, work, {"noon": SKY, "overcast": overcast})
    frame = work.log.frames[1]
    found = true.classes("noon", "above", frame.stem)
    ground, surface = on_ground(frame), sees_surface(frame)
    assert overlap(found["ground"], ground) > 0.99
    assert overlap(found["vehicle"], surface & ~ground) > 0.9
    assert not (found["sky"] & surface).any()
    assert found["building, other"].sum() < 0.01 * surface.sum()
    assert SKY.sun is not None
    if view is ABOVE:
        shadow = in_shadow(frame, SKY.sun.direction_world) & ground
        assert overlap(found["shadowed"] & ground, shadow) > 0.9
        shadows = true.shadows("noon", "above", frame.stem)
        assert shadows is not None
        # Open ground: sky 0.2 beside the sun's sine of elevation.
        rest = np.median(shadows.rest[ground & ~shadow])
        assert rest == pytest.approx(0.2 / (0.2 + np.sin(np.radians(35.0))), rel=0.03)
    assert true.shadows("overcast", "above", frame.stem) is None
    assert {"lit", "shadowed"}.isdisjoint(true.classes("overcast", "above", frame.stem))


def test_folders_are_scored_with_masks_page_and_twin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """Predictions are right where the masks count; the source gives the baselines."""
    work: TinyWorkspace = tiny_world(SKY, reading=LogReading(source="", image_scale=1.0))
    monkeypatch.setattr(evaluation, "Workspace", lambda root: work)
    folders = {name: tmp_path / name for name in ("predicted", "truth", "source")}
    for folder in (*folders.values(), tmp_path / "masks"):
        (folder / "above").mkdir(parents=True)
    for stem in STEMS:
        truth = rng.integers(60, 180, (*SIZE, 3)).astype(np.uint8)
        predicted, mask = truth.copy(), np.full(SIZE, 255, np.uint8)
        predicted[:20], mask[:20] = 0, 0
        pictures = {"predicted": predicted, "truth": truth, "source": truth + np.uint8(20)}
        for name, shown in {**pictures, "masks": mask}.items():
            write_png(tmp_path / name / "above" / f"{stem}.png", shown)
    options = MeasureOptions(html=tmp_path / "page")
    report = evaluation.evaluate_folders(
        folders, tmp_path / "masks", Path("w"), options, SilentProgress()
    )
    assert report.frames.mean("frames", "predicted", "masked").psnr_db == np.inf
    assert report.frames.mean("frames", "predicted", "whole").psnr_db < 15
    assert "copy" in report.frames.methods
    assert {row.method for row in report.consistency} == {"predicted", "truth", "recorded"}
    page = (tmp_path / "page" / "index.html").read_text()
    assert "Agreement between pictures" in page
    assert page.count("data:image/jpeg") == 1
    for title, _, _ in report.tables():
        assert title in page
    (tmp_path / "masks" / "above" / "01.png").unlink()
    with pytest.raises(InputError, match="no mask"):
        evaluation.evaluate_folders(folders, tmp_path / "masks", None, options, SilentProgress())


def test_relit_frames_are_measured_in_every_way(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relit as the truth is; the source has no shadow, so its copy casts none."""
    work = tiny_world(SKY, reading=LogReading(source=str(tmp_path / "log"), image_scale=1.0))
    assert SKY.sun is not None
    truth, asked = scene.parent, []
    (truth / "skies").mkdir()
    beside = {name: getattr(SKY.sun, name).tolist() for name in ("direction_world", "irradiance")}
    for name in ("noon", "source"):
        write_exr(truth / "skies" / f"{name}.exr", SKY.radiance)
        (truth / "skies" / f"{name}.json").write_text(json.dumps(beside))
    folders = {
        "truth": truth / "relit" / "noon" / "above",
        "relit": tmp_path / "made" / "frames" / "above",
        "source": tmp_path / "log" / "camera" / "above",
    }
    rest = 0.2 / (0.2 + np.sin(np.radians(35.0)))
    for folder in folders.values():
        folder.mkdir(parents=True)
    for frame in work.log.frames:
        shadow = in_shadow(frame, SKY.sun.direction_world) & on_ground(frame)
        light = np.where(shadow, rest, 1.0)[..., None] * np.full(3, 0.4)
        shown = {name: srgb8_from_linear(light.astype(np.float32)) for name in folders}
        shown["source"] = np.full_like(shown["truth"], shown["truth"].max())
        for name, picture in shown.items():
            write_png(folders[name] / f"{frame.stem}.png", picture)

    def relight(root: Path, options: RelightOptions, progress: object) -> list[Path]:
        asked.append(options)
        return [tmp_path / "made"]

    monkeypatch.setattr(evaluation, "Workspace", lambda root, **options: work)
    monkeypatch.setattr(against_truth, "relight", relight)
    wanted = RelightOptions(name="judged", method="colour-transfer")
    (tmp_path / "scenarios").mkdir()
    given = tmp_path, truth, [wanted], MeasureOptions(), SilentProgress()
    report = evaluation.evaluate_relit(*given)
    assert [(o.name, o.method, o.sky_scale) for o in asked] == [
        ("judged", "colour-transfer", "none")
    ]
    assert report.frames.methods[0] == "colour-transfer"
    shadowed = report.frames.mean("noon", "copy", "shadowed").psnr_db
    assert shadowed < 20 < report.frames.mean("noon", "copy", "lit").psnr_db
    shadows = {row.method: row for row in report.shadows}
    assert shadows["colour-transfer"].iou > 0.99
    assert shadows["copy"].iou == 0.0
    left = {row.method: row.contrast for row in report.left_shadows}
    assert left["colour-transfer"] == pytest.approx(0, abs=0.01)
    assert left["copy"] == pytest.approx(1 - 1 / rest, rel=0.05)
    assert {row.method for row in report.consistency} == {"colour-transfer", "truth", "recorded"}
    assert "| noon | shadowed | copy |" in report.to_table()
    assert "| noon | shadowed | raw |" not in report.to_table()
    rows = json.loads(report.to_json())
    assert len(rows["shadows"]) == len(report.shadows)
    # What the frames took is known, and still is when they are scored again.
    assert report.costs.keys() == {"colour-transfer"}
    (tmp_path / "scenarios" / "judged").mkdir()
    assert evaluation.evaluate_relit(*given).costs == report.costs


def test_weights_belong_to_the_methods_that_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RelightOptions] = []
    monkeypatch.setattr(
        evaluation, "relit_with_cost", lambda work, truth, one, _: asked.append(one)
    )

    def relit(*words: str) -> list[tuple[str, str, str | None]]:
        asked.clear()
        cli.main(["evaluate", "relight", "w", "--truth", "t", "--no-scores", *words])
        return [(one.name, one.method, one.weights and str(one.weights)) for one in asked]

    assert relit() == [("truth", "network", None)]
    # A path may hold an equals sign.
    assert relit("--weights", "lr=1/w") == [("truth", "network", "lr=1/w")]
    both = relit("--method", "physical,epe", "--name", "n", "--weights", "epe=e")
    assert both == [("n-physical", "physical", None), ("n-epe", "epe", "e")]
    for words in (["--weights", "paper=p"], ["--method", "physical", "--weights", "f"]):
        with pytest.raises(SystemExit):
            relit(*words)
