"""Claims on the folders of scenarios: locks, settings, artefact keys and overwriting."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightsim.build.sources import simulation_sources
from lightsim.build.workspace import Workspace
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import ArtefactError, InputError
from lightsim.relighting.methods import module_of_method
from lightsim.render.options import LightChoice
from lightsim.simulation.options import FrameOptions, RelightOptions
from lightsim.simulation.relight_methods import weights_hash
from lightsim.simulation.relighter import RelightConfig
from lightsim.simulation.skies import made_from_sky, parse_sky
from lightsim.store.artefact import (
    RECORD_NAME,
    ArtefactKey,
    hash_file,
    json_ready,
    open_attempt,
    read_record,
)
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.mp4 import DEFAULT_CODEC, Codec
from lightsim.store.reading import is_file

_STAGE = "relight"
# Settings that records omit at their default values: a record without one of them has the default.
_OPTIONAL = (
    *("labels", "weights", "renderer", "source_sky", "edits", "assets", "exposure_time_ms"),
    *("ego_offset_m", "glare", "expected_error", "video_codec"),
)


@dataclass(frozen=True, eq=False)
class Job:
    """Frames of one scenario under one sky.

    Args:
        folder: final place of the result.
        choice: the sky.
        video_codec: codec of the videos.
        settings: options that determine the frames, for the record.
        artefact_key: everything that determines the frames.
    """

    folder: Path
    choice: SkyChoice
    video_codec: Codec
    settings: dict[str, Any]
    artefact_key: ArtefactKey


@contextmanager
def opened_for(work: Path, options: RelightOptions) -> Generator[Workspace]:
    """Open a work folder while no other process writes to it or makes a scenario of this
    name.

    Raises:
        InputError: a sky is neither a file nor a known form, or another file does not exist.
        ArtefactError: the twin has not been built, or another process holds a lock.
    """
    _require_files(options)
    workspace = Workspace(work, is_stale_allowed=options.allow_stale)
    workspace.need("twin")
    scenarios = work / "scenarios"
    # Simulations only read the twin, so several may run at once; a build excludes them.
    with locked(work / LOCK_NAME, is_shared=True):
        scenarios.mkdir(exist_ok=True)
        # Two runs of the same name would write the same files.
        with locked(scenarios / f".{options.name}{LOCK_NAME}"):
            yield workspace


def _require_files(options: RelightOptions) -> None:
    """Check that files of the options exist, before the log and the twin are read, which takes
    seconds."""
    for choice in options.sky_by_name.values():
        parse_sky(choice).require_file()
    for name, path in (("--weights", options.weights), ("--source-sky", options.source_sky)):
        if path is not None and not is_file(path):
            raise InputError("no such file", where=f"{name} {path}", remedy="Check the path.")


def image_scale_of(workspace: Workspace, options: FrameOptions) -> float:
    """Return the factor on the log's image size, by default the build's."""
    return options.image_scale or workspace.reading.image_scale


def plan_jobs(
    workspace: Workspace,
    options: RelightOptions,
    config: RelightConfig,
    made_of: Mapping[str, Any],
    made_by: str,
) -> list[Job]:
    """Return one job per sky: WORK/scenarios/NAME for one sky, NAME/<sky> for several.

    Args:
        made_of: settings that determine the frames besides the options.
        made_by: dotted name of the module that makes the scenario.

    Raises:
        InputError: a sky is unknown, or the name has results of other settings or of another
            number of skies.
    """
    base = workspace.root / "scenarios" / options.name
    weights = weights_hash(workspace, options)
    sources = simulation_sources(made_by, module_of_method(options.method))
    inputs = {"twin": workspace.record("twin")["key"]}
    image_scale = image_scale_of(workspace, options)
    skies = options.sky_by_name
    if not options.overwrite:
        # Refused before the skies are traced, which takes half a minute.
        _refuse_other_layout(base, [base] if len(skies) == 1 else [base / name for name in skies])
    jobs: list[Job] = []
    for name, choice in skies.items():
        folder = base if len(skies) == 1 else base / name
        settings = {**settings_of(options, choice, image_scale), **weights, **made_of}
        if not options.overwrite:
            _refuse_other_settings(folder, {**settings, "seed": options.seed})
        # The configuration is part of the key, but not of the settings that users compare.
        made_from = {**settings, "config": json_ready(config)}
        key = ArtefactKey(_STAGE, sources, made_from, inputs, options.seed)
        jobs.append(Job(folder, choice, options.video_codec, settings, key))
    return jobs


def open_jobs(
    workspace: Workspace, options: RelightOptions, jobs: Sequence[Job]
) -> dict[Job, Path]:
    """Return the folder in which each unfinished job continues; replaced results are removed."""
    base = workspace.root / "scenarios" / options.name
    if options.overwrite:
        _remove_replaced(base, [job.folder for job in jobs])
    attempts = {job: open_attempt(job.folder, job.artefact_key) for job in jobs}
    return {job: folder for job, folder in attempts.items() if folder is not None}


def settings_of(options: RelightOptions, sky: SkyChoice, image_scale: float) -> dict[str, Any]:
    """Return the options that determine the frames; optional settings only if they differ from
    their defaults."""
    # Settings that were added later are omitted at their defaults: older results remain valid.
    light = _light_settings(options.renderer)
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
        **({"renderer": light} if light != _light_settings(LightChoice()) else {}),
        **({"source_sky": hash_file(options.source_sky)} if options.source_sky else {}),
    }


def _light_settings(choice: LightChoice) -> dict[str, Any]:
    """Return the settings that determine the light; the path of Blender does not."""
    return {"name": choice.renderer, "rays": choice.rays, "bounces": choice.bounces}


def _of_other_layout(base: Path, folders: Sequence[Path]) -> list[Path]:
    """Return the results of the other layout: NAME itself for one sky, folders in it for more."""
    pattern = f"*/{RECORD_NAME}" if list(folders) == [base] else RECORD_NAME
    return [path.parent for path in base.glob(pattern)]


def _refuse_other_layout(base: Path, folders: Sequence[Path]) -> None:
    if _of_other_layout(base, folders):
        raise InputError(
            "results for one sky and for several skies cannot share a name",
            where=base,
            got=f"{len(folders)} skies now, others before",
            remedy="Choose another --name, or give --overwrite.",
        )


def _remove_replaced(base: Path, folders: Sequence[Path]) -> None:
    """Remove results of the other layout; folders that LightSim did not make stay."""
    for folder in _of_other_layout(base, folders):
        record = read_record(folder)
        if record is not None and record["stage"] == _STAGE:
            shutil.rmtree(folder)


def _refuse_other_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Refuse to replace a finished result of other settings; a changed twin or LightSim replaces
    it."""
    try:
        record = read_record(folder)
    except ArtefactError:
        return  # The settings of a damaged record are unknown: its folder is moved aside instead.
    if record is None or record["stage"] != _STAGE:
        return
    was = {**record["config"], "seed": record.get("seed")}
    # Records are JSON: tuples are lists there.
    now = json_ready(settings)
    # Keys that only an older record has are ignored, except optional settings.
    differing = [key for key in {**now, **dict.fromkeys(_OPTIONAL)} if was.get(key) != now.get(key)]
    if differing:
        raise InputError(
            "a scenario of this name was made with other settings",
            where=folder,
            got=_differences(was, now, differing),
            expected=_differences(now, was, differing),
            remedy="Choose another --name, or give --overwrite.",
        )


def _differences(ours: Mapping[str, Any], others: Mapping[str, Any], keys: Sequence[str]) -> str:
    """Return "key = value" of our settings; of a group of settings only those that differ."""
    found: list[str] = []
    for key in keys:
        mine, other = ours.get(key), others.get(key)
        if isinstance(mine, dict) and isinstance(other, dict):
            group = [name for name in {**mine, **other} if mine.get(name) != other.get(name)]
            found += [f"{name} = {mine.get(name)}" for name in group]
        else:
            found.append(f"{key} = {mine}")
    return ", ".join(found)
