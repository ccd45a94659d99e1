"""From a log to a twin: the ordered table of stages. The whole build can be read here.

Each stage is a function call on what earlier stages made, and its result an artefact folder
(store/artefact.py). Stages know nothing of each other: what one needs from another (a ray caster,
a sky matte, light at vertices) is handed to it in pipeline/stages/.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from lightsim.align.config import AlignConfig
from lightsim.appearance import config as asset_config
from lightsim.core.checks import check_choice
from lightsim.core.notes import printed_note, unseen_notes
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.reader import check_layout
from lightsim.errors import ArtefactError, InputError
from lightsim.geometry.plain import BaseMaterials
from lightsim.lighting.panorama.stitch import StitchConfig
from lightsim.pipeline.measures import MeasureConfig
from lightsim.pipeline.options import BuildOptions
from lightsim.pipeline.report import ReportConfig
from lightsim.pipeline.source_sun import SourceSunConfig
from lightsim.pipeline.stages import light, published, recording, results, surfaces
from lightsim.pipeline.stages.context import Context
from lightsim.pipeline.suitability import check_places, check_suitable
from lightsim.pipeline.workspace import OPTIONS_NAME, Workspace
from lightsim.progress import Progress
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.fusion import config as fuse_config
from lightsim.store.artefact import (
    RECORD_NAME,
    ArtefactKey,
    State,
    find_damage,
    hash_names,
    json_ready,
    make_artefact,
    read_json,
    read_record,
    state_of,
    write_json,
)
from lightsim.store.atomic import sweep_partials
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.log import reading_from_json
from lightsim.store.reading import is_folder

logger = logging.getLogger(__name__)

_FUSE = {"draft": fuse_config.draft, "standard": fuse_config.standard}
_NEURAL = {
    "draft": neural_config.draft,
    "standard": neural_config.standard,
    "paper": neural_config.paper,
}
_ASSETS = {
    "draft": asset_config.draft,
    "standard": asset_config.standard,
    "paper": asset_config.paper,
}


@dataclass(frozen=True)
class Stage:
    """One row of the table.

    Args:
        name: of the artefact folder.
        schema: raise it when the stage's algorithm, constants or files change.
        needs: artefacts it reads.
        config: what presets and options decide of it.
        make: fills the folder, returns notes.
    """

    name: str
    schema: int
    needs: tuple[str, ...]
    config: Callable[[BuildOptions], Any]
    make: Callable[[Workspace, Any, Path, Context], Iterable[str]]


def _asset_config(options: BuildOptions) -> asset_config.AssetConfig:
    config = _ASSETS[options.preset]()
    config = replace(config, has_camera_gains="camera_gains" not in options.no_refine)
    return config if options.colour is None else replace(config, colour=options.colour)


def _neural_config(options: BuildOptions) -> neural_config.NeuralConfig:
    config = _NEURAL[options.preset]()
    if "camera_gains" in options.no_refine:
        config = replace(config, has_camera_gains=False)
    return config if options.neural_steps is None else replace(config, steps=options.neural_steps)


def _stitch_config(options: BuildOptions) -> StitchConfig:
    """The paper stitches one moment."""
    return StitchConfig(frame_count=1) if options.preset == "paper" else StitchConfig()


def _sky_config(options: BuildOptions) -> light.SkyStageConfig:
    sun = SourceSunConfig(gps=options.gps)
    return light.SkyStageConfig(sun, model=options.sky_model or "analytic")


def _no_settings(_: BuildOptions) -> None:
    """Of a stage whose numbers are constants: its schema stands for them."""


STAGES = (
    Stage("log", 4, (), lambda o: replace(o.reading, source=""), recording.make_log),
    Stage("masks", 11, ("log",), _no_settings, recording.make_masks),
    Stage("held_out_masks", 9, ("log",), _no_settings, recording.make_held_out_masks),
    Stage(
        "alignment",
        4,
        ("log",),
        lambda o: AlignConfig().without(o.no_refine),
        recording.make_alignment,
    ),
    Stage("fields", 4, ("log", "alignment"), lambda o: _FUSE[o.preset](), recording.make_fields),
    Stage(
        "neural",
        1,
        ("log", "masks", "alignment", "fields"),
        _neural_config,
        recording.make_neural,
    ),
    Stage(
        "geometry",
        30,
        ("log", "masks", "alignment", "neural"),
        _no_settings,
        surfaces.make_geometry,
    ),
    Stage(
        "assets",
        12,
        ("log", "masks", "alignment", "fields", "neural", "geometry"),
        _asset_config,
        surfaces.make_assets,
    ),
    Stage(
        "panorama",
        2,
        ("log", "masks", "alignment", "assets"),
        _stitch_config,
        light.make_panorama,
    ),
    Stage(
        "sky",
        14,
        ("log", "alignment", "geometry", "assets", "panorama"),
        _sky_config,
        light.make_sky,
    ),
    Stage(
        "twin",
        20,
        ("log", "alignment", "neural", "assets", "sky"),
        lambda o: light.TwinConfig(),
        light.make_twin,
    ),
    Stage(
        "measures",
        2,
        ("log", "held_out_masks", "alignment", "assets", "sky"),
        lambda o: MeasureConfig(),
        results.make_measures,
    ),
    Stage(
        "report",
        2,
        ("log", "masks", "held_out_masks", "alignment", "panorama", "sky", "twin", "measures"),
        lambda o: ReportConfig(tuple(s.name for s in STAGES if s.name != "report")),
        results.make_report,
    ),
)

PUBLISHED = (
    Stage(
        "fields",
        2,
        ("log", "alignment"),
        lambda o: fuse_config.paper(),
        published.make_fields,
    ),
    Stage(
        "geometry",
        1,
        ("log", "alignment", "neural"),
        lambda o: BaseMaterials(),
        published.make_geometry,
    ),
    Stage(
        "assets",
        1,
        ("log", "alignment", "fields", "neural", "geometry"),
        _asset_config,
        published.make_assets,
    ),
    Stage(
        "sky",
        1,
        ("log", "alignment", "panorama"),
        lambda o: published.DecodedSkyConfig(gps=o.gps),
        published.make_sky,
    ),
    Stage(
        "twin",
        1,
        ("log", "alignment", "assets", "sky"),
        _no_settings,
        published.make_twin,
    ),
)
"""The rows that `--preset paper` has in place of those of the same names."""


def stages_of(options: BuildOptions) -> tuple[Stage, ...]:
    """The rows of the table that a build runs, in order."""
    own = {s.name: s for s in PUBLISHED} if options.preset == "paper" else {}
    return tuple(own.get(stage.name, stage) for stage in STAGES)


def artefact_keys(options: BuildOptions, source_key: str) -> dict[str, ArtefactKey]:
    """The recipe of every stage; a stage's key holds the keys of all it needs.

    Args:
        source_key: hash of the recording.
    """
    made: dict[str, ArtefactKey] = {}
    for stage in stages_of(options):
        inputs = {name: made[name].key for name in stage.needs} or {"source": source_key}
        made[stage.name] = ArtefactKey(
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
    artefacts are kept, damaged ones are made anew.

    Raises:
        InputError: the log is broken, an option is out of range, or there is no such stage.
        ArtefactError: another command is at work in `work`, or what must be replaced there is not
            ours.
    """
    check_choice("--until", until, [stage.name for stage in STAGES])
    source = Path(options.reading.source).resolve()
    options = replace(options, reading=replace(options.reading, source=str(source)))
    check_places(source, work)
    check_layout(options.reading)
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "the work folder cannot be made",
            where=work,
            got=error.strerror,
            remedy="Choose another --work.",
        ) from error
    with locked(work / LOCK_NAME):
        sweep_partials(work)
        return _build(work, options, progress, until)


