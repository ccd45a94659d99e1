"""From a twin and a target sky to relit frames and video: scenario -> buffers -> frames -> mp4.

One frame is in memory at a time; a finished frame is a finished file, so an interrupted run goes
on where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import ArtefactError, InputError
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.scenario.replay import replay
from lightsim.simulate.relighter import RelightConfig, Relighter, RelightOptions, RelitFrame
from lightsim.simulate.report import report_frames, write_relight_report, write_report_strip
from lightsim.simulate.skies import TargetSky, resolve_sky
from lightsim.store.artefact import (
    Recipe,
    json_ready,
    make_artefact,
    open_attempt,
    read_record,
    write_json,
)
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.mp4 import Mp4Writer

_SCHEMA = 3
_STAGE = "relight"


@dataclass(frozen=True, eq=False)
class _Job:
    """One scenario to make."""

    folder: Path
    options: RelightOptions
    settings: dict[str, Any]
    recipe: Recipe
    scenario: Scenario
    sky: TargetSky


def relight(work: Path, options: RelightOptions, progress: Progress) -> Path:
    """Relight the log of a work folder; returns WORK/scenarios/NAME. Raises as `relight_all`."""
    return relight_all(work, [options], progress)[0]


def relight_all(work: Path, choices: Sequence[RelightOptions], progress: Progress) -> list[Path]:
    """Relight the log of a work folder under several skies; each frame is traced once for all of
    them that are asked for at one size and seed. Returns WORK/scenarios/NAME of each.

    Raises:
        ArtefactError: the twin has not been built or is damaged, the recording has changed since,
            or another command is at work there.
        InputError: a sky, a camera or a frame range is wrong, a name comes twice, or it holds a
            scenario of other settings.
    """
    names = [options.name for options in choices]
    if len({name.casefold() for name in names}) < len(names):
        raise InputError(
            "two scenarios have one name", where="--name", got=names, expected="each name once"
        )
    workspace = Workspace(work, is_stale_allowed=any(o.is_stale_allowed for o in choices))
    workspace.need("twin")
    folder = work / "scenarios"
    with ExitStack() as locks:
        locks.enter_context(locked(work / LOCK_NAME, is_shared=True))
        folder.mkdir(exist_ok=True)
        for name in names:
            locks.enter_context(locked(folder / f".{name}{LOCK_NAME}"))
        by_tracing: dict[tuple[float, int], list[RelightOptions]] = {}
        for options in choices:
            scale = options.image_scale or workspace.reading.image_scale
            by_tracing.setdefault((scale, options.seed), []).append(options)
        for (scale, seed), alike in by_tracing.items():
            _relight(workspace, folder, alike, (scale, seed), progress)
    return [folder / name for name in names]


def _relight(
    workspace: Workspace,
    folder: Path,
    choices: Sequence[RelightOptions],
    tracing: tuple[float, int],
    progress: Progress,
) -> None:
    """The scenarios of one image scale and seed."""
    scale, seed = tracing
    config = RelightConfig()
    log = workspace.log_at(scale)
    jobs = [_job(workspace, folder / o.name, log, (o, scale), config) for o in choices]
    attempts = [(job, open_attempt(job.folder, job.recipe)) for job in jobs]
    pending = [(job, partial) for job, partial in attempts if partial is not None]
    if pending:
        relighter = Relighter(workspace, log, config, seed)
        _write_frames(relighter, pending, progress)
    for job in jobs:
        make_artefact(job.folder, job.recipe, lambda p, job=job: _finish(p, job, progress))


def _job(
    workspace: Workspace,
    folder: Path,
    log: DrivingLog,
    asked: tuple[RelightOptions, float],
    config: RelightConfig,
) -> _Job:
    options, scale = asked
    settings = options.settings(scale)
    if not options.is_overwriting:
        _refuse_other_settings(folder, {**settings, "seed": options.seed})
    made_from = {**settings, "config": json_ready(config)}
    inputs = {"twin": workspace.record("twin")["key"]}
    recipe = Recipe(_STAGE, _SCHEMA, made_from, inputs, options.seed)
    frames = select_frames(log, options.cameras, options.frames)
    sky = resolve_sky(options.sky, workspace)
    scenario = replay(replace(workspace.twin, log=log), options.name, frames)
    return _Job(folder, options, settings, recipe, scenario, sky)


def _finish(partial: Path, job: _Job, progress: Progress) -> Iterable[str]:
    """All that stands beside the frames."""
    _write_videos(partial, job.scenario, progress)
    write_json(partial / "scenario.json", scenario_summary(job.scenario, job.sky, job.settings))
    write_relight_report(partial / "report.html", partial, job.scenario, job.sky)
    return ()


def _refuse_other_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """A finished scenario goes only when the user says so, or when its twin or LightSim itself
    makes it anew."""
    try:
        record = read_record(folder)
    except ArtefactError:
        return  # Nobody knows its settings; it will be set aside, not replaced.
    if record is None or record["stage"] != _STAGE:
        return
    was = {**record["config"], "seed": record.get("seed")}
    now = json_ready(settings)
    differing = [key for key in now if was.get(key) != now[key]]
    if differing:
        raise InputError(
            "a scenario of this name was made with other settings",
            where=folder,
            got=", ".join(f"{key} = {was.get(key)}" for key in differing),
            expected=", ".join(f"{key} = {now[key]}" for key in differing),
            remedy="Choose another --name, or give --overwrite.",
        )


def select_frames(
    log: DrivingLog, cameras: tuple[str, ...], frames: str
) -> tuple[CameraFrame, ...]:
    """The frames of the named cameras whose stem lies in START:STOP[:STEP]."""
    chosen = FrameSelection.parse(frames)
    names = cameras or tuple(log.cameras)
    found = tuple(f for name in names for f in log.frames_of(name) if chosen.holds(int(f.stem)))
    if not found:
        raise InputError(
            "no frame lies in the chosen range",
            where=f"--frames {frames}",
            expected=f"frames {log.stems[0]} to {log.stems[-1]}",
        )
    return found


def _write_frames(
    relighter: Relighter, jobs: Sequence[tuple[_Job, Path]], progress: Progress
) -> None:
    """Every frame that a job lacks, traced once for all jobs."""
    targets = [relighter.target(job.sky, job.options) for job, _ in jobs]
    shown = [report_frames(job.scenario) for job, _ in jobs]
    frames = {f: None for job, _ in jobs for f in job.scenario.frames}
    for frame in progress.track(frames, "relight", len(frames)):
        lacking = [
            number
            for number, (job, folder) in enumerate(jobs)
            if frame in job.scenario.frames and not _picture(folder, frame).exists()
        ]
        if not lacking:
            continue
        scenario = jobs[lacking[0]][0].scenario
        results = relighter.relit(frame, scenario, [targets[n] for n in lacking])
        for number, result in zip(lacking, results, strict=True):
            job, folder = jobs[number]
            if frame in shown[number]:
                write_report_strip(folder, result)
            _write_frame(folder, result, is_linear_written=job.options.is_linear_written)


def _picture(folder: Path, frame: CameraFrame) -> Path:
    return folder / "frames" / frame.camera_name / f"{frame.stem}.png"


def _write_frame(folder: Path, result: RelitFrame, *, is_linear_written: bool) -> None:
    frame = result.frame
    if is_linear_written:
        linear = folder / "linear" / frame.camera_name / f"{frame.stem}.exr"
        linear.parent.mkdir(parents=True, exist_ok=True)
        write_exr(linear, result.radiance)
    path = _picture(folder, frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The PNG comes last: it marks the frame as finished.
    write_png(path, result.image_srgb8)


def _write_videos(folder: Path, scenario: Scenario, progress: Progress) -> None:
    (folder / "video").mkdir(exist_ok=True)
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    for name in progress.track(cameras, "video", len(cameras)):
        frames = [f for f in scenario.frames if f.camera_name == name]
        images = (read_srgb8(folder / "frames" / name / f"{f.stem}.png") for f in frames)
        first = read_srgb8(folder / "frames" / name / f"{frames[0].stem}.png")
        height, width = first.shape[:2]
        with Mp4Writer(
            folder / "video" / f"{name}.mp4", width, height, frame_rate(frames)
        ) as video:
            for image in images:
                video.write(image)


def frame_rate(frames: list[CameraFrame]) -> float:
    """Frames per second of one camera by the median interval; 10 for a single frame."""
    if len(frames) < 2:
        return 10.0
    intervals_s = np.diff([f.time_ns for f in frames]) / 1e9
    return float(round(1.0 / float(np.median(intervals_s)), 3))


def scenario_summary(
    scenario: Scenario, target: TargetSky, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """scenario.json: the sky, the settings, and the actors' boxes of every frame."""
    frames = [
        {
            "camera": frame.camera_name,
            "frame": frame.stem,
            "time_ns": frame.time_ns,
            "world_from_camera": frame.world_from_camera.matrix.tolist(),
            "actors": [
                {
                    "actor_id": track.actor_id,
                    "number": scenario.number_by_actor[track.actor_id],
                    "kind": track.kind,
                    "label": track.label,
                    "size_lwh_m": track.size_lwh_m.tolist(),
                    "world_from_actor": track.world_from_actor(frame.time_ns).matrix.tolist(),
                }
                for track in scenario.tracks_at(frame.time_ns)
            ],
        }
        for frame in scenario.frames
    ]
    return {
        "version": 1,
        "name": scenario.name,
        "options": dict(settings),
        "sky": target.facts,
        "edits": list(scenario.edits),
        "frames": frames,
    }
