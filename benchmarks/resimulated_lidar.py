"""LiDAR sweeps simulated anew, all of their beams, against the recorded ones.

    python benchmarks/resimulated_lidar.py WORK            sweeps that the build held out, else all
    python benchmarks/resimulated_lidar.py --logs A B      sweeps of two logs in PandaSet's layout,
                                                           such as a written log and its truth
    python benchmarks/resimulated_lidar.py --logs MADE TRUTH --recorded LOG
                                                           only the beams that an edit of LOG truly
                                                           changes, and all others

Of WORK no edit is made and no recorded return is kept; the LiDARs' response is learnt from the
other sweeps. Beams of two logs are matched by direction and LiDAR. With LOG, TRUTH may be a folder
truth/edits/<edit> of a street, which has sweeps alone; a beam is changed where the truth's range is
not the recorded one. Beside what was made stands the recording itself: no edit.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LazySweep
from lightsim.datasets.pandaset.log import SIMULATED_NAME
from lightsim.datasets.reader import read_log
from lightsim.lidar.beams import Beams, in_ego
from lightsim.lidar.recorded import RecordedBeams, learn_response, sweep_paths
from lightsim.lidar.resimulate import LidarSimulator
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.replay import replay
from lightsim.store.artefact import read_json

_SAME_DIRECTION_RAD = np.radians(0.05)
"""Beams of two logs nearer than that are the same: a quarter of a Pandar64's step."""
_OTHER_SURFACE_M = 0.1
"""Ranges of one surface differ by less: four times the noise of two returns, 15 mm each."""
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
    off_m = np.where(both, made, 0.0) - np.where(both, recorded, 0.0)
    error, bias = np.abs(off_m), np.median(off_m[near]) if near.any() else np.nan
    off = np.abs(intensity[1] - intensity[0])[both]
    reproduced, dropped, spurious = (
        part.sum() / max(1, was.sum()) for part in (both, was & ~now, now & ~was)
    )
    median, ninety = np.quantile(error[near], (0.5, 0.9)) if near.any() else (np.nan, np.nan)
    every = np.median(error[both]) if both.any() else np.nan
    middle = np.median(off) if len(off) else np.nan
    return (
        f"| {name} | {was.sum()} | {reproduced:.3f} | {dropped:.3f} "
        f"| {spurious:.3f} | {median:.3f} | {ninety:.3f} | {bias:+.3f} | {every:.3f} "
        f"| {middle:.0f} |"
    )


HEAD = (
    "| LiDAR | returns | reproduced | dropped | spurious | median m | 90 % m | signed median "
    "| median, any range | intensity |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
)


def print_line(line: str) -> None:
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
    print_line(
        f"response learnt in {time.perf_counter() - start:.0f} s, range noise {response.noise_m}"
    )
    simulator = LidarSimulator(static, response, {}, make_embree_caster)
    columns: list[tuple[np.ndarray, ...]] = []
    start = time.perf_counter()
    for lazy in sweeps:
        sweep = recorded.of(lazy)
        made = simulator.whole(
            sweep.beams, placements, lazy.time_ns, np.random.default_rng([0, lazy.time_ns])
        )
        strength = np.stack([sweep.responses.intensity, made.responses.intensity])
        columns.append((sweep.beams.device, sweep.beams.range_m, made.range_m, strength))
    print_line(f"{(time.perf_counter() - start) / len(sweeps):.1f} s a sweep, all beams")
    table(columns)


def table(columns: list[tuple[np.ndarray, ...]]) -> None:
    """Of (device, recorded range, made range, both intensities) of several sweeps."""
    device, was, now, strength = (
        np.concatenate([c[k] for c in columns], axis=-1) for k in range(4)
    )
    print_line(HEAD)
    for number, name in ((0, "spinning"), (1, "ahead")):
        own = device == number
        if own.any():
            print_line(score(name, was[own], now[own], strength[:, own]))


def of_logs(made: Path, truth: Path) -> None:
    """Sweeps of two logs of one drive, by their times."""
    columns: list[tuple[np.ndarray, ...]] = []
    for theirs, ours in pairs([truth, made]):
        for device in sorted({*theirs.devices, *ours.devices}):
            columns.append(beside(device, theirs, ours)[:4])
    table(columns)


def of_edit(made: Path, truth: Path, recorded: Path) -> None:
    """The beams that an edit changes, and all others, apart."""
    with TemporaryDirectory() as folder:
        edited = [
            with_sweeps(recorded, path, Path(folder) / name)
            for name, path in (("truth", truth), ("made", made))
        ]
        found = list(pairs([*edited, recorded]))
    made_of, as_before = [], []
    is_changed: list[np.ndarray] = []
    for theirs, ours, before in found:
        for device in theirs.devices:
            *columns, directions = beside(device, theirs, ours)
            was_m = nearest_to(directions, before.of(device))[0]
            is_changed.append(differ(was_m, columns[1]))
            made_of.append(tuple(columns))
            *columns, directions = beside(device, theirs, before)
            as_before.append((tuple(columns), differ(columns[2], columns[1])))
    for words, wanted in (("changed beams", True), ("all others", False)):
        print_line(f"{words}, made")
        table([chosen(c, k == wanted) for c, k in zip(made_of, is_changed, strict=True)])
    print_line("changed beams, no edit")
    table([chosen(columns, changed) for columns, changed in as_before])