def _build(work: Path, options: BuildOptions, progress: Progress, until: str) -> Workspace:
    source_hashes = hash_recording(Path(options.reading.source))
    by_stage = artefact_keys(options, hash_names(source_hashes))
    write_json(work / OPTIONS_NAME, options)
    workspace = Workspace(work, options.reading, source_hashes)
    context = Context(progress, options.seed, options.preset, options.device)
    seen, is_checked = set[str](), False
    stages = _stages_until(options, until)
    for stage in stages:
        artefact_key, folder = by_stage[stage.name], work / stage.name
        state = state_of(folder, artefact_key, is_hashed=True)
        if state == "made":
            logger.info("%-14s kept", stage.name)
            continue
        if stage.name != "log" and not is_checked:
            check_suitable(workspace.recorded_training_log, options, [s.name for s in stages])
            is_checked = True
        logger.info("%-14s %s", stage.name, "is damaged: anew ..." if state == "broken" else "...")
        with workspace.opened((*stage.needs, stage.name)):
            record = make_artefact(
                folder,
                artefact_key,
                lambda partial, stage=stage: stage.make(
                    workspace, stage.config(options), partial, context
                ),
            )
        _log_made(folder, record, seen)
    return workspace


def _log_made(folder: Path, record: Mapping[str, Any], seen: set[str]) -> None:
    """A line of time and memory, and the stage's notes that no earlier stage had."""
    logger.info(
        "%-14s made in %.1f s (peak memory %d MB)",
        folder.name,
        record["seconds"],
        record["peak_memory_mb"],
    )
    for note in unseen_notes(record["notes"], seen):
        logger.info("          note: %s", printed_note(note, str(folder / RECORD_NAME)))


