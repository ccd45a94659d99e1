"""From a twin and a target sky to relit frames and video: scenario -> buffers -> frames -> mp4.

One frame is in memory at a time; a finished frame is a finished file, so an interrupted run goes
on where it stopped.
"""

from __future__ import annotations

import shutil
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from lightsim.build.sources import simulation_sources
from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import ArtefactError, InputError
from lightsim.progress import Progress
from lightsim.relighting.methods import module_of_method
from lightsim.render.options import LightChoice
from lightsim.render.renderers import check_installed, transport_as_chosen
from lightsim.scenario.apply import driven_beside
from lightsim.scenario.replay import replay
from lightsim.simulation.labels import write_labels
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight_methods import weights_hash
from lightsim.simulation.relighter import RelightConfig, Relighter, RelitFrame
from lightsim.simulation.report import report_frames, write_relight_report, write_report_strip
from lightsim.simulation.seen_light import SeenLight
from lightsim.simulation.skies import TargetSky, made_from_sky, resolve_sky
from lightsim.store.artefact import (
    RECORD_NAME,
    ArtefactKey,
    hash_file,
    json_ready,
    make_artefact,
    open_attempt,
    read_record,
)
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.mp4 import DEFAULT_CODEC, Codec, Mp4Writer, check_codec
from lightsim.store.scenario import write_scenario

_STAGE = "relight"
_OPTIONAL = (
    *("labels", "weights", "renderer", "source_sky", "edits", "assets", "exposure_time_ms"),
    *("ego_offset_m", "glare", "expected_error", "video_codec"),
)
_PLAIN = RelightConfig()


@dataclass(frozen=True, eq=False)
class _Job:
    """One scenario to make."""

    folder: Path
    settings: dict[str, Any]
    artefact_key: ArtefactKey
    scenario: Scenario
    sky: TargetSky