def differ(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Ranges that are of two surfaces."""
    both = np.isfinite(a) & np.isfinite(b)
    apart = np.abs(np.where(both, a, 0.0) - np.where(both, b, 0.0)) > _OTHER_SURFACE_M
    return apart | (np.isfinite(a) != np.isfinite(b))


def chosen(
    columns: tuple[np.ndarray, ...], is_wanted: Bool[np.ndarray, " n"]
) -> tuple[np.ndarray, ...]:
    """Some of the beams."""
    return tuple(c[..., is_wanted] for c in columns)


def with_sweeps(recorded: Path, edited: Path, folder: Path) -> Path:
    """A log of links to a recording, but for its sweeps: the same poses and times tell where beams
    start, also where a written log has few frames, or a truth none."""
    mark = edited / SIMULATED_NAME
    stems: dict[str, str] = {}
    if mark.is_file():
        stems = read_json(mark)["recorded_frames"]
    (folder / "lidar").mkdir(parents=True)
    for path in recorded.iterdir():
        if path.name not in ("lidar", SIMULATED_NAME):
            (folder / path.name).symlink_to(path.resolve())
    for path in (recorded / "lidar").glob("*.json"):
        (folder / "lidar" / path.name).symlink_to(path.resolve())
    for path in sweep_paths(edited).values():
        stem = path.name.partition(".")[0]
        (folder / "lidar" / f"{stems.get(stem, stem)}.pkl.gz").symlink_to(path.resolve())
    return folder


@dataclass(frozen=True, eq=False)
class Returned:
    """Beams of a sweep that came back, their directions in frame `ego`, their intensities."""

    beams: Beams
    directions_ego: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]

    @property
    def devices(self) -> list[int]:
        """The LiDARs' numbers."""
        return np.unique(self.beams.device).tolist()

    def of(self, device: int) -> Returned:
        """What one LiDAR has."""
        own = self.beams.device == device
        return Returned(self.beams.chosen(own), self.directions_ego[own], self.intensity[own])


def pairs(paths: list[Path]) -> Iterator[list[Returned]]:
    """The returns of sweeps that several logs of one drive have, by their times."""
    logs = [read_log(LogReading(source=str(path))) for path in paths]
    by_time = [{sweep.time_ns: sweep for sweep in log.sweeps} for log in logs]
    for time_ns in sorted(set.intersection(*(set(sweeps) for sweeps in by_time))):
        yield [
            returned_of(log, path, sweeps[time_ns])
            for log, path, sweeps in zip(logs, paths, by_time, strict=True)
        ]


def returned_of(log: DrivingLog, path: Path, lazy: LazySweep) -> Returned:
    """The returns of a sweep."""
    sweep = RecordedBeams(log, sweep_paths(path)).of(lazy)
    is_returned: Bool[np.ndarray, " n"] = sweep.beams.is_returned
    beams = sweep.beams.chosen(is_returned)
    return Returned(beams, in_ego(beams, log.ego), sweep.responses.intensity[is_returned])


def beside(device: int, theirs: Returned, ours: Returned) -> tuple[np.ndarray, ...]:
    """Beams of the truth beside the nearest of ours, then those that only ours has: LiDAR, true
    range, ours, both intensities; and their directions."""
    a, b = ours.of(device), theirs.of(device)
    now_m, now_strength = nearest_to(b.directions_ego, a)
    alone = np.isinf(nearest_to(a.directions_ego, b)[0])
    was_m = np.concatenate([b.beams.range_m, np.full(alone.sum(), np.inf)])
    now_m = np.concatenate([now_m, a.beams.range_m[alone]])
    strength = np.stack(
        [
            np.concatenate([b.intensity, np.zeros(alone.sum())]),
            np.concatenate([now_strength, a.intensity[alone]]),
        ]
    )
    directions = np.concatenate([b.directions_ego, a.directions_ego[alone]])
    return np.full(len(was_m), device), was_m, now_m, strength, directions


def nearest_to(
    directions_ego: Float[np.ndarray, "n 3"], found: Returned
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Ranges and intensities along directions; inf where nothing came back."""
    # Without one that near, the number is that of one beyond the last.
    tree = KDTree(found.directions_ego)
    near = tree.query(directions_ego, distance_upper_bound=_SAME_DIRECTION_RAD)[1]
    return np.append(found.beams.range_m, np.inf)[near], np.append(found.intensity, 0.0)[near]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("work", type=Path, nargs="?")
    parser.add_argument("--logs", type=Path, nargs=2, metavar=("MADE", "TRUTH"))
    parser.add_argument("--recorded", type=Path, metavar="LOG")
    asked = parser.parse_args()
    if asked.logs and asked.recorded:
        made, truth = asked.logs
        of_edit(made, truth, asked.recorded)
    elif asked.logs:
        of_logs(*asked.logs)
    else:
        of_work(asked.work)
