"""The code behind the published tables, on a world whose scores are known beforehand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import bench_reconstruction
from tests.render.rendering_scenes import plane, sun_sky
from tests.tiny_world import (
    AHEAD,
    GAIN,
    GROUND,
    LENS,
    STEMS,
    TinyWorkspace,
    driving_box,
    ground_points,
    on_ground,
    sees_surface,
    tiny_world,
    with_pictures,
)

from lightsim.build import measures
from lightsim.build.quality.frames import FramesConfig
from lightsim.build.quality.geometry import GeometryConfig
from lightsim.core.dome import Sun, add_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.core.twin import Panorama, SceneAssets
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.simulation.options import RelightOptions
from lightsim.store.images import write_exr, write_png
from lightsim_lab.metrics.base_colour import BaseColourReport, BaseColourRow
from lightsim_lab.studies import against_truth, twin_error
from lightsim_lab.studies.true_surfaces import TrueSurfaces

QUICK = FramesConfig(with_exposure=False)
SKY = sun_sky(np.radians(40.0), 35.0, 0.2)
SIZE = (LENS.height_px, LENS.width_px)


def decibels(codes: float) -> float:
    """PSNR of an error of so many codes in every channel."""
    return 20 * np.log10(255 / codes)


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """What `lightsim synthesize` writes beside a log: the tiny world's ground, twice as far as
    the camera sees, and its box."""
    folder = tmp_path / "truth"
    folder.mkdir()
    meshes = {"background": plane(60.0), "car": driving_box()[0].mesh}
    arrays = {
        f"{name}/{part}": getattr(mesh, part)
        for name, mesh in meshes.items()
        for part in ("vertices", "faces")
    }
    np.savez(folder / "scene.npz", allow_pickle=False, **arrays)
    return folder


def use(monkeypatch: pytest.MonkeyPatch, work: TinyWorkspace) -> None:
    monkeypatch.setattr(against_truth, "Workspace", lambda root: work)


def test_relit_frames_are_scored_on_true_surfaces_beside_what_a_copy_reaches(
    truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """One sky is relit perfectly, the other 10 codes too bright; the source is 20 codes off. What
    stands in the sky does not count."""
    source = tmp_path / "log"
    reading = LogReading(source=str(source), image_scale=1.0)
    work = tiny_world(SKY, AHEAD, reading=reading)
    asked: list[RelightOptions] = []
    for frame in work.log.frames[:2]:
        picture = rng.integers(60, 180, (*SIZE, 3)).astype(np.uint8)
        is_sky = ~sees_surface(frame)
        pictures = {
            truth / "relit" / "perfect": picture,
            truth / "relit" / "bright": picture,
            tmp_path / "truth-perfect" / "frames": picture,
            tmp_path / "truth-bright" / "frames": picture + np.uint8(10),
            source / "camera": picture + np.uint8(20),
        }
        for folder, shown in pictures.items():
            if folder.is_relative_to(truth):
                shown = np.where(is_sky[..., None], 255 - shown, shown)
            (folder / "above").mkdir(parents=True, exist_ok=True)
            write_png(folder / "above" / f"{frame.stem}.png", shown)

    def relight(root: Path, options: RelightOptions, progress: object) -> list[Path]:
        asked.append(options)
        return [tmp_path / f"truth-{name}" for name in options.sky_by_name]

    use(monkeypatch, work)
    monkeypatch.setattr(against_truth, "relight", relight)
    report = against_truth.relit_frames(Path("w"), truth, SilentProgress(), QUICK)
    skies = tuple(str(truth / "skies" / f"{name}.exr") for name in ("bright", "perfect"))
    assert [(o.sky, o.sky_scale, o.frames) for o in asked] == [(skies, "none", "0:2:1")]
    masked = {
        (condition, method): report.mean(condition, method, "masked")
        for condition in report.conditions
        for method in report.methods
    }
    assert masked["perfect", "LightSim"].psnr_db == np.inf
    assert masked["perfect", "LightSim"].ssim == pytest.approx(1.0)
    assert masked["bright", "LightSim"].psnr_db == pytest.approx(decibels(10), abs=1e-3)
    assert report.mean("perfect", "LightSim", "whole").psnr_db < 20
    for condition in report.conditions:
        assert masked[condition, "copy"].psnr_db == pytest.approx(decibels(20), abs=1e-3)
        assert masked[condition, "affine (oracle)"].psnr_db > 50
    assert {row.count for row in report.rows} == {2}
    with pytest.raises(InputError, match="relit ground truth"):
        against_truth.relit_frames(Path("w"), tmp_path, SilentProgress(), QUICK)


def test_the_mask_of_true_surfaces_is_the_closed_form(truth: Path) -> None:
    work = tiny_world(SKY, AHEAD)
    masks = TrueSurfaces(truth / "scene.npz", work)
    for frame in work.log.frames:
        found, wanted = masks.is_surface("above", frame.stem), sees_surface(frame)
        assert (found & wanted).sum() / (found | wanted).sum() > 0.999


def half_grounds(left: Any, right: Any) -> TriMesh:
    """The ground, of one colour where y > 0 and of another where y < 0."""
    halves = []
    for shift_m, colour in ((60.0, left), (-60.0, right)):
        mesh = plane(60.0, 1, colour)
        halves.append(replace(mesh, vertices=mesh.vertices + np.array([0, shift_m, 0], np.float32)))
    return concatenate_meshes(halves)


def write_true_buffers(truth: Path, work: TinyWorkspace, **other: np.ndarray) -> np.ndarray:
    """Of the ground in the middle frame; shadowed where y < 0. Returns the pixels that count."""
    frame = work.log.frames[1]
    points, ground = ground_points(frame), on_ground(frame)
    camera_z = frame.world_from_camera.rotation[:, 2]
    depth = (points - frame.world_from_camera.translation_m) @ camera_z
    buffers = {
        "depth_z_m": np.where(ground, depth, np.inf),
        "normal_world": np.broadcast_to([0.0, 0.0, 1.0], points.shape),
        "base_colour": np.broadcast_to(GROUND, points.shape),
        "sun_visibility": (points[..., 1] > 0).astype(float),
        "actor_index": np.where(ground, -1.0, 0.0),
    } | other
    for name, values in buffers.items():
        path = truth / name / "above" / f"{frame.stem}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, values.astype(np.float32))
    return ground


def row_of(report: BaseColourReport, method: str, region: str) -> BaseColourRow:
    return next(row for row in report.rows if (row.method, row.region) == (method, region))


def test_base_colour_scale_and_shadow_are_reported_as_they_are(truth: Path) -> None:
    work = tiny_world(SKY)
    ground = write_true_buffers(truth, work)
    meshes = {
        "perfect": plane(60.0, 1, GROUND),
        "1.3": plane(60.0, 1, 1.3 * GROUND),
        "shadow left": half_grounds(GROUND, 0.25 * GROUND),
    }
    report = against_truth.base_colours_of(meshes, work, truth, SilentProgress())
    for name, factor, ratio in (("perfect", 1.0, 1.0), ("1.3", 1.3, 1.0), ("shadow left", None, 4)):
        row = row_of(report, name, "ground")
        assert row.pixels == ground.sum()
        assert row.lit_shadow_ratio == pytest.approx(ratio, rel=1e-5)
        if factor is None:
            # Half of the ground at a quarter: RMS of +-ln 2 about the mean.
            assert row.si_log_rmse == pytest.approx(np.log(2), rel=0.02)
        else:
            assert row.factor == pytest.approx(factor, rel=1e-5)
            assert row.log_rmse == pytest.approx(np.log(factor), abs=1e-5)
            assert row.si_log_rmse == pytest.approx(0.0, abs=1e-5)


def test_base_colour_counts_only_where_the_twin_has_the_true_surface(truth: Path) -> None:
    work = tiny_world(SKY)
    ground = on_ground(work.log.frames[1])
    ground[:40] = False
    points = ground_points(work.log.frames[1])
    depth = np.where(np.arange(SIZE[0])[:, None] < 40, 30.0 + 1.0, 30.0 - points[..., 2])
    write_true_buffers(truth, work, depth_z_m=depth)
    meshes = {"perfect": plane(60.0, 1, GROUND)}
    report = against_truth.base_colours_of(meshes, work, truth, SilentProgress())
    assert row_of(report, "perfect", "all").pixels == ground.sum()
    with pytest.raises(InputError, match="no true base colour"):
        against_truth.base_colours_of(meshes, work, truth / "nowhere", SilentProgress())


def test_division_by_the_true_light_gives_the_true_base_colour(
    truth: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Open ground: what the cameras saw is base colour times (sine of elevation + sky)."""
    light = np.sin(np.radians(35.0)) + 0.2
    seen = plane(60.0, 60, GROUND * light)
    work = tiny_world(SKY, background=seen)
    without_box = SceneAssets(seen, {}, {"above": GAIN})
    log = replace(work.log, actors=())
    twin = replace(work.twin, assets=replace(without_box, background=plane(60.0, 1, GROUND)))
    work.__dict__.update(log=log, training_log=log, assets=without_box, twin=twin)
    write_true_buffers(truth, work)
    use(monkeypatch, work)
    report = against_truth.base_colour(Path("w"), truth, SilentProgress())
    assert row_of(report, "labels", "ground").factor == pytest.approx(1.0, rel=1e-5)
    assert row_of(report, "divide", "ground").factor == pytest.approx(1.0, rel=0.01)
    assert row_of(report, "radiance", "ground").factor == pytest.approx(light, rel=1e-4)


