"""From a log to a twin: the ordered table of stages. The whole build can be read here.

Each stage is a function call on what earlier stages made, and its result an artefact folder
(store/artefact.py). Stages know nothing of each other: what one needs from another (a ray caster,
a sky matte, light at vertices) is handed to it in stages.py.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lightsim import stages
from lightsim.align.config import AlignConfig
from lightsim.assets import config as asset_config
from lightsim.assets import mesh_config
from lightsim.assets.config import Colour
from lightsim.errors import ArtefactError
from lightsim.ingest.sky_mask import SkyMaskConfig
from lightsim.lighting.stitch import StitchConfig
from lightsim.progress import Progress
from lightsim.reconstruct import fuse_config, neural_config
from lightsim.source_sun import GpsUse, SourceSunConfig
from lightsim.store.artefact import (
    Recipe,
    State,
    fingerprint,
    json_ready,
    make_artefact,
    read_json,
    read_record,
    state_of,
    write_json,
)
from lightsim.store.log import LogReading, reading_from_json
from lightsim.workspace import Workspace

logger = logging.getLogger(__name__)

OPTIONS_NAME = "build.json"


_FUSE = {"draft": fuse_config.draft, "standard": fuse_config.standard, "paper": fuse_config.paper}
_NEURAL = {
    "draft": neural_config.draft,
    "standard": neural_config.standard,
    "paper": neural_config.paper,
}
_MESHES = {"draft": mesh_config.draft, "standard": mesh_config.standard, "paper": mesh_config.paper}
_ASSETS = {
    "draft": asset_config.draft,
    "standard": asset_config.standard,
    "paper": asset_config.paper,
}


@dataclass(frozen=True)
class BuildOptions:
    """What a build is made from.

    Args:
        reading: how to read the log.
        preset: "draft", "standard" or "paper".
        seed: of all random numbers.
        neural_steps: of training the neural field; None is the preset's, 0 goes without.
        device: "auto", "cpu" or "cuda", for training; results on the CPU do not depend on it.
        no_refine: physics of the log to leave out (align/config.py: PARTS, OTHER_PARTS).
        colour: "texture", "vertex" or "field" (assets/config.py); None is the preset's.
        gps: how much of the log's place, time and heading the sun is found with.
    """

    reading: LogReading
    preset: str = "standard"
    seed: int = 0
    neural_steps: int | None = None
    device: str = "auto"
    no_refine: tuple[str, ...] = ()
    colour: Colour | None = None
    gps: GpsUse = "all"


@dataclass(frozen=True)
class Stage:
    """One row of the table.

    Args:
        name: of the artefact folder.
        schema: raise it when the stage's algorithm or files change.
        needs: artefacts it reads.
        config: its configuration, from the options.
        make: fills the folder, returns notes.
    """

    name: str
    schema: int
    needs: tuple[str, ...]
    config: Callable[[BuildOptions], Any]
    make: Callable[[Workspace, Any, Path, stages.Context], Iterable[str]]


def _asset_config(options: BuildOptions) -> asset_config.AssetConfig:
    config = _ASSETS[options.preset]()
    config = replace(config, has_camera_gains="camera_gains" not in options.no_refine)
    return config if options.colour is None else replace(config, colour=options.colour)


def _neural_config(options: BuildOptions) -> neural_config.NeuralConfig:
    config = _NEURAL[options.preset]()
    if "camera_gains" in options.no_refine:
        config = replace(config, has_camera_gains=False)
    return config if options.neural_steps is None else replace(config, steps=options.neural_steps)


STAGES = (
    Stage("log", 1, (), lambda o: o.reading, stages.make_log),
    Stage("masks", 1, ("log",), lambda o: SkyMaskConfig(), stages.make_masks),
    Stage(
        "alignment",
        2,
        ("log",),
        lambda o: AlignConfig().without(o.no_refine),
        stages.make_alignment,
    ),
    Stage("fields", 1, ("log", "alignment"), lambda o: _FUSE[o.preset](), stages.make_fields),
    Stage("neural", 1, ("log", "masks", "fields"), _neural_config, stages.make_neural),
    Stage(
        "geometry",
        2,
        ("log", "masks", "neural"),
        lambda o: stages.GeometryConfig(_MESHES[o.preset]()),
        stages.make_geometry,
    ),
    Stage("assets", 2, ("log", "masks", "geometry"), _asset_config, stages.make_assets),
    Stage("panorama", 2, ("masks", "assets"), lambda o: StitchConfig(), stages.make_panorama),
    Stage(
        "sky",
        4,
        ("assets", "panorama"),
        lambda o: stages.SkyStageConfig(SourceSunConfig(gps=o.gps)),
        stages.make_sky,
    ),
    Stage("twin", 2, ("assets", "sky"), lambda o: stages.TwinConfig(), stages.make_twin),
    Stage("report", 1, ("masks", "fields", "twin"), lambda o: None, stages.make_report),
)


def recipes(options: BuildOptions) -> dict[str, Recipe]:
    """The recipe of every stage; a stage's key holds the keys of all it needs."""
    source_key = fingerprint(Path(options.reading.source))
    made: dict[str, Recipe] = {}
    for stage in STAGES:
        inputs = {name: made[name].key for name in stage.needs} or {"source": source_key}
        made[stage.name] = Recipe(
            stage.name, stage.schema, json_ready(_as_mapping(stage, options)), inputs, options.seed
        )
    return made


