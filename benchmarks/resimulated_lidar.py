"""LiDAR sweeps simulated anew, all of their beams, against the recorded ones.

    python benchmarks/resimulated_lidar.py WORK            sweeps that the build held out, else all
    python benchmarks/resimulated_lidar.py --logs A B      sweeps of two logs in PandaSet's layout,
                                                           such as a written log and its truth

Of WORK no edit is made and no recorded return is kept; the LiDARs' response is learnt from the
other sweeps. Beams of two logs are matched by direction and LiDAR.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LazySweep
from lightsim.datasets.reader import read_log
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.replay import replay
from lightsim.simulation.lidar.beams import Beams, in_ego
from lightsim.simulation.lidar.recorded import RecordedBeams, learn_response, sweep_paths
from lightsim.simulation.lidar.resimulate import LidarSimulator

_SAME_DIRECTION_RAD = np.radians(0.05)
"""Beams of two logs nearer than that are the same: a quarter of a Pandar64's step."""
_REACH_M = (3.0, 80.0)
"""As `lightsim evaluate geometry` compares: nearer is the ego vehicle."""


def score(
    name: str,
    recorded: Float[np.ndarray, " n"],
    made: Float[np.ndarray, " n"],
    intensity: Float[np.ndarray, "2 n"],
) -> str:
    """A row of the table, of beams' ranges (inf: no return) and intensities recorded and made."""
    was, now = np.isfinite(recorded), np.isfinite(made)
    both = was & now
    near = both & (recorded > _REACH_M[0]) & (recorded < _REACH_M[1])
    error = np.abs(np.where(both, made, 0.0) - np.where(both, recorded, 0.0))
    off = np.abs(intensity[1] - intensity[0])[both]
    reproduced, dropped, spurious = (
        part.sum() / max(1, was.sum()) for part in (both, was & ~now, now & ~was)
    )
    median, ninety = np.quantile(error[near], (0.5, 0.9)) if near.any() else (np.nan, np.nan)
    every = np.median(error[both]) if both.any() else np.nan
    middle = np.median(off) if len(off) else np.nan
    return (
        f"| {name} | {was.sum()} | {reproduced:.3f} | {dropped:.3f} "
        f"| {spurious:.3f} | {median:.3f} | {ninety:.3f} | {every:.3f} | {middle:.0f} |"
    )


HEAD = (
    "| LiDAR | returns | reproduced | dropped | spurious | median m | 90 % m | median, any range "
    "| intensity |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|"
)


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")


def of_work(work: Path) -> None:
    """Held-out sweeps of a build."""
    workspace = Workspace(work, is_stale_allowed=True)
    twin, held = workspace.twin, workspace.held_out
    sweeps = [s for s in twin.log.sweeps if s.stem in held] or list(twin.log.sweeps)
    learnt = [s for s in twin.log.sweeps if s.stem not in held]
    placements = replay(twin, "lidar", twin.log.frames).placements
    static = make_embree_caster([twin.assets.background])
    recorded = RecordedBeams(twin.log, sweep_paths(Path(workspace.reading.source)))
    start = time.perf_counter()
    response = learn_response(
        recorded, learnt, static, placements, make_embree_caster, SilentProgress()
    )
    say(f"response learnt in {time.perf_counter() - start:.0f} s, range noise {response.noise_m}")
    simulator = LidarSimulator(static, response, {}, make_embree_caster)
    columns: list[tuple[np.ndarray, ...]] = []
    start = time.perf_counter()
    for lazy in sweeps:
        sweep = recorded.of(lazy)
        made = simulator.whole(
            sweep.beams, placements, lazy.time_ns, np.random.default_rng([0, lazy.time_ns])
        )
        strength = np.stack([sweep.answers.intensity, made.answers.intensity])
        columns.append((sweep.beams.device, sweep.beams.range_m, made.range_m, strength))
    say(f"{(time.perf_counter() - start) / len(sweeps):.1f} s a sweep, all beams")
    table(columns)


def table(columns: list[tuple[np.ndarray, ...]]) -> None:
    """Of (device, recorded range, made range, both intensities) of several sweeps."""
    device, was, now, strength = (
        np.concatenate([c[k] for c in columns], axis=-1) for k in range(4)
    )
    say(HEAD)
    for number, name in ((0, "spinning"), (1, "ahead")):
        own = device == number
        if own.any():
            say(score(name, was[own], now[own], strength[:, own]))


def of_logs(made: Path, truth: Path) -> None:
    """Sweeps of two logs of one drive, by their times."""
    logs = [read_log(LogReading(source=str(path))) for path in (made, truth)]
    by_time = {s.time_ns: s for s in logs[1].sweeps}
    columns: list[tuple[np.ndarray, ...]] = []
    for lazy in logs[0].sweeps:
        other = by_time.get(lazy.time_ns)
        if other is None:
            continue
        ours, theirs = returned_of(logs[0], made, lazy), returned_of(logs[1], truth, other)
        for device in np.union1d(ours[0].device, theirs[0].device).tolist():
            columns.append(matched(device, logs, ours, theirs))
    table(columns)


Returned = tuple[Beams, Float[np.ndarray, " n"]]
"""Beams that came back, and their intensities."""


def returned_of(log: DrivingLog, path: Path, lazy: LazySweep) -> Returned:
    """The returns of a sweep and their intensities."""
    sweep = RecordedBeams(log, sweep_paths(path)).of(lazy)
    is_returned: Bool[np.ndarray, " n"] = sweep.beams.is_returned
    return sweep.beams.chosen(is_returned), sweep.answers.intensity[is_returned]


def matched(
    device: int, logs: list[DrivingLog], ours: Returned, theirs: Returned
) -> tuple[np.ndarray, ...]:
    """Beams of the truth beside the nearest of ours, then those that only ours has."""
    (a, a_strength), (b, b_strength) = (
        (beams.chosen(beams.device == device), strength[beams.device == device])
        for beams, strength in (ours, theirs)
    )
    a_ego, b_ego = in_ego(a, logs[0].ego), in_ego(b, logs[1].ego)
    # Without one that near, the number is that of one beyond the last.
    near = KDTree(a_ego).query(b_ego, distance_upper_bound=_SAME_DIRECTION_RAD)[1]
    alone = np.isinf(KDTree(b_ego).query(a_ego, distance_upper_bound=_SAME_DIRECTION_RAD)[0])
    none = np.zeros(alone.sum())
    was = np.concatenate([b.range_m, none + np.inf])
    now = np.concatenate([np.append(a.range_m, np.inf)[near], a.range_m[alone]])
    seen = np.append(a_strength, 0.0)[near]
    strength = np.stack(
        [np.concatenate([b_strength, none]), np.concatenate([seen, a_strength[alone]])]
    )
    return np.full(len(was), device), was, now, strength


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("work", type=Path, nargs="?")
    parser.add_argument("--logs", type=Path, nargs=2, metavar=("MADE", "TRUTH"))
    asked = parser.parse_args()
    if asked.logs:
        of_logs(*asked.logs)
    else:
        of_work(asked.work)
