"""Sweeps of a written log: recorded rows and simulated ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.build.workspace import Workspace
from lightsim.core.alignment import PathCorrection
from lightsim.core.casting import RayCaster
from lightsim.core.frames import Trajectory
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.lidar.recorded import (
    RecordedBeams,
    RecordedSweep,
    learn_response,
    sweep_paths,
)
from lightsim.lidar.resimulate import Change, LidarSimulator, SimulatedBeams
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.pandaset_tables import Columns


@dataclass(frozen=True, eq=False)
class WrittenSweep:
    """Sweep to write.

    Args:
        columns: x, y, z, i, t, d, as in PandaSet.
        semantic_class: of each row; -1 unknown.
        is_recorded: rows that equal recorded ones.
    """

    columns: Columns
    semantic_class: Int64[np.ndarray, " n"]
    is_recorded: Bool[np.ndarray, " n"]


class SweepEditor:
    """Editor of the sweeps of a scenario; the LiDARs' response is learnt on first use."""

    def __init__(
        self, workspace: Workspace, recorded: Scenario, scenario: Scenario, progress: Progress
    ) -> None:
        self._workspace, self._progress = workspace, progress
        self._recorded, self._scenario = recorded, scenario
        self.change = Change.between(recorded, scenario)
        paths = sweep_paths(Path(workspace.reading.source))
        self._beams = RecordedBeams(workspace.log, paths)

    def edited(self, lazy: LazySweep) -> WrittenSweep | None:
        """Return the rows of the scenario's sweep; None if it equals the recorded one."""
        found = self._simulated(lazy)
        return None if found is None else written(*found, self._workspace.alignment.path)

    def sweep(self, lazy: LazySweep) -> LidarSweep:
        """Return the sweep of the scenario, frame `world` of the twin."""
        found = self._simulated(lazy)
        return lazy.load() if found is None else joined_sweep(*found)

    def _simulated(self, lazy: LazySweep) -> tuple[RecordedSweep, SimulatedBeams] | None:
        """Return the recorded and the simulated beams; None if no return changes."""
        change = self.change.at(lazy.time_ns)
        if change.is_none:
            return None
        recorded = self._beams.of(lazy)
        # Seeded by the sweep, so that the result does not depend on which sweeps are written.
        rng = np.random.default_rng([self._scenario.seed, lazy.time_ns])
        if change.is_ego_moved:
            assert self._recorded.ego is not None
            assert self._scenario.ego is not None
            times_ns = recorded.beams.times_ns
            # From a changed path every beam meets other surfaces.
            motion = motion_of(self._recorded.ego, self._scenario.ego, times_ns)
            made = self._simulator.whole(
                recorded.beams.moved(motion), self._scenario.placements, lazy.time_ns, rng
            )
        else:
            made = self._simulator.edited(recorded.beams, change, lazy.time_ns, rng)
            # No beam changed, so the recorded file can be copied.
            is_all_kept = (made.is_kept == recorded.beams.is_returned).all()
            if is_all_kept and not made.responses.is_returned.any():
                return None
        return recorded, made

    @cached_property
    def _static(self) -> RayCaster:
        return make_embree_caster([self._workspace.twin.assets.background])

    @cached_property
    def _simulator(self) -> LidarSimulator:
        # Not those of the training log: stored rows include the returns on the ego vehicle.
        log = self._workspace.log
        response = learn_response(
            self._beams,
            [s for s in log.sweeps if s.stem not in self._workspace.held_out],
            self._static,
            self._recorded.placements,
            make_embree_caster,
            self._progress,
        )
        names: Mapping[int, str] = log.semantic_names
        by_name = {name: number for number, name in names.items()}
        return LidarSimulator(self._static, response, by_name, make_embree_caster)


