"""Pages of the demo and of evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask
from lightsim.build.workspace import Workspace
from lightsim.store.images import read_srgb8
from lightsim.view.figures import reduced, strip
from lightsim.view.report import (
    Comparison,
    Figure,
    Section,
    Table,
    Video,
    viewer_command,
    write_report,
)
from lightsim_lab.metrics.folders import pair_folders
from lightsim_lab.metrics.report import EvaluationReport

_SHOWN_STEM = "07"
"""Frame of the comparisons: the later one of the two whose truth is shipped."""


def write_demo_report(
    path: Path,
    workspace: Workspace,
    relit: Mapping[str, Mapping[str, Path]],
    scores: FramesReport,
    next_steps: Sequence[tuple[str, str]],
) -> Path:
    """Write index.html of the demo: relit frames beside the truth, films, scores and commands.

    Args:
        relit: folders of predicted, true and source frames, by sky (`relit_folders`).
        next_steps: pairs of a purpose and its command line without the program's name.
    """
    comparisons, films, reports = [], [], []
    for sky, folders in relit.items():
        result = folders["predicted"].parent
        link = result.relative_to(path.parent).as_posix()
        reports.append(f"{link}/report.html")
        for camera, stem, files in pair_folders(folders):
            if stem == _SHOWN_STEM:
                order = {"recorded": "source", "relit by LightSim": "predicted", "truth": "truth"}
                images = {name: read_srgb8(files[folder]) for name, folder in order.items()}
                comparisons.append(Comparison(f"{sky}, {camera}, frame {stem}", images))
        films += [
            Video(f"{sky}, {film.stem}", f"{link}/video/{film.name}")
            for film in sorted((result / "video").glob("*.mp4"))
        ]
    text = (
        "The street is synthetic. Its log and its true pictures are path-traced with glossy paint, "
        "glass, sensor noise and JPEG; LightSim reads the log alone. The truth is the same moment "
        "under the target sky."
    )
    scored = (
        "Raw pictures against the truth, without the sky. The methods called oracle are fitted to "
        "the truth itself."
    )
    sections = [
        Section("Recorded, relit, truth", text, comparisons=comparisons),
        Section("Films", videos=films),
        Section("Scores", scored, tables=[_relit_table(scores)]),
        Section(
            "Try next",
            "From the folder in which the demo was started, with LightSim's .venv activated.",
            tables=[Table(["what", "command"], [[w, f"lightsim {c}"] for w, c in next_steps])],
        ),
        Section(
            "More",
            f"Build report: {workspace.root.name}/report/index.html. "
            f"Relight reports: {', '.join(reports)}",
        ),
    ]
    subtitle, viewer = "the shipped synthetic street", viewer_command(workspace.root)
    write_report(path, "LightSim demo", sections, subtitle=subtitle, viewer=viewer)
    return path


def write_evaluation_report(
    folder: Path, title: str, report: EvaluationReport, tasks: Sequence[FrameTask]
) -> Path:
    """Write FOLDER/index.html: tables of an evaluation, and the middle frame of each sequence."""
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
    """Return a figure with the truth, and each method's picture above its error."""
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
