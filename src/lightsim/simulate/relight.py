"""From a twin and a target sky to relit frames and video: scenario -> buffers -> frames -> mp4.

One frame is in memory at a time; a finished frame is a finished file, so an interrupted run goes
on where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import InputError
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.scenario.replay import replay
from lightsim.simulate.relighter import RelightConfig, Relighter, RelightOptions
from lightsim.simulate.report import write_relight_report
from lightsim.simulate.skies import TargetSky, resolve_sky
from lightsim.store.artefact import (
    Recipe,
    json_ready,
    make_artefact,
    read_record,
    write_json,
)
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.mp4 import Mp4Writer

_SCHEMA = 2
_STAGE = "relight"


def relight(work: Path, options: RelightOptions, progress: Progress) -> Path:
    """Relight the log of a work folder; returns WORK/scenarios/NAME.

    Raises:
        ArtefactError: the twin has not been built or is damaged, the recording has changed since,
            or another command is at work there.
        InputError: the sky, a camera or a frame range is wrong, or the name holds a scenario of
            other settings.
    """
    workspace = Workspace(work, is_stale_allowed=options.is_stale_allowed)
    workspace.need("twin")
    folder = work / "scenarios" / options.name
    with locked(work / LOCK_NAME, is_shared=True):
        folder.parent.mkdir(exist_ok=True)
        with locked(folder.parent / f".{folder.name}{LOCK_NAME}"):
            _relight(workspace, folder, options, progress)
    return folder


def _relight(
    workspace: Workspace, folder: Path, options: RelightOptions, progress: Progress
) -> None:
    scale = options.image_scale or workspace.reading.image_scale
    settings = options.settings(scale)
    inputs = {"twin": workspace.record("twin")["key"]}
    config = RelightConfig()
    made_from = {**settings, "config": json_ready(config)}
    recipe = Recipe(_STAGE, _SCHEMA, made_from, inputs, options.seed)
    if not options.is_overwriting:
        _refuse_other_settings(folder, {**settings, "seed": options.seed})
    log = workspace.log_at(scale)
    frames = select_frames(log, options.cameras, options.frames)
    target = resolve_sky(options.sky, workspace)

    def make(partial: Path) -> Iterable[str]:
        twin = replace(workspace.twin, log=log)
        scenario = replay(twin, options.name, frames)
        relighter = Relighter(workspace, log, target, options, config)
        _write_frames(partial, scenario, relighter, options, progress)
        _write_videos(partial, scenario, progress)
        write_json(partial / "scenario.json", scenario_summary(scenario, target, settings))
        write_relight_report(partial / "report.html", partial, scenario, relighter, target)
        return ()

    make_artefact(folder, recipe, make)


def _refuse_other_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """A finished scenario goes only when the user says so, or when its twin or LightSim itself
    makes it anew."""
    record = read_record(folder)
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
    folder: Path,
    scenario: Scenario,
    relighter: Relighter,
    options: RelightOptions,
    progress: Progress,
) -> None:
    for frame in progress.track(scenario.frames, "relight", len(scenario.frames)):
        path = folder / "frames" / frame.camera_name / f"{frame.stem}.png"
        linear = folder / "linear" / frame.camera_name / f"{frame.stem}.exr"
        if path.exists():
            continue
        result = relighter.relit(frame, scenario)
        if options.is_linear_written:
            linear.parent.mkdir(parents=True, exist_ok=True)
            write_exr(linear, result.radiance)
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
