"""Pages of the demo and of evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask
from lightsim.build.workspace import Workspace
from lightsim.store.images import read_srgb8
from lightsim.view.figures import reduced, strip
from lightsim.view.report import Figure, Section, Table, Video, write_report
from lightsim_lab.metrics.report import EvaluationReport


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