def _as_mapping(stage: Stage, options: BuildOptions) -> dict[str, Any]:
    config = json_ready(stage.config(options))
    return config if isinstance(config, dict) else {"value": config}


def build(
    work: Path, options: BuildOptions, progress: Progress, until: str = "report"
) -> Workspace:
    """Make what is missing or stale in `work`, in order, up to the stage `until`; finished
    artefacts are kept.

    Raises:
        InputError: the log is broken, or an option is out of range.
    """
    work.mkdir(parents=True, exist_ok=True)
    by_stage = recipes(options)
    write_json(work / OPTIONS_NAME, options)
    workspace = Workspace(work, options.reading)
    context = stages.Context(progress, options.seed, options.preset, options.device)
    for stage in _stages_until(until):
        recipe = by_stage[stage.name]
        folder = work / stage.name
        if state_of(folder, recipe) == "made":
            logger.info("%-9s kept", stage.name)
            continue
        logger.info("%-9s ...", stage.name)
        record = make_artefact(
            folder,
            recipe,
            lambda partial, stage=stage: stage.make(
                workspace, stage.config(options), partial, context
            ),
        )
        logger.info(
            "%-9s made in %.1f s (peak memory %d MB)",
            stage.name,
            record["seconds"],
            record["peak_memory_mb"],
        )
        for note in record["notes"]:
            logger.info("          note: %s", note)
    return workspace


def _stages_until(name: str) -> tuple[Stage, ...]:
    """The table's rows up to one, with it."""
    return STAGES[: [stage.name for stage in STAGES].index(name) + 1]


@dataclass(frozen=True)
class StageStatus:
    """One line of `lightsim status`."""

    name: str
    state: State
    seconds: float | None
    peak_memory_mb: int | None


def status(work: Path) -> list[StageStatus]:
    """State of every artefact against the options that the last build of `work` used.

    Raises:
        ArtefactError: `work` holds no build.
    """
    options = read_options(work)
    lines: list[StageStatus] = []
    for name, recipe in recipes(options).items():
        found = read_record(work / name)
        state = state_of(work / name, recipe)
        seconds = found["seconds"] if found else None
        memory = found["peak_memory_mb"] if found else None
        lines.append(StageStatus(name, state, seconds, memory))
    return lines


def read_options(work: Path) -> BuildOptions:
    """The options that the last build of `work` used.

    Raises:
        ArtefactError: `work` holds no build, or its options are broken.
    """
    path = work / OPTIONS_NAME
    if not path.is_file():
        raise ArtefactError(
            "the folder holds no build",
            where=work,
            remedy=f"Run: lightsim build SOURCE --work {work}",
        )
    value = read_json(path)
    try:
        reading = reading_from_json(value["reading"])
        return BuildOptions(
            reading,
            value["preset"],
            value["seed"],
            value["neural_steps"],
            value["device"],
            tuple(value["no_refine"]),
            value["colour"],
            value["gps"],
        )
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the options of the build are broken", where=path, got=error, remedy="Build again."
        ) from error
