"""The build: an ordered table of stages from a log to a twin.

Each stage is a function of the results of earlier stages, and its result is an artefact folder
(store/artefact.py). Stages do not import each other: build/stages passes what one needs from
another (a ray caster, a sky matte, light at vertices).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from lightsim.align.config import AlignConfig
from lightsim.appearance import config as asset_config
from lightsim.build.options import BuildOptions
from lightsim.build.report import ReportConfig
from lightsim.build.source_sun import SourceSunConfig
from lightsim.build.sources import stage_sources
from lightsim.build.stages.alignment import make_alignment
from lightsim.build.stages.assets import make_assets
from lightsim.build.stages.context import Context
from lightsim.build.stages.fields import make_fields
from lightsim.build.stages.geometry import GeometryConfig, make_geometry
from lightsim.build.stages.log import make_log
from lightsim.build.stages.masks import make_held_out_masks, make_masks
from lightsim.build.stages.measures import make_measures
from lightsim.build.stages.neural import make_neural
from lightsim.build.stages.panorama import make_panorama
from lightsim.build.stages.published.assets import make_assets as publish_assets
from lightsim.build.stages.published.fields import make_fields as publish_fields
from lightsim.build.stages.published.geometry import make_geometry as publish_geometry
from lightsim.build.stages.published.sky import DecodedSkyConfig, default_weights
from lightsim.build.stages.published.sky import make_sky as publish_sky
from lightsim.build.stages.published.twin import make_twin as publish_twin
from lightsim.build.stages.report import make_report
from lightsim.build.stages.sky import SkyStageConfig, make_sky
from lightsim.build.stages.twin import TwinConfig, make_twin
from lightsim.build.suitability import check_places, check_suitable
from lightsim.build.workspace import OPTIONS_NAME, Workspace
from lightsim.core.checks import check_choice
from lightsim.core.notes import printed_note, unseen_notes
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.reader import check_layout
from lightsim.errors import ArtefactError, InputError
from lightsim.geometry.completion.table import check_steps
from lightsim.geometry.paper_meshes import BaseMaterials
from lightsim.lighting.panorama.stitch import StitchConfig
from lightsim.lighting.weights import SKY_WEIGHTS, LightingWeights
from lightsim.progress import Progress
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.fusion import config as fuse_config
from lightsim.store.artefact import (
    RECORD_NAME,
    ArtefactKey,
    State,
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
from lightsim.store.source_hash import SourceTree
from lightsim.store.staleness import explain_staleness

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
    """One stage of the build.

    Args:
        name: name of the artefact folder.
        needs: artefacts that the stage reads.
        config: returns the settings of the stage for the options of a build.
        make: fills the folder and returns notes. Its module and all modules it imports are the
            sources of the stage (build/sources.py).
    """

    name: str
    needs: tuple[str, ...]
    config: Callable[[BuildOptions], Any]
    make: Callable[[Workspace, Any, Path, Context], Iterable[str]]


def _asset_config(options: BuildOptions) -> asset_config.AssetConfig:
    config = _ASSETS[options.preset]()
    config = replace(config, has_camera_gains="camera_gains" not in options.no_refine)
    return config if options.colour is None else replace(config, colour=options.colour)


def _neural_config(options: BuildOptions) -> neural_config.NeuralConfig:
    config = replace(_NEURAL[options.preset](), cameras=options.field_cameras)
    if "camera_gains" in options.no_refine:
        config = replace(config, has_camera_gains=False)
    if options.neural_steps is not None:
        config = replace(config, steps=options.neural_steps, steps_a_sweep=None)
    return config


def _stitch_config(options: BuildOptions) -> StitchConfig:
    """Return the settings of the panorama. The preset paper stitches one moment of the log."""
    return StitchConfig(frame_count=1) if options.preset == "paper" else StitchConfig()


def _lighting_of(options: BuildOptions) -> LightingWeights:
    """Return the weights of the lighting networks."""
    shipped = default_weights() if options.preset == "paper" else SKY_WEIGHTS
    return LightingWeights.chosen(options.sky_weights, options.inpaint_weights, shipped)


def _sky_config(options: BuildOptions) -> SkyStageConfig:
    sun, weights = SourceSunConfig(gps=options.gps), _lighting_of(options).content
    return SkyStageConfig(sun, model=options.sky_model or "analytic", weights=weights)


def _decoded_sky_config(options: BuildOptions) -> DecodedSkyConfig:
    return DecodedSkyConfig(gps=options.gps, weights=_lighting_of(options).content)


def _no_settings(_: BuildOptions) -> None:
    """Return no settings: all numbers of the stage are constants of its modules."""


# In the order of execution: a stage may need only stages above it. Held-out mattes are a stage of
# their own, which only measures and the report read, so that no stage that builds the twin depends
# on held-out pictures.
STAGES = (
    # The place of the recording is left out: it may move without making all artefacts stale. Its
    # content enters the key by the hashes of its files.
    Stage("log", (), lambda o: replace(o.reading, source=""), make_log),
    Stage("masks", ("log",), _no_settings, make_masks),
    Stage("held_out_masks", ("log",), _no_settings, make_held_out_masks),
    Stage("alignment", ("log",), lambda o: AlignConfig().without(o.no_refine), make_alignment),
    Stage("fields", ("log", "alignment"), lambda o: _FUSE[o.preset](), make_fields),
    Stage("neural", ("log", "masks", "alignment", "fields"), _neural_config, make_neural),
    Stage(
        "geometry",
        ("log", "masks", "alignment", "neural"),
        lambda o: GeometryConfig(o.no_complete),
        make_geometry,
    ),
    Stage(
        "assets",
        ("log", "masks", "alignment", "fields", "neural", "geometry"),
        _asset_config,
        make_assets,
    ),
    Stage("panorama", ("log", "masks", "alignment", "assets"), _stitch_config, make_panorama),
    Stage("sky", ("log", "alignment", "geometry", "assets", "panorama"), _sky_config, make_sky),
    Stage(
        "twin", ("log", "alignment", "neural", "assets", "sky"), lambda o: TwinConfig(), make_twin
    ),
    Stage(
        "measures",
        ("log", "held_out_masks", "alignment", "assets", "sky"),
        _no_settings,
        make_measures,
    ),
    Stage(
        "report",
        ("log", "masks", "held_out_masks", "alignment", "panorama", "sky", "twin", "measures"),
        # Evaluated when the key is computed, after STAGES exists.
        lambda o: ReportConfig(tuple(s.name for s in STAGES if s.name != "report")),
        make_report,
    ),
)

PUBLISHED = (
    Stage("fields", ("log", "alignment"), lambda o: fuse_config.paper(), publish_fields),
    Stage("geometry", ("log", "alignment", "neural"), lambda o: BaseMaterials(), publish_geometry),
    Stage(
        "assets",
        ("log", "alignment", "fields", "neural", "geometry"),
        _asset_config,
        publish_assets,
    ),
    Stage("sky", ("log", "alignment", "panorama"), _decoded_sky_config, publish_sky),
    Stage("twin", ("log", "alignment", "assets", "sky"), _no_settings, publish_twin),
)
"""Stages of `--preset paper`, in place of those with the same names."""


def stages_of(options: BuildOptions) -> tuple[Stage, ...]:
    """Return the stages of a build, in order."""
    own = {s.name: s for s in PUBLISHED} if options.preset == "paper" else {}
    return tuple(own.get(stage.name, stage) for stage in STAGES)


def artefact_keys(
    options: BuildOptions, source_key: str, tree: SourceTree | None = None
) -> dict[str, ArtefactKey]:
    """Return the key of every stage's artefact; it contains the keys of all artefacts it needs.

    Args:
        options: options of the build.
        source_key: hash of the recording.
        tree: source code of LightSim; by default the installed one.
    """
    made: dict[str, ArtefactKey] = {}
    for stage in stages_of(options):
        # Keys of inputs contain the keys of their own inputs, so that a change in one stage makes
        # every later stage that depends on it stale, and no other.
        inputs = {name: made[name].key for name in stage.needs} or {"source": source_key}
        sources = stage_sources(stage.make, is_first=not stage.needs, tree=tree)
        made[stage.name] = ArtefactKey(
            stage.name, sources, json_ready(_as_mapping(stage, options)), inputs, options.seed
        )
    return made


def _as_mapping(stage: Stage, options: BuildOptions) -> dict[str, Any]:
    config = json_ready(stage.config(options))
    return config if isinstance(config, dict) else {"value": config}


def build(
    work: Path, options: BuildOptions, progress: Progress, until: str = "report"
) -> Workspace:
    """Make missing, stale and damaged artefacts of `work`, in order, up to the stage `until`;
    finished ones are reused.

    Raises:
        InputError: the log is broken, an option is out of range, or there is no such stage.
        ArtefactError: another command is using `work`, or a folder to replace is no artefact of
            LightSim.
    """
    check_choice("--until", until, [stage.name for stage in STAGES])
    check_steps(options.no_complete)
    # Absolute, because later commands on `work` run in other folders.
    source = Path(options.reading.source).resolve()
    options = replace(
        options,
        reading=replace(options.reading, source=str(source)),
        sky_weights=_absolute(options.sky_weights),
        inpaint_weights=_absolute(options.inpaint_weights),
    )
    # Before `work` is made: a wrong SOURCE must leave no empty folder behind.
    check_places(source, work)
    check_layout(options.reading)
    # Imported here, as it needs torch: `lightsim status` imports this module.
    from lightsim.networks.devices import choose_device

    # The field is trained some minutes later: a missing device would waste them.
    choose_device(options.device)
    _lighting_of(options).check()
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "the work folder cannot be created",
            where=work,
            got=error.strerror,
            remedy="Choose another --work.",
        ) from error
    with locked(work / LOCK_NAME):
        # Under the lock, half-written folders belong to interrupted builds only.
        sweep_partials(work)
        return _build(work, options, progress, until)


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()


def _build(work: Path, options: BuildOptions, progress: Progress, until: str) -> Workspace:
    source_hashes = hash_recording(options.reading)
    by_stage = artefact_keys(options, hash_names(source_hashes))
    # Before the first stage, so that `lightsim status` and messages find the options of a build
    # that fails.
    write_json(work / OPTIONS_NAME, options)
    workspace = Workspace(work, options.reading, source_hashes)
    context = Context(
        progress,
        options.seed,
        options.preset,
        options.device,
        options.sky_weights,
        options.inpaint_weights,
    )
    seen, is_checked = set[str](), False
    stages = _stages_until(options, until)
    for stage in stages:
        artefact_key, folder = by_stage[stage.name], work / stage.name
        # Hashed, because stages read what earlier builds wrote, and a damaged file would enter all
        # later artefacts unnoticed.
        state = state_of(folder, artefact_key, is_hashed=True)
        if state == "made":
            logger.info("%-14s kept", stage.name)
            continue
        # Needs the log artefact, and is skipped if nothing has to be made.
        if stage.name != "log" and not is_checked:
            check_suitable(workspace.recorded_training_log, options, [s.name for s in stages])
            is_checked = True
        logger.info("%-14s %s...", stage.name, _why(folder, artefact_key, state))
        # A stage that reads an undeclared artefact fails here: its key would not cover that input.
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


def _why(folder: Path, artefact_key: ArtefactKey, state: State) -> str:
    """Return the reason why an artefact is made again; empty if it is missing."""
    if state == "broken":
        return "is damaged: anew "
    record = read_record(folder) if state == "stale" else None
    if record is None:
        return ""
    return f"{'; '.join(explain_staleness(record, artefact_key))}: anew "


def _log_made(folder: Path, record: Mapping[str, Any], seen: set[str]) -> None:
    """Log time, memory, and the notes that no earlier stage had."""
    logger.info(
        "%-14s made in %.1f s (peak memory %d MB)",
        folder.name,
        record["seconds"],
        record["peak_memory_mb"],
    )
    for note in unseen_notes(record["notes"], seen):
        logger.info("          note: %s", printed_note(note, str(folder / RECORD_NAME)))


def _stages_until(options: BuildOptions, name: str) -> tuple[Stage, ...]:
    """Return the stages up to and including one."""
    return stages_of(options)[: [stage.name for stage in STAGES].index(name) + 1]


def read_options(work: Path) -> BuildOptions:
    """Read the options of the last build of `work`.

    Raises:
        ArtefactError: `work` contains no build, or its options are broken.
    """
    path = work / OPTIONS_NAME
    if not path.is_file():
        raise ArtefactError(
            "the folder contains no build",
            where=work,
            got=f"a folder without {OPTIONS_NAME}" if work.is_dir() else "no such folder",
            remedy="Give a folder that lightsim build SOURCE --work WORK has made.",
        )
    value = read_json(path)
    try:
        # Options that no longer exist are ignored; a missing one is an error, since its default may
        # differ from what that build did.
        value = {field.name: value[field.name] for field in fields(BuildOptions)}
        value["reading"] = reading_from_json(value["reading"])
        names = {key: tuple(value[key]) for key in ("no_refine", "no_complete", "field_cameras")}
        files = {key: value[key] and Path(value[key]) for key in ("sky_weights", "inpaint_weights")}
        return BuildOptions(**{**value, **names, **files})
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the options of the build are damaged", where=path, got=error, remedy="Build again."
        ) from error