def test_a_tilted_ground_has_its_tilt_as_error_of_normals(
    truth: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tilt = np.radians(5.0)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    pose = RigidTransform.from_rotation("world", "world", turn, np.zeros(3))
    for mesh, wanted in ((plane(60.0), 0.0), (plane(60.0).transformed(pose), 5.0)):
        work = tiny_world(SKY, background=mesh)
        write_true_buffers(truth, work)
        monkeypatch.setattr(bench_reconstruction, "Workspace", lambda root, work=work: work)
        found = bench_reconstruction.normal_error_deg(Path("w"), truth)
        assert found == pytest.approx(wanted, abs=0.05)


def test_held_out_pictures_are_scored_by_the_twin_and_by_the_nearest_picture() -> None:
    """The twin's colour is that of the picture, then 1.3 times it; the pictures around are 20
    codes brighter. The ego vehicle and the sky do not count."""
    from lightsim.core.colour import srgb8_from_linear

    work = tiny_world(SKY, AHEAD)
    pictures = {}
    for frame in work.log.frames:
        picture = np.full((*SIZE, 3), 255, np.uint8)
        picture[on_ground(frame)] = srgb8_from_linear(GROUND * GAIN)
        is_box = sees_surface(frame) & ~on_ground(frame)
        picture[is_box] = srgb8_from_linear(np.float32(0.2) * GAIN)
        pictures[frame.stem] = picture
    spoilt = pictures["01"].copy()
    spoilt[-10:] = 0
    shown = {"00": spoilt + np.uint8(20), "01": spoilt, "02": spoilt + np.uint8(20)}
    ego_vehicle = np.zeros(SIZE, bool)
    ego_vehicle[-10:] = True
    with_pictures(work, shown)
    recorded = replace(work.log, ego_vehicle_masks={"above": ego_vehicle})
    work.__dict__.update(held_out=frozenset({"01"}), recorded_log=recorded)
    for factor in (1.0, 1.3):
        ground = plane(60.0, 1, np.float32(factor) * GROUND)
        work.__dict__["assets"] = replace(work.assets, background=ground)
        work.__dict__["twin"] = replace(work.twin, assets=work.assets)
        report = measures.held_out_frames(work, SilentProgress(), QUICK)
        twin, nearest = (
            report.mean("above", name, "masked").psnr_db for name in ("twin", "nearest image")
        )
        assert nearest == pytest.approx(decibels(20), abs=1e-3)
        if factor == 1.0:
            assert twin == np.inf
        else:
            codes = srgb8_from_linear(np.stack([GROUND * GAIN, factor * GROUND * GAIN]))
            off = np.diff(codes.astype(float), axis=0)
            assert twin == pytest.approx(decibels(np.sqrt((off**2).mean())), abs=0.3)
    work.__dict__["held_out"] = frozenset()
    with pytest.raises(InputError, match="--hold-out"):
        measures.held_out_frames(work, SilentProgress(), QUICK)


def sweep(stem: str, height_m: float, rng: np.random.Generator) -> LazySweep:
    """2000 returns of beams that fall straight down, `height_m` above the ground."""
    points = np.column_stack([rng.uniform(-20, 20, (2000, 2)), np.full(2000, height_m)])
    origins = points + np.array([0.0, 0.0, 10.0])
    zeros, whole = np.zeros(2000, np.float32), np.zeros(2000, np.int16)
    loaded = LidarSweep(
        stem, 0, points.astype(np.float32), origins.astype(np.float32), zeros, zeros, whole, whole
    )
    return LazySweep(stem, 0, lambda: loaded)


def test_geometry_is_measured_on_held_out_sweeps(truth: Path, rng: np.random.Generator) -> None:
    work = tiny_world(SKY)
    sweeps = tuple(sweep(stem, h, rng) for stem, h in zip(STEMS, (0.0, 0.04, 0.0), strict=True))
    log = replace(work.log, sweeps=sweeps, actors=())
    work.__dict__.update(log=log, held_out=frozenset({"01"}))
    config = GeometryConfig(samples=20_000, support_samples=20_000)
    report, is_held_out = twin_error.geometry(work, truth, SilentProgress(), config)
    assert is_held_out
    assert report.lidar.median_abs_m == pytest.approx(0.04, abs=1e-4)
    assert report.lidar.hit_rate == 1.0
    assert [row.f_score for row in report.surface] == [1.0, 1.0]
    work.__dict__["held_out"] = frozenset()
    report, is_held_out = twin_error.geometry(work, None, SilentProgress(), config)
    assert not is_held_out
    assert report.lidar.median_abs_m == pytest.approx(0.0, abs=1e-4)
    assert report.lidar.percentile_90_m == pytest.approx(0.04, abs=1e-4)


def test_the_source_sky_is_measured_against_the_true_files(truth: Path) -> None:
    """Sun twice too strong and three degrees too high; the sky is right."""
    true_sun = Sun(np.array([np.cos(0.6), 0.0, np.sin(0.6)]), np.full(3, 3.0, np.float32))
    level = np.full((128, 256, 3), 0.2, np.float32)
    (truth / "skies").mkdir()
    write_exr(truth / "skies" / "source.exr", add_sun(level, true_sun).radiance)
    beside = {
        "direction_world": true_sun.direction_world.tolist(),
        "irradiance": true_sun.irradiance.tolist(),
    }
    (truth / "skies" / "source.json").write_text(json.dumps(beside))
    high = 0.6 + np.radians(3.0)
    sun = Sun(np.array([np.cos(high), 0.0, np.sin(high)]), 2 * true_sun.irradiance)
    work = tiny_world(add_sun(level, sun))
    dark = np.zeros((64, 128), bool)
    black = np.zeros((64, 128, 3), np.float32)
    work.__dict__["panorama"] = Panorama(black, dark, dark, dark)
    report = twin_error.sky(work, truth)
    assert report.sun_error_truth_deg == pytest.approx(3.0, abs=0.01)
    assert report.sun_irradiance_error_ev == pytest.approx(1.0, abs=0.02)
    assert report.sky_irradiance_error_ev == pytest.approx(0.0, abs=0.02)
    assert (report.sun_error_ephemeris_deg, report.sun_error_observed_deg) == (None, None)
    perfect = twin_error.sky(tiny_world(add_sun(level, true_sun), panorama=work.panorama), truth)
    assert perfect.sun_error_truth_deg == pytest.approx(0.0, abs=1e-3)
    assert perfect.sun_irradiance_error_ev == pytest.approx(0.0, abs=1e-3)
    assert perfect.sphere_rmse == pytest.approx(0.0, abs=1e-3)
