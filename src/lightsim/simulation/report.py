"""report.html of a scenario, and the page of the demo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.evaluate.frame_report import FramesReport
from lightsim.evaluate.frames import FrameTask
from lightsim.evaluate.report import EvaluationReport
from lightsim.pipeline.workspace import Workspace
from lightsim.simulation.relighter import RelitFrame
from lightsim.simulation.skies import TargetSky
from lightsim.store.images import read_srgb8, write_png
from lightsim.view.figures import (
    dome_preview,
    ratio_grey,
    reduced,
    strip,
)
from lightsim.view.report import Figure, Section, Table, Video, write_report


def report_frames(scenario: Scenario) -> tuple[CameraFrame, ...]:
    """The frames that the page shows: the middle one of every camera."""
    by_camera: dict[str, list[CameraFrame]] = {}
    for frame in scenario.frames:
        by_camera.setdefault(frame.camera_name, []).append(frame)
    return tuple(frames[len(frames) // 2] for frames in by_camera.values())


def write_report_strip(folder: Path, result: RelitFrame) -> None:
    """The page's picture of one relit frame."""
    parts = [result.frame.load_srgb8()]
    if result.source.is_edited.any():
        parts.append(result.source.srgb8)
    if result.image_srgb8 is not result.source.srgb8:
        parts.append(result.image_srgb8)
    if result.lights is not None:
        parts += [ratio_grey(light.ratio) for light in result.lights]
    path = _strip_of(folder, result.frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, strip([reduced(p, 480) for p in parts]))


def _strip_of(folder: Path, frame: CameraFrame) -> Path:
    return folder / "report" / f"{frame.camera_name}.png"


def write_relight_report(path: Path, folder: Path, scenario: Scenario, target: TargetSky) -> None:
    """report.html of a scenario: the sky, one strip a camera, the films."""
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    edited = "edited, where edits show | " if scenario.edits else ""
    figures = []
    for frame in report_frames(scenario):
        caption = (
            f"{frame.camera_name}, frame {frame.stem}: recorded | {edited}relit | "
            "shadow ratio source | target"
        )
        figures.append(Figure(caption, read_srgb8(_strip_of(folder, frame)), is_wide=True))
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
    command = "simulate" if scenario.edits else "relight"
    subtitle = f"lightsim {command}, {target.facts['sky']}"
    write_report(path, scenario.name, sections, subtitle=subtitle)


def write_demo_report(
    path: Path,
    work: Path,
    scenarios: Sequence[Path],
    relit: FramesReport,
    next_steps: Sequence[tuple[str, str]],
) -> Path:
    """Write index.html of the demo: links, films, relit frames against ground truth, and commands
    to try, in words and without the program."""
    films, pictures, reports = [], [], []
    log = Workspace(work).log
    for folder in scenarios:
        link = folder.relative_to(path.parent).as_posix()
        reports.append(f"{link}/report.html")
        for camera in ("front_camera", "left_camera"):
            films.append(Video(f"{folder.name}: {camera}", f"{link}/video/{camera}.mp4"))
            relit_png = sorted((folder / "frames" / camera).glob("*.png"))[0]
            frame = next(f for f in log.frames_of(camera) if f.stem == relit_png.stem)
            pair = [frame.load_srgb8(), read_srgb8(relit_png)]
            caption = f"{camera}: recorded | {folder.name}"
            pictures.append(Figure(caption, strip([reduced(p) for p in pair]), is_wide=True))
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
            "Try next",
            "From the folder in which the demo was started, with LightSim's .venv activated.",
            tables=[Table(["what", "command"], [[w, f"lightsim {c}"] for w, c in next_steps])],
        ),
        Section(
            "More",
            f"Build report: {work.name}/report/index.html. Relight reports: {', '.join(reports)}",
        ),
    ]
    write_report(path, "LightSim demo", sections, subtitle="the shipped synthetic street")
    return path


def write_evaluation_report(
    folder: Path, title: str, report: EvaluationReport, tasks: Sequence[FrameTask]
) -> Path:
    """FOLDER/index.html of an evaluation: its tables, and the middle frame of each sequence."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = [
        Section(kind, tables=[Table(columns, lines)]) for kind, columns, lines in report.tables()
    ]
    sequences: dict[tuple[str, str], list[FrameTask]] = {}
    for task in tasks:
        sequences.setdefault((task.condition, task.camera_name), []).append(task)
    figures = [compared(found[len(found) // 2]) for found in sequences.values()]
    sections.insert(0, Section("Pictures", figures=figures))
    path = folder / "index.html"
    write_report(path, title, sections, subtitle="lightsim evaluate")
    return path


def compared(task: FrameTask) -> Figure:
    """Truth, then what each method made of it, each above its difference from the truth."""
    truth = task.load_truth()
    columns = [np.concatenate([truth, np.full_like(truth, 128)])]
    for load in task.load_prediction_by_method.values():
        made = load()
        error = np.abs(made.astype(np.int16) - truth)
        columns.append(np.concatenate([made, np.minimum(2 * error, 255).astype(np.uint8)]))
    methods = " | ".join(task.load_prediction_by_method)
    caption = (
        f"{task.condition}, {task.camera_name}, frame {task.stem}: truth | {methods}; below, "
        "twice the difference"
    )
    return Figure(caption, strip([reduced(c, 360) for c in columns]), is_wide=True)


def _relit_table(report: FramesReport) -> Table:
    rows = []
    for condition in report.conditions:
        for method in report.methods:
            s = report.mean(condition, method, "masked")
            rows.append([condition, method, round(s.psnr_db, 2), round(s.ssim, 3)])
    return Table(["target sky", "method", "PSNR dB", "SSIM"], rows)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return str(value)
