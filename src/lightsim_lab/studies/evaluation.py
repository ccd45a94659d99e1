"""Evaluation of frames for `lightsim evaluate frames` and `relight`.

Frames are scored individually, as sets (FID, KID), by their mutual consistency, and by shadows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from lightsim.build.measures import held_out_frame_tasks
from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask, score_frames
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.simulation.options import RelightOptions
from lightsim.store.images import read_grey8
from lightsim_lab.baselines.colour_transfer_tables import BASELINES
from lightsim_lab.metrics.consistency import ConsistencyRow
from lightsim_lab.metrics.folders import folder_tasks
from lightsim_lab.metrics.left_shadows import score_left_shadows
from lightsim_lab.metrics.lpips import ALL_MEASURES
from lightsim_lab.metrics.options import MeasureOptions
from lightsim_lab.metrics.report import Cost, EvaluationReport
from lightsim_lab.metrics.shadows import TrueShadows, score_shadows
from lightsim_lab.studies.against_truth import relit_folders
from lightsim_lab.studies.picture_consistency import RECORDED, picture_consistency
from lightsim_lab.studies.relight_cost import Folders, with_cost
from lightsim_lab.studies.report import write_evaluation_report
from lightsim_lab.studies.true_surfaces import TrueSurfaces
from lightsim_lab.synthetic.reader import true_sky

_SOURCE = "source"


def evaluate_held_out(
    work: Path, options: MeasureOptions, progress: Progress, *, with_field: bool = False
) -> EvaluationReport:
    """Score held-out frames rendered by the twin under its source sky against the camera.

    Raises:
        InputError: the build has no held-out frames.
    """
    tasks = held_out_frame_tasks(Workspace(work), with_field=with_field)
    return measured(tasks, options, progress, f"Held-out frames of {work.name}")


def evaluate_folders(
    folders: Mapping[str, Path],
    masks: Path | None,
    work: Path | None,
    options: MeasureOptions,
    progress: Progress,
) -> EvaluationReport:
    """Score the frames of a folder against those of another folder.

    Args:
        folders: "predicted", "truth" and optionally "source", for the trivial baselines, with
            <camera>/<frame>.png.
        masks: folder with <camera>/<frame>.png, bright where a pixel is scored.
        work: work folder of the log, for the consistency between frames; None omits it.

    Raises:
        InputError: a folder is missing, or the folders have no frame in common.
    """
    is_valid = None if masks is None else partial(_read_mask, masks)
    baselines = BASELINES if "source" in folders and options.baselines else None
    tasks = folder_tasks("frames", ["predicted"], folders, is_valid, baselines)
    rows: tuple[ConsistencyRow, ...] = ()
    if work is not None:
        names = {"source": RECORDED}
        shown = {names.get(name, name): folder for name, folder in folders.items()}
        rows = picture_consistency(Workspace(work), "frames", shown, progress)
    title = f"{folders['predicted']} against {folders['truth']}"
    return measured(tasks, options, progress, title, consistency=rows)


def evaluate_relit(
    work: Path,
    truth: Path,
    relighting: Sequence[RelightOptions],
    options: MeasureOptions,
    progress: Progress,
) -> EvaluationReport:
    """Score relit frames and trivial baselines against the truth of a synthetic log.

    Includes scores by class of surface, shadows, and consistency between pictures.

    Args:
        relighting: options of each method; skies and frames are replaced by those of the truth.

    Raises:
        InputError: `truth` is not a folder that `lightsim synthesize` wrote.
    """
    workspace = Workspace(work, is_stale_allowed=any(r.allow_stale for r in relighting))
    folders: dict[str, dict[str, Path]] = {}
    costs: dict[str, Cost] = {}
    for one in relighting:
        made, cost = relit_with_cost(work, truth, one, progress)
        for sky, frames in made.items():
            shown = {one.method: frames["predicted"], "truth": frames["truth"]}
            folders.setdefault(sky, {}).update({**shown, _SOURCE: frames["source"]})
        costs |= {} if cost is None else {one.method: cost}
    skies = {name: true_sky(truth, name) for name in (*folders, _SOURCE)}
    surfaces = TrueSurfaces(truth / "scene.npz", workspace, skies)
    methods = [one.method for one in relighting]
    baselines = BASELINES if options.baselines else None
    tasks: list[FrameTask] = []
    consistency: list[ConsistencyRow] = []
    for sky, frames in folders.items():
        classes = partial(surfaces.classes, sky)
        tasks += folder_tasks(sky, methods, frames, surfaces.is_surface, baselines, classes)
        # Matching needs pictures of the size of the twin's buffers.
        if workspace.reading.image_scale == 1.0:
            shown = {RECORDED if name == _SOURCE else name: path for name, path in frames.items()}
            consistency += picture_consistency(workspace, sky, shown, progress)
    report = measured(
        tasks,
        options,
        progress,
        f"Relit frames of {work.name}",
        consistency=consistency,
        load_shadows=lambda sky, task: surfaces.shadows(sky, task.camera_name, task.stem),
    )
    return replace(report, costs=costs)


def relit_with_cost(
    work: Path, truth: Path, relighting: RelightOptions, progress: Progress
) -> tuple[Folders, Cost | None]:
    """Relight to the skies of the truth; return folders of frames by sky, and the cost if known.

    Raises:
        InputError: `truth` is not a folder that `lightsim synthesize` wrote.
    """

    def relight() -> Folders:
        workspace = Workspace(work, is_stale_allowed=relighting.allow_stale)
        return relit_folders(workspace, truth, relighting, progress)

    return with_cost(work, relighting.name, relight)


def measured(
    tasks: Sequence[FrameTask],
    options: MeasureOptions,
    progress: Progress,
    title: str,
    consistency: Sequence[ConsistencyRow] = (),
    load_shadows: Callable[[str, FrameTask], TrueShadows | None] | None = None,
) -> EvaluationReport:
    """Compute all measures of the given frames, and write the HTML page if requested."""
    from lightsim_lab.metrics.distribution import score_sets
    from lightsim_lab.metrics.inception import Inception

    # Loaded first, so that missing weights are reported before the slow measures run.
    network = Inception(options.inception) if options.fid else None
    frames: FramesReport = score_frames(tasks, ALL_MEASURES, progress=progress)
    report = EvaluationReport(
        frames,
        () if network is None else score_sets(tasks, network, options.kid_subset_size, progress),
        consistency=tuple(consistency),
    )
    if load_shadows is not None:
        report = replace(
            report,
            shadows=score_shadows(tasks, lambda task: load_shadows(task.condition, task), frames),
            left_shadows=score_left_shadows(tasks, partial(load_shadows, _SOURCE)),
        )
    if options.html is not None:
        write_evaluation_report(options.html, title, report, tasks)
    return report


def _read_mask(folder: Path, camera: str, stem: str) -> Bool[np.ndarray, "h w"]:
    path = folder / camera / f"{stem}.png"
    if not path.is_file():
        raise InputError(
            "a frame has no mask", where=path, expected="8-bit grey, 255 where a pixel is scored"
        )
    return read_grey8(path) >= 128
