"""Relighting of a log: target skies, frames, relit pictures, and their files.

One frame is in memory at a time, or as many as `--jobs`. A finished frame is a finished file, so an
interrupted run continues at the first missing frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lightsim.build.workspace import Workspace
from lightsim.core.cores import check_shared_loops, divide_threads
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import InputError
from lightsim.profiling import profile_so_far
from lightsim.progress import Progress
from lightsim.render.renderers import check_installed, transport_as_chosen
from lightsim.scenario.apply import driven_beside
from lightsim.scenario.replay import replay
from lightsim.simulation.claims import Job, image_scale_of, open_jobs, opened_for, plan_jobs
from lightsim.simulation.frame_files import picture_path, write_frame, write_videos
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.report import report_frames, write_relight_report, write_report_pictures
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.artefact import make_artefact, state_of
from lightsim.store.mp4 import check_codec
from lightsim.store.scenario import write_scenario
from lightsim.view.report import viewer_command

_PLAIN = RelightConfig()


def relight(work: Path, options: RelightOptions, progress: Progress) -> list[Path]:
    """Relight the log of a work folder under one or several skies; each frame is traced once.

    Returns:
        WORK/scenarios/NAME for one sky; for several WORK/scenarios/NAME/<sky> of each, in order.

    Raises:
        ArtefactError: the twin has not been built or is damaged, the recording has changed since,
            or another command is at work there.
        InputError: a sky, a camera or a frame range is wrong, or the name holds a scenario of
            other settings.
    """
    with opened_for(work, options) as workspace:
        recorded = replayed(workspace, options)
        if options.ego_offset is None:
            return make_frames(workspace, recorded, options, progress)
        scenario = driven_beside(recorded, options.ego_offset)
        return make_frames(workspace, scenario, options, progress, recorded)


def replayed(workspace: Workspace, options: RelightOptions) -> Scenario:
    """Return the recorded log in the selected frames, as a scenario without edits."""
    log = workspace.log_at(image_scale_of(workspace, options))
    frames = select_frames(log, options.cameras, options.frames)
    # The twin's own log has the image scale of the build.
    twin = replace(workspace.twin, log=log)
    return replay(twin, options.name, frames, "recorded", options.seed)


def select_frames(
    log: DrivingLog, cameras: tuple[str, ...], frames: str
) -> tuple[CameraFrame, ...]:
    """Return the frames of the named cameras whose stem is in START:STOP[:STEP].

    Raises:
        InputError: a camera is unknown, or no frame is in the range.
    """
    chosen = FrameSelection.parse(frames)
    names = cameras or tuple(log.cameras)
    found = tuple(f for name in names for f in log.frames_of(name) if chosen.holds(int(f.stem)))
    if not found:
        raise InputError(
            "the chosen range contains no frame",
            where=f"--frames {frames}",
            expected=f"frames {log.stems[0]} to {log.stems[-1]}",
        )
    return found


def make_frames(
    workspace: Workspace,
    scenario: Scenario,
    options: RelightOptions,
    progress: Progress,
    recorded: Scenario | None = None,
    made_of: Mapping[str, Any] = MappingProxyType({}),
    config: RelightConfig = _PLAIN,
    made_by: str = __name__,
) -> list[Path]:
    """Make frames, videos and reports of a scenario under each sky of the options.

    Args:
        recorded: the log without edits; None if the scenario has none.
        made_of: settings that determine the frames besides the options.
        config: settings that are not options of the command line.
        made_by: dotted name of the module that makes the scenario; frames are stale if it or a
            module that it imports changes.

    Returns:
        The folders, in the order of the skies.
    """
    # A missing renderer or encoder is reported before any file is replaced.
    check_installed(options.renderer)
    check_codec(options.video_codec)
    config = replace(config, transport=transport_as_chosen(options.renderer, config.transport))
    jobs = plan_jobs(workspace, options, config, made_of, made_by)
    # Skies of finished results are not resolved: that traces pictures, which takes half a minute.
    unmade = [
        job for job in jobs if state_of(job.folder, job.artefact_key, is_hashed=True) != "made"
    ]
    seen = SceneLuminance(workspace)
    # All skies are resolved before any result is replaced: a wrong file stops the command here.
    skies = {
        job: resolve_sky(job.choice, workspace, seen) for job in progress.track(unmade, "skies")
    }
    attempts = open_jobs(workspace, options, jobs)
    if attempts:
        log = workspace.log_at(image_scale_of(workspace, options))
        relighter = Relighter(workspace, log, config, options, recorded, renderer=seen.renderer)
        pending = [(folder, skies[job]) for job, folder in attempts.items()]
        _write_frames(relighter, scenario, pending, progress, options)
    for job in unmade:
        made = replace(scenario, sky=job.choice)
        opened = job.folder.relative_to(workspace.root / "scenarios").as_posix()
        viewer = viewer_command(workspace.root, opened)
        finish = partial(
            _finish, job=job, scenario=made, sky=skies[job], viewer=viewer, progress=progress
        )
        make_artefact(job.folder, job.artefact_key, finish)
    return [job.folder for job in jobs]


def _write_frames(
    relighter: Relighter,
    scenario: Scenario,
    pending: list[tuple[Path, TargetSky]],
    progress: Progress,
    options: RelightOptions,
) -> None:
    """Write every frame that is missing in a folder; a frame is traced once for all skies."""
    targets = [(folder, relighter.target(sky)) for folder, sky in pending]
    shown = report_frames(scenario)

    def make(frame: ScenarioFrame) -> None:
        # An interrupted run may have completed a frame under some of the skies only.
        missing = [(f, target) for f, target in targets if not picture_path(f, frame).exists()]
        if not missing:
            return
        results = relighter.relit(frame, scenario, [target for _, target in missing])
        for (folder, _), result in zip(missing, results, strict=True):
            if frame in shown:
                write_report_pictures(folder, result)
            write_frame(folder, scenario, result, options)

    count = len(scenario.frames)
    # In this thread, which an interruption stops at once.
    if options.jobs == 1:
        deque(progress.track(map(make, scenario.frames), "relight", count), maxlen=0)
        return
    check_shared_loops("--jobs")
    with ThreadPoolExecutor(options.jobs, "relight", divide_threads, (options.jobs,)) as pool:
        deque(progress.track(pool.map(make, scenario.frames), "relight", count), maxlen=0)


def _finish(
    folder: Path,
    job: Job,
    scenario: Scenario,
    sky: TargetSky,
    viewer: str,
    progress: Progress,
) -> Iterable[str]:
    """Write the files beside the frames: videos, scenario.json and the report."""
    write_videos(folder, scenario, job.video_codec, progress)
    # Times differ between runs: only a profiled result has them.
    profile = profile_so_far()
    found: dict[str, Any] = {"profile": profile} if profile else {}
    write_scenario(folder, scenario, target_sky=sky.record, options=job.settings, **found)
    write_relight_report(folder, scenario, sky, viewer, profile)
    return ()
