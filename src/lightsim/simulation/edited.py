"""`lightsim simulate`: frames of the log with edits, under any sky."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lightsim.build.workspace import Workspace
from lightsim.core.actors import ActorTrack
from lightsim.core.scenario import Scenario
from lightsim.errors import InputError
from lightsim.export.pandaset.log import LogWriter, log_folders, write_logs
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.apply import apply_edits, driven_beside
from lightsim.scenario.asset_library import AssetLibrary, default_folder
from lightsim.scenario.conflicts import Conflict, ConflictSearch
from lightsim.scenario.edits import Insert, ScenarioRequest, read_scenario_request
from lightsim.scenario.ground import StandingGround
from lightsim.scenario.shipped_assets import shipped_assets
from lightsim.simulation.claims import opened_for
from lightsim.simulation.options import SimulateOptions
from lightsim.simulation.relight import make_frames, replayed
from lightsim.simulation.relighter import RelightConfig

_LOGGER = logging.getLogger(__name__)


def simulate(work: Path, request: Path, options: SimulateOptions, progress: Progress) -> list[Path]:
    """Make the frames of SCENARIO.json from the twin of a work folder.

    Returns:
        WORK/scenarios/NAME for one sky; for several WORK/scenarios/NAME/<sky> of each, in order.

    Raises:
        ArtefactError: as `relight`.
        InputError: as `relight`; or the scenario is wrong: an unknown actor or asset, a trajectory
            outside the log's time; with `strict`, actors that overlap, intersect walls or are off
            the ground; or the log cannot be written to the given folder.
    """
    scenario_request = read_scenario_request(request)
    options = options.completed(scenario_request.name, scenario_request.sky)
    with opened_for(work, options) as workspace:
        recorded = scenario = replayed(workspace, options)
        logs: Mapping[str, Path] = {}
        # The target folders are checked before the frames are made, which may take hours.
        if options.write_log is not None:
            logs = log_folders(workspace, recorded, options.write_log, tuple(options.sky_by_name))
        if scenario_request.edits or options.ego_offset:
            library = asset_library(options.library, request.parent)
            scenario = edited_scenario(workspace, recorded, scenario_request, library)
            report_conflicts(scenario.notes, scenario_request.source, strict=options.strict)
            # The offset applies to the ego path after its edits.
            if options.ego_offset is not None:
                scenario = driven_beside(scenario, options.ego_offset)
            made_of = _made_of(scenario_request, library, options)
            config = RelightConfig(exposure_s=options.exposure_time_ms / 1e3)
            folders = make_frames(
                workspace, scenario, options, progress, recorded, made_of, config, __name__
            )
        else:
            folders = make_frames(workspace, recorded, options, progress)
        if logs:
            writer = LogWriter(workspace, recorded, scenario, progress)
            write_logs(writer, logs, folders, is_overwriting=options.overwrite)
        return folders


def _made_of(
    scenario_request: ScenarioRequest, library: AssetLibrary, options: SimulateOptions
) -> dict[str, Any]:
    """Return the settings that determine edited frames besides the options of all frames."""
    made_of: dict[str, Any] = {
        "edits": scenario_request.spelt,
        "exposure_time_ms": options.exposure_time_ms,
    }
    named = sorted({edit.asset for edit in scenario_request.edits if isinstance(edit, Insert)})
    if named:
        # The key contains the assets' content, not their names: changed assets make frames stale.
        made_of["assets"] = {words: library.key(words) for words in named}
    return made_of


def asset_library(folder: Path | None, beside: Path = Path()) -> AssetLibrary:
    """Return the library of a folder (by default the user's) with the assets of the package.

    Args:
        folder: of the library; None for the user's.
        beside: folder to which relative paths of assets refer.
    """
    return AssetLibrary(folder or default_folder(), shipped_assets(), beside)


def edited_scenario(
    workspace: Workspace,
    recorded: Scenario,
    scenario_request: ScenarioRequest,
    library: AssetLibrary,
) -> Scenario:
    """Return the replayed log with the edits of SCENARIO.json; conflicts are listed in its notes.

    Raises:
        InputError: an unknown actor or asset, or a trajectory outside the log's time.
    """
    search = ConflictSearch(recorded.frames, standing_ground(workspace))
    return edited_with_conflicts(workspace, recorded, scenario_request, library, search)[0]


def edited_with_conflicts(
    workspace: Workspace,
    recorded: Scenario,
    scenario_request: ScenarioRequest,
    library: AssetLibrary,
    search: ConflictSearch,
) -> tuple[Scenario, tuple[Conflict, ...]]:
    """Return the scenario of `edited_scenario`, and its conflicts.

    Args:
        search: conflict search at the frames of `recorded`, with the ground below the actors; made
            once for many edits of one log.

    Raises:
        InputError: as `edited_scenario`.
    """
    scenario = apply_edits(
        recorded, scenario_request.edits, library.load, search.ground, workspace.log
    )
    conflicts = search.find(scenario, edited_tracks(recorded, scenario))
    return replace(
        scenario, edits=scenario_request.spelt, notes=tuple(map(str, conflicts))
    ), conflicts


def standing_ground(workspace: Workspace) -> StandingGround:
    """Return the ground of a twin with a caster over its static meshes."""
    background = make_embree_caster([workspace.twin.assets.background])
    return StandingGround(workspace.fields.ground, background)


def edited_tracks(recorded: Scenario, scenario: Scenario) -> list[ActorTrack]:
    """Return the tracks that edits have inserted or moved."""
    # Edits replace the tracks that they change and retain the other objects.
    before = {id(track) for track in recorded.tracks}
    return [track for track in scenario.tracks if id(track) not in before]


def report_conflicts(conflicts: Sequence[str], source: Path, *, strict: bool = False) -> None:
    """Log a warning for every conflict.

    Raises:
        InputError: there is a conflict, and `strict` is set.
    """
    if conflicts and strict:
        raise InputError(
            "the scenario is not possible",
            where=source,
            got="; ".join(conflicts),
            remedy="Correct it, or omit --strict to simulate it nevertheless.",
        )
    for conflict in conflicts:
        _LOGGER.warning("%s: %s", source, conflict)
