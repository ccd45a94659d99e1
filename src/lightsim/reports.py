"""What stands in the reports of a build, a relight and the demo; the looks are view's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim import evaluation
from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.resample import resize_area
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.edit.timeline import replay
from lightsim.evaluate.frames import FramesConfig, FramesReport
from lightsim.evaluate.geometry import GeometryReport
from lightsim.progress import SilentProgress
from lightsim.render.transport import TransportConfig
from lightsim.scenarios import Relighter
from lightsim.scene_setup import FrameRenderer
from lightsim.skies import TargetSky
from lightsim.store.artefact import read_json, read_record
from lightsim.store.images import read_srgb8
from lightsim.view.figures import (
    depth_colours,
    dome_preview,
    normal_colours,
    ratio_grey,
    strip,
    tone_mapped,
)
from lightsim.view.report import Card, Figure, Section, Table, Video, write_report
from lightsim.workspace import Workspace

QUICK = FramesConfig(with_lpips=False, with_exposure=False)
"""Scores that a report can afford: raw PSNR and SSIM."""
_PICTURE_WIDTH = 640
STAGE_NAMES = (
    "log",
    "masks",
    "alignment",
    "fields",
    "geometry",
    "assets",
    "panorama",
    "sky",
    "twin",
)
Image = UInt8[np.ndarray, "h w 3"]


def write_build_report(path: Path, work: Workspace) -> None:
    """report/index.html of a build: sky, meshes, held-out numbers, timings."""
    measured, is_held_out = evaluation.geometry(work.root, None, SilentProgress())
    frames = None
    if work.held_out:
        frames = evaluation.held_out_frames(work.root, SilentProgress(), QUICK)
    log = work.log
    cards = [
        Card("frames", str(len(log.frames)), f"{len(log.cameras)} cameras"),
        Card("sweeps", str(len(log.sweeps)), f"{len(log.actors)} actors"),
        _sun_card(work),
        Card(
            "LiDAR error",
            f"{100 * measured.lidar.median_abs_m:.1f} cm",
            "median, " + ("held-out sweeps" if is_held_out else "sweeps of the build itself"),
        ),
    ]
    if frames is not None:
        score = np.mean([r.scores.psnr_db for r in frames.rows if _is_twin(r)])
        cards.append(Card("held-out PSNR", f"{score:.1f} dB", "without sky and own car"))
    sections = [
        _sky_section(work),
        _scene_section(work),
        _number_section(measured, frames),
        _stage_section(work),
    ]
    write_report(path, f"Twin of {log.name}", sections, subtitle="lightsim build", cards=cards)


def write_relight_report(
    path: Path, folder: Path, scenario: Scenario, relighter: Relighter, target: TargetSky
) -> None:
    """report.html of a relight: the sky, one strip a camera, the films."""
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    figures = []
    for name in cameras:
        frames = [f for f in scenario.frames if f.camera_name == name]
        result = relighter.relit(frames[len(frames) // 2], scenario)
        caption = (
            f"{name}, frame {result.frame.stem}: recorded | relit | shadow ratio source | target"
        )
        parts = [
            result.source_srgb8,
            result.image_srgb8,
            ratio_grey(result.source.ratio),
            ratio_grey(result.target.ratio),
        ]
        figures.append(Figure(caption, strip([_small(p, 480) for p in parts]), is_wide=True))
    facts = [[key, _text(value)] for key, value in target.facts.items()]
    sky = Section(
        "Target sky",
        "Azimuths are clockwise from true north. Radiance is in scene units: 1.0 is what the "
        "source camera maps to a pixel value of 1.0.",
        tables=[Table(["fact", "value"], facts)],
        figures=[Figure("target sky, centre column along world +x", dome_preview(target.dome))],
    )
    videos = [Video(name, f"video/{name}.mp4") for name in cameras]
    sections = [Section("Cameras", figures=figures), sky, Section("Video", videos=videos)]
    write_report(path, scenario.name, sections, subtitle=f"lightsim relight, {target.facts['sky']}")


def write_demo_report(path: Path, work: Path, names: Sequence[str], relit: FramesReport) -> Path:
    """index.html of the demo: links, films, and relit frames against ground truth."""
    films = []
    for name in names:
        base = f"{work.name}/scenarios/{name}/video"
        films += [Video(f"{name}: {c}", f"{base}/{c}.mp4") for c in ("front_camera", "left_camera")]
    pictures = []
    log = Workspace(work).log
    for name in names:
        folder = work / "scenarios" / name / "frames"
        for camera in ("front_camera", "left_camera"):
            stem = sorted((folder / camera).glob("*.png"))[0].stem
            frame = next(f for f in log.frames_of(camera) if f.stem == stem)
            pair = [frame.load_srgb8(), read_srgb8(folder / camera / f"{stem}.png")]
            caption = f"{camera}: recorded | {name}"
            pictures.append(Figure(caption, strip([_small(p) for p in pair]), is_wide=True))
    text = (
        "The street is synthetic, path-traced with glossy paint and glass, sensor noise and JPEG; "
        "the method sees only its log. Scores are raw, outside the sky, against ground truth "
        "rendered under each target sky."
    )
    sections = [
        Section("Relit frames", text, figures=pictures),
        Section("Against ground truth", tables=[_relit_table(relit)]),
        Section("Films", videos=films),
        Section(
            "More",
            f"Build report: {work.name}/report/index.html. Relight reports: "
            + ", ".join(f"{work.name}/scenarios/{n}/report.html" for n in names),
        ),
    ]
    write_report(path, "LightSim demo", sections, subtitle="the shipped synthetic street")
    return path


def _relit_table(report: FramesReport) -> Table:
    rows = []
    for condition in report.conditions:
        for method in report.methods:
            s = report.mean(condition, method, "masked")
            rows.append([condition, method, round(s.psnr_db, 2), round(s.ssim, 3)])
    return Table(["target sky", "method", "PSNR dB", "SSIM"], rows)


def _is_twin(row: object) -> bool:
    return getattr(row, "method", "") == "twin" and getattr(row, "region", "") == "masked"


def _sun_card(work: Workspace) -> Card:
    sky = work.sky
    azimuth = "unknown" if sky.sun_azimuth_deg is None else f"{sky.sun_azimuth_deg:.1f}"
    note = f"azimuth, elevation in degrees; {sky.origin}, +-{sky.uncertainty_deg:.2f}"
    return Card("sun", f"{azimuth}, {sky.sun_elevation_deg:.1f}", note)


def _sky_section(work: Workspace) -> Section:
    panorama, sky = work.panorama, work.sky
    seen = f"{100 * panorama.is_sky[: panorama.is_sky.shape[0] // 2].mean():.0f} %"
    return Section(
        "Sky",
        f"The cameras saw {seen} of the upper hemisphere as sky. Centre column along world +x.\n\n"
        + " ".join(f"{note}." for note in sky.notes),
        figures=[
            Figure("stitched panorama", srgb8_from_linear(panorama.radiance)),
            Figure("estimated sky, tone-mapped, ring around the sun", dome_preview(sky.dome)),
        ],
    )


def _scene_section(work: Workspace) -> Section:
    log, twin = work.log, work.twin
    renderer = FrameRenderer(twin.assets.background, work.shadow_casters, TransportConfig(), seed=0)
    scenario = replay(twin, "report", log.frames)
    skies = [renderer.prepare(work.sky.dome)]
    figures = []
    for name, camera in log.cameras.items():
        frames = log.frames_of(name)
        frame: CameraFrame = frames[len(frames) // 2]
        buffers, (light,) = renderer.render(scenario, frame, camera, skies)
        matte = np.repeat(work.sky_matte(frame)[..., None] * 255, 3, axis=2).astype(np.uint8)
        shown = [
            frame.load_srgb8(),
            srgb8_from_linear(buffers.base_colour),
            tone_mapped(light.shaded),
            normal_colours(buffers),
            depth_colours(buffers.depth_z_m),
            matte,
        ]
        caption = f"{name}: recorded | base colour | source light | normals | depth | sky matte"
        figures.append(Figure(caption, strip([_small(p, 360) for p in shown]), is_wide=True))
    return Section("Scene", figures=figures)


def _number_section(measured: GeometryReport, frames: FramesReport | None) -> Section:
    s = measured.lidar
    lidar = Table(
        ["returns", "hit rate", "median abs m", "90 % m", "within 10 cm"],
        [
            [
                s.count,
                round(s.hit_rate, 3),
                round(s.median_abs_m, 3),
                round(s.percentile_90_m, 3),
                round(s.within_10_cm, 3),
            ]
        ],
        "LiDAR beams cast again on the meshes",
    )
    tables = [lidar]
    if frames is not None:
        rows = [
            [r.camera_name, r.method, round(r.scores.psnr_db, 2), round(r.scores.ssim, 3)]
            for r in frames.rows
            if r.region == "masked" and not r.is_exposed
        ]
        tables.append(
            Table(["camera", "image", "PSNR dB", "SSIM"], rows, "held-out frames, no sky, raw")
        )
    return Section("Numbers", tables=tables)


def _stage_section(work: Workspace) -> Section:
    rows, notes = [], []
    for name in STAGE_NAMES:
        record = read_record(work.folder(name))
        if record is not None:
            rows.append([name, record["seconds"], record["peak_memory_mb"]])
            notes += [f"{name}: {note}." for note in record["notes"]]
    summary = read_json(work.need("log") / "log.json")
    text = f"Held out: {', '.join(summary['held_out']) or 'nothing'}.\n\n" + "\n\n".join(notes[:30])
    return Section("Stages", text, tables=[Table(["stage", "seconds", "peak MB so far"], rows)])


def _small(image: Image, width_px: int = _PICTURE_WIDTH) -> Image:
    """At most `width_px` wide, averaged in linear light."""
    if image.shape[1] <= width_px:
        return image
    height_px = round(image.shape[0] * width_px / image.shape[1])
    return srgb8_from_linear(resize_area(linear_from_srgb8(image), height_px, width_px))


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return str(value)