def relight(work: Path, options: RelightOptions, progress: Progress) -> list[Path]:
    """Relight the log of a work folder under some skies; each frame is traced once for all.

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


@contextmanager
def opened_for(work: Path, options: RelightOptions) -> Generator[Workspace]:
    """The work folder, while nobody else writes there or makes a scenario of the same name."""
    workspace = Workspace(work, is_stale_allowed=options.allow_stale)
    workspace.need("twin")
    scenarios = work / "scenarios"
    with locked(work / LOCK_NAME, is_shared=True):
        scenarios.mkdir(exist_ok=True)
        with locked(scenarios / f".{options.name}{LOCK_NAME}"):
            yield workspace


def replayed(workspace: Workspace, options: RelightOptions) -> Scenario:
    """The log as it was, in the frames that are asked for."""
    log = workspace.log_at(_scale(workspace, options))
    frames = select_frames(log, options.cameras, options.frames)
    twin = replace(workspace.twin, log=log)
    return replay(twin, options.name, frames, "recorded", options.seed)


def _scale(workspace: Workspace, options: RelightOptions) -> float:
    return options.image_scale or workspace.reading.image_scale


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
    """Frames, films and reports of a scenario under each sky that is asked for.

    Args:
        recorded: the log as it was, where the scenario has edits.
        made_of: what decides the frames besides the options.
        config: settings that no option of every command names.
        made_by: dotted name of the module that makes the scenario; the frames are stale when it
            or a module that it imports changes.

    Returns:
        The folders, in the order of the skies.
    """
    # First of all: nothing is replaced for a renderer or an encoder that is not there.
    check_installed(options.renderer)
    check_codec(options.video_codec)
    config = replace(config, transport=transport_as_chosen(options.renderer, config.transport))
    scale = _scale(workspace, options)
    base = workspace.root / "scenarios" / options.name
    weights = weights_hash(workspace, options)
    sources = simulation_sources(made_by, module_of_method(options.method))
    skies = options.sky_by_name
    folders = [base] if len(skies) == 1 else [base / name for name in skies]
    jobs, seen = [], SeenLight(workspace)
    for folder, choice in zip(folders, skies.values(), strict=True):
        settings = {**_settings(options, choice, scale), **weights, **made_of}
        if not options.overwrite:
            _refuse_other_settings(folder, {**settings, "seed": options.seed})
        made_from = {**settings, "config": json_ready(config)}
        inputs = {"twin": workspace.record("twin")["key"]}
        artefact_key = ArtefactKey(_STAGE, sources, made_from, inputs, options.seed)
        target = resolve_sky(choice, workspace, seen)
        jobs.append(_Job(folder, settings, artefact_key, replace(scenario, sky=choice), target))
    _make_room(base, folders, is_overwriting=options.overwrite)
    attempts = [(job, open_attempt(job.folder, job.artefact_key)) for job in jobs]
    pending = [(job, attempt) for job, attempt in attempts if attempt is not None]
    if pending:
        log = workspace.log_at(scale)
        relighter = Relighter(workspace, log, config, options, recorded)
        _write_frames(relighter, pending, progress, options)
    for job in jobs:
        finish = partial(_finish, job=job, codec=options.video_codec, progress=progress)
        make_artefact(job.folder, job.artefact_key, finish)
    return folders


def _settings(options: RelightOptions, sky: SkyChoice, image_scale: float) -> dict[str, Any]:
    """All that decides the frames besides twin and sky file."""
    light = _settings_of(options.renderer)
    return {
        "sky": made_from_sky(sky),
        "method": options.method,
        "exposure_ev": options.exposure_ev,
        "cameras": list(options.cameras),
        "frames": options.frames,
        "image_scale": image_scale,
        "linear": options.linear,
        **({"labels": True} if options.labels else {}),
        **({"ego_offset_m": options.ego_offset} if options.ego_offset else {}),
        **({"glare": options.glare} if options.glare else {}),
        **({"expected_error": True} if options.expected_error else {}),
        **({"video_codec": options.video_codec} if options.video_codec != DEFAULT_CODEC else {}),
        **({"renderer": light} if light != _settings_of(LightChoice()) else {}),
        **({"source_sky": hash_file(options.source_sky)} if options.source_sky else {}),
    }


def _settings_of(choice: LightChoice) -> dict[str, Any]:
    """What decides the light; where Blender lies does not."""
    return {"name": choice.renderer, "rays": choice.rays, "bounces": choice.bounces}


def _make_room(base: Path, folders: Sequence[Path], *, is_overwriting: bool) -> None:
    """The scenario of one sky is NAME itself, those of several are folders in it: one kind makes
    way for the other only when the user says so."""
    pattern = f"*/{RECORD_NAME}" if folders == [base] else RECORD_NAME
    standing = [path.parent for path in base.glob(pattern)]
    if standing and not is_overwriting:
        raise InputError(
            "a name holds the scenario of one sky, or those of several",
            where=base,
            got=f"{len(folders)} skies now, others before",
            remedy="Choose another --name, or give --overwrite.",
        )
    for folder in standing:
        record = read_record(folder)
        if record is not None and record["stage"] == _STAGE:
            shutil.rmtree(folder)


def _finish(folder: Path, job: _Job, codec: Codec, progress: Progress) -> Iterable[str]:
    """All that stands beside the frames."""
    _write_videos(folder, job.scenario, codec, progress)
    write_scenario(folder, job.scenario, target_sky=job.sky.facts, options=job.settings)
    write_relight_report(folder / "report.html", folder, job.scenario, job.sky)
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
    # What an older record, or a scenario without edits, does not name is not asked for.
    differing = [key for key in {**now, **dict.fromkeys(_OPTIONAL)} if was.get(key) != now.get(key)]
    if differing:
        raise InputError(
            "a scenario of this name was made with other settings",
            where=folder,
            got=", ".join(f"{key} = {was.get(key)}" for key in differing),
            expected=", ".join(f"{key} = {now.get(key)}" for key in differing),
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
    relighter: Relighter,
    jobs: Sequence[tuple[_Job, Path]],
    progress: Progress,
    options: RelightOptions,
) -> None:
    """Every frame that a job lacks, traced once for all jobs."""
    targets = [relighter.target(job.sky) for job, _ in jobs]
    scenario = jobs[0][0].scenario
    shown = report_frames(scenario)
    for frame in progress.track(scenario.frames, "relight", len(scenario.frames)):
        lacking = [n for n, (_, folder) in enumerate(jobs) if not _picture(folder, frame).exists()]
        if not lacking:
            continue
        results = relighter.relit(frame, scenario, [targets[n] for n in lacking])
        for number, result in zip(lacking, results, strict=True):
            folder = jobs[number][1]
            if frame in shown:
                write_report_strip(folder, result)
            if options.labels:
                write_labels(folder, scenario, result)
            if options.expected_error:
                _write_expected_error(folder, result)
            _write_frame(folder, result, is_linear_written=options.linear)


def _picture(folder: Path, frame: CameraFrame) -> Path:
    return folder / "frames" / frame.camera_name / f"{frame.stem}.png"


def _write_expected_error(folder: Path, result: RelitFrame) -> None:
    """Nothing is expected to be wrong where pixels kept their light."""
    error = result.expected_error
    if error is None:
        error = np.zeros(result.image_srgb8.shape[:2], np.float32)
    path = folder / "error" / result.frame.camera_name / f"{result.frame.stem}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.rint(255 * np.clip(error, 0, 1)).astype(np.uint8))


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


def _write_videos(folder: Path, scenario: Scenario, codec: Codec, progress: Progress) -> None:
    (folder / "video").mkdir(exist_ok=True)
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    for name in progress.track(cameras, "video", len(cameras)):
        frames = [f for f in scenario.frames if f.camera_name == name]
        images = (read_srgb8(folder / "frames" / name / f"{f.stem}.png") for f in frames)
        first = read_srgb8(folder / "frames" / name / f"{frames[0].stem}.png")
        height, width = first.shape[:2]
        path = folder / "video" / f"{name}.mp4"
        with Mp4Writer(path, width, height, frame_rate(frames), codec) as video:
            for image in images:
                video.write(image)


def frame_rate(frames: Sequence[CameraFrame]) -> float:
    """Frames per second of one camera by the median interval; 10 for a single frame."""
    if len(frames) < 2:
        return 10.0
    intervals_s = np.diff([f.time_ns for f in frames]) / 1e9
    return float(round(1.0 / float(np.median(intervals_s)), 3))
