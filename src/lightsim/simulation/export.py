"""`lightsim export` of a finished scenario in the formats of data sets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.sources import simulation_sources
from lightsim.core.kept_sweeps import KeptSweeps
from lightsim.core.log import GeoReference
from lightsim.core.sensors import LazySweep
from lightsim.core.solar import azimuth_elevation
from lightsim.datasets.reader import check_layout
from lightsim.errors import InputError
from lightsim.export.coco.log import write_coco
from lightsim.export.kitti.log import write_kitti
from lightsim.export.lightsim.log import fill_folder, picture_name
from lightsim.export.nuscenes.log import write_nuscenes
from lightsim.export.pandaset.log import LogWriter
from lightsim.export.pandaset.sweeps import SweepEditor
from lightsim.export.place import check_export, check_place
from lightsim.export.provenance import Written, write_provenance
from lightsim.export.scenario_log import ScenarioLog
from lightsim.lidar.resimulate import Change
from lightsim.progress import Progress
from lightsim.simulation.finished import FinishedScenario, ScenarioPlace, opened_scenario
from lightsim.simulation.frame_files import picture_path
from lightsim.simulation.options import ExportOptions
from lightsim.store.artefact import ArtefactKey, make_artefact
from lightsim.store.images import read_srgb8

_STAGE = "export"
_UNSEEN = (
    "LiDAR sweeps are the recorded ones, without the edits: they are simulated for PandaSet only."
)


def export_scenario(
    where: ScenarioPlace, out: Path, options: ExportOptions, progress: Progress
) -> Path:
    """Write a finished scenario in the format of a data set; return the folder.

    An interrupted export continues with the same command. A complete one is not made again.

    Raises:
        InputError: the format does not fit the recording, an option is wrong, or the folder has
            other files.
        ArtefactError: the scenario is damaged, or the twin or the recording has changed since.
    """
    out = out.resolve()
    with opened_scenario(where, options.library, allow_stale=options.allow_stale) as finished:
        source = Path(finished.workspace.reading.source)
        check_place(out, (source, where.work / "scenarios"), "--out")
        key = ArtefactKey(
            _STAGE,
            simulation_sources(__name__),
            {"format": options.format, "camera": options.camera},
            {"frames": finished.key},
            finished.scenario.seed,
        )
        check_export(out, key, "--out")
        if options.format == "pandaset":
            _require_pandaset(finished)
        log = scenario_log(finished, progress)
        build = partial(_write, log=log, finished=finished, options=options, progress=progress)
        make_artefact(out, key, build)
    return out


def _write(
    folder: Path,
    log: ScenarioLog,
    finished: FinishedScenario,
    options: ExportOptions,
    progress: Progress,
) -> Iterable[str]:
    """Fill the folder of an export."""
    if options.format == "nuscenes":
        written = write_nuscenes(log, folder, progress)
    elif options.format == "kitti":
        written = write_kitti(log, folder, progress, options.camera)
    elif options.format == "coco":
        written = write_coco(log, folder, progress)
    elif options.format == "lightsim":
        written = _write_lightsim(log, folder, progress)
    else:
        written = _write_pandaset(log, finished, folder, progress)
    write_provenance(folder, log, written, options.format)
    return log.notes


def _write_pandaset(
    log: ScenarioLog, finished: FinishedScenario, folder: Path, progress: Progress
) -> Written:
    """Write the log as `lightsim simulate --write-log` does."""
    writer = LogWriter(finished.workspace, finished.recorded, finished.scenario, progress)
    writer.write(folder)
    writer.write_pictures(folder, finished.folder)
    writer.write_mark(folder, {"sky": log.sky.get("sky"), "frames_key": log.key})
    usage = ("PandaSet's devkit and `lightsim build` load it.",)
    return Written(writer.picture_files, {}, usage)


def _write_lightsim(log: ScenarioLog, folder: Path, progress: Progress) -> Written:
    fill_folder(log.log, folder, progress)
    pictures = [(picture_name(frame), frame) for frame in log.log.frames]
    return Written(pictures, {}, ("`lightsim build` loads it (docs/reference/lightsim-log.md).",))


def _require_pandaset(finished: FinishedScenario) -> None:
    layout = check_layout(finished.workspace.reading)
    if layout != "pandaset":
        raise InputError(
            "only recordings of PandaSet can be written in its format",
            where="--format pandaset",
            got=f"a recording of {layout}",
            expected="--format nuscenes, kitti, coco or lightsim",
        )


def scenario_log(finished: FinishedScenario, progress: Progress) -> ScenarioLog:
    """Return the log of a finished scenario."""
    scenario, recorded = finished.scenario, finished.recorded
    log = finished.log
    sweeps, simulated, notes = _sweeps(finished, progress)
    made = replace(
        log,
        name=scenario.name,
        cameras=dict(scenario.cameras),
        frames=tuple(
            replace(f, load_srgb8=partial(read_srgb8, picture_path(finished.folder, f)))
            for f in scenario.frames
        ),
        sweeps=sweeps,
        ego=log.ego if scenario.ego is None else scenario.ego,
        actors=tuple(t for t in scenario.tracks if t.actor_id not in scenario.removed),
        # Masks of the ego vehicle are not valid in pictures from another path.
        geo=_with_sun(log.geo, finished.written),
        ego_vehicle_masks=log.ego_vehicle_masks if scenario.ego is recorded.ego else {},
    )
    written = finished.written
    names = ("sky", "sky_yaw_deg", "sky_scale", "move_sun", "sun_factor", "target_sky")
    return ScenarioLog(
        made,
        finished.labels,
        partial(picture_path, finished.folder),
        {(f.camera_name, f.stem): f.source for f in scenario.frames},
        simulated,
        {name: written.get(name) for name in names},
        tuple(written["edits"]),
        log.name,
        finished.key,
        (*scenario.notes, *notes),
    )


def _sweeps(
    finished: FinishedScenario, progress: Progress
) -> tuple[tuple[LazySweep, ...], frozenset[str], tuple[str, ...]]:
    """Return the sweeps of the chosen frames and those between them, the stems of simulated ones,
    and notes."""
    scenario, log = finished.scenario, finished.log
    stems, every = {f.stem for f in scenario.frames}, set(log.stems)
    times_ns = [f.time_ns for f in scenario.frames]
    chosen = [
        sweep
        for sweep in log.sweeps
        if sweep.stem in stems
        # A sweep between frames has a separate stem.
        or (sweep.stem not in every and min(times_ns) <= sweep.time_ns <= max(times_ns))
    ]
    change = Change.between(finished.recorded, scenario)
    changed = frozenset(s.stem for s in chosen if not change.at(s.time_ns).is_none)
    if changed and check_layout(finished.workspace.reading) != "pandaset":
        return tuple(chosen), frozenset(), (_UNSEEN,)
    editor = SweepEditor(finished.workspace, finished.recorded, scenario, progress)
    made = (
        replace(sweep, load=partial(editor.sweep, sweep)) if sweep.stem in changed else sweep
        for sweep in chosen
    )
    # Formats read a sweep several times, and simulating it takes long.
    return KeptSweeps().of(tuple(made)), changed, ()


def _with_sun(geo: GeoReference | None, written: Mapping[str, Any]) -> GeoReference | None:
    """Return place and time with the sun of the target sky, where it and north are known."""
    direction = (written.get("target_sky") or {}).get("sun_direction_world")
    if geo is None or geo.enu_from_world is None or direction is None:
        return geo
    direction_enu = geo.enu_from_world.rotate(np.array([direction], dtype=np.float64))[0]
    return replace(geo, given_sun=azimuth_elevation(direction_enu))