def _stages_until(options: BuildOptions, name: str) -> tuple[Stage, ...]:
    """The table's rows up to one, with it."""
    return stages_of(options)[: [stage.name for stage in STAGES].index(name) + 1]


@dataclass(frozen=True)
class StageStatus:
    """One line of `lightsim status`."""

    name: str
    state: State
    seconds: float | None
    peak_memory_mb: int | None
    damage: tuple[str, ...]


def status(work: Path, *, is_hashed: bool = False) -> list[StageStatus]:
    """State of every artefact against the options that the last build of `work` used, and against
    the recording, where that is still in its place.

    Args:
        is_hashed: read every file and compare its bytes, not only its size.

    Raises:
        ArtefactError: `work` holds no build.
    """
    options = read_options(work)
    by_stage = artefact_keys(options, _source_key(work, Path(options.reading.source)))
    return [
        _status_of(work / name, artefact_key, is_hashed) for name, artefact_key in by_stage.items()
    ]


def _source_key(work: Path, source: Path) -> str:
    """Hash of the recording; where it is gone, of what the build found."""
    if is_folder(source):
        return hash_names(hash_recording(source))
    logger.warning("%s: the recording is gone; changes in it cannot be told", source)
    record = read_record(work / "log")
    return "" if record is None else record["inputs"].get("source", "")


def _status_of(folder: Path, artefact_key: ArtefactKey, is_hashed: bool) -> StageStatus:
    state = state_of(folder, artefact_key)
    try:
        record = read_record(folder)
    except ArtefactError as error:
        return StageStatus(folder.name, state, None, None, (error.what,))
    if record is None:
        return StageStatus(folder.name, state, None, None, ())
    damage = find_damage(folder, record, is_hashed=is_hashed)
    if damage and state == "made":
        state = "broken"
    return StageStatus(folder.name, state, record["seconds"], record["peak_memory_mb"], damage)


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
        value = {field.name: value[field.name] for field in fields(BuildOptions)}
        value["reading"] = reading_from_json(value["reading"])
        return BuildOptions(**{**value, "no_refine": tuple(value["no_refine"])})
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the options of the build are broken", where=path, got=error, remedy="Build again."
        ) from error