def motion_of(
    recorded: Trajectory, driven: Trajectory, times_ns: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 4 4"]:
    """Return the rigid motion of the world that moves the ego vehicle from its recorded path to
    another."""
    return driven.held_at(times_ns) @ np.linalg.inv(recorded.held_at(times_ns))


def written(
    recorded: RecordedSweep, made: SimulatedBeams, path: PathCorrection | None
) -> WrittenSweep:
    """Return the rows of a simulated sweep, in the recorded world.

    Unchanged returns have the recorded values. A beam with returns both before and now keeps its
    row; others are inserted by time.

    Args:
        path: correction from the recorded world to the twin's.
    """
    rows, beams = recorded.rows, made.beams
    taken = _taken(recorded, made)
    # Recorded rows are copied as numbers; their points here are placeholders.
    is_recorded = made.is_kept[taken]
    points = beams.chosen(taken).at(np.where(is_recorded, 1.0, made.range_m[taken]))
    times_ns = beams.times_ns[taken]
    if path is not None:
        points = path.undone(points, times_ns)
    simulated: Columns = {
        **dict(zip("xyz", points.T, strict=True)),
        "i": made.responses.intensity[taken].astype(np.float64),
        # Rounded to the microsecond, like recorded times.
        "t": np.round(times_ns * 1e-9, 6),
        "d": beams.device[taken],
    }
    columns: Columns = {}
    own = beams.row[taken[is_recorded]]
    for name, values in simulated.items():
        columns[name] = values.astype(np.int64 if name == "d" else np.float64)
        columns[name][is_recorded] = rows[name][own]
    classes = made.responses.semantic_class[taken]
    classes[is_recorded] = recorded.sweep.semantic_class[own]
    return WrittenSweep(columns, classes, is_recorded)


def joined_sweep(recorded: RecordedSweep, made: SimulatedBeams) -> LidarSweep:
    """Return a simulated sweep, frame `world` of the twin; unchanged returns are the recorded ones,
    and simulated ones have no ring."""
    was, beams = recorded.sweep, made.beams
    taken = _taken(recorded, made)
    is_recorded = made.is_kept[taken]
    own = beams.row[taken[is_recorded]]
    some = beams.chosen(taken)
    offset_s = (some.times_ns - was.time_ns) * 1e-9
    values = {
        "points_world": some.at(np.where(is_recorded, 1.0, made.range_m[taken])),
        "origins_world": some.origins_world,
        # Responses are in PandaSet's units, from 0 to 255.
        "intensity": np.clip(made.responses.intensity[taken] / 255.0, 0.0, 1.0),
        "time_offset_s": offset_s,
        "ring": np.full(len(taken), -1),
        "semantic_class": made.responses.semantic_class[taken],
    }
    joined: dict[str, np.ndarray] = {}
    for name, value in values.items():
        recorded_values = getattr(was, name)
        joined[name] = value.astype(recorded_values.dtype)
        joined[name][is_recorded] = recorded_values[own]
    return LidarSweep(was.stem, was.time_ns, **joined)


def _taken(recorded: RecordedSweep, made: SimulatedBeams) -> Int64[np.ndarray, " k"]:
    """Return the beams with a return, in the order of PandaSet's rows."""
    is_made = made.responses.is_returned & np.isfinite(made.range_m)
    taken = np.flatnonzero(made.is_kept | is_made)
    return taken[np.argsort(_positions(recorded, taken), kind="stable")]


def _positions(
    recorded: RecordedSweep, taken: Int64[np.ndarray, " k"]
) -> Float64[np.ndarray, " k"]:
    """Return the positions of beams among the recorded rows.

    PandaSet orders rows by LiDAR, and by time for each LiDAR.
    """
    beams = recorded.beams
    place = beams.row.astype(np.float64)
    for device in np.unique(beams.device).tolist():
        own = np.flatnonzero(beams.is_returned & (beams.device == device))
        new = np.flatnonzero(~beams.is_returned & (beams.device == device))
        # Stored times may be out of order within a LiDAR; their running maximum is sorted.
        until = np.maximum.accumulate(beams.times_ns[own])
        after = np.searchsorted(until, beams.times_ns[new], side="right")
        place[new] = np.append(beams.row[own], beams.row[own].max() + 1)[after] - 0.5
    return place[taken]
