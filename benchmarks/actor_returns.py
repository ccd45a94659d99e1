"""LiDAR returns beside labelled boxes: margins, hold time, and what remains of moving actors.

    python benchmarks/actor_returns.py LOG [--sweeps 8]

LOG: a PandaSet sequence with classes of returns, which were labelled apart from the boxes. Prints
three Markdown tables over evenly distributed sweeps:

1. Returns around boxes, each at its own time, by distance beyond the box: of classes that move
   (MOVES), and of static objects.
2. Returns in boxes of moving actors by time beyond the first or last label, likewise.
3. Returns of classes that move within 1 m of moving actors, and how many of them pass for static:
   with boxes at the sweep's time (margin 0.3 m), and with `is_static`.

Also prints processor time of `is_static` and `actor_labels` for one sweep.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.lidar_returns import actor_labels, is_static
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LidarSweep
from lightsim.datasets.pandaset.tracks import KIND_BY_LABEL
from lightsim.datasets.reader import read_log

_FURNITURE = ("cone", "sign", "barrier", "rolling container")
MOVES = {name for name, kind in KIND_BY_LABEL.items() if kind not in _FURNITURE}
STATIC = {"Building", "Vegetation", "Other Static Object"}
_BEYOND_M = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0)
_BEYOND_S = (0.0, 0.025, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5)
# Returns farther from every box are on no labelled actor, in metres.
_NEAR_M = _BEYOND_M[-1]
# Margin of the test at the sweep's time, in metres.
_OLD_MARGIN_M = 0.3


@dataclass(frozen=True, eq=False)
class _Sweep:
    """One sweep with what its classes tell.

    Args:
        beyond_m: distance beyond the nearest box of moving actors, and of vehicles at rest.
        beyond_s: time beyond the labels of returns inside boxes of moving actors, else NaN.
        is_kept: returns that pass for static by boxes at the sweep's time, and by `is_static`.
    """

    moves: Bool[np.ndarray, " n"]
    static: Bool[np.ndarray, " n"]
    beyond_m: tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]
    beyond_s: Float64[np.ndarray, " n"]
    is_kept: tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]


def _measured(sweep: LidarSweep, actors: Sequence[ActorTrack], names: dict[int, str]) -> _Sweep:
    count, times_ns = len(sweep.points_world), sweep.times_ns
    moving, resting = np.full(count, np.inf), np.full(count, np.inf)
    beyond_s, is_old = np.full(count, np.nan), np.ones(count, dtype=bool)
    for actor in actors:
        if not actor.is_moving and not actor.kind.is_vehicle:
            continue
        path = actor.trajectory
        outside_ns = np.maximum(path.start_ns - times_ns, times_ns - path.end_ns)
        near, out_m = _beyond_box(actor, sweep.points_world, times_ns, outside_ns)
        own = moving if actor.is_moving else resting
        is_now = outside_ns[near] <= 0
        own[near[is_now]] = np.minimum(own[near], out_m)[is_now]
        if actor.is_moving:
            late = near[~is_now & (out_m <= actor.box_margin_m)]
            beyond_s[late] = outside_ns[late] * 1e-9
            if actor.is_present(sweep.time_ns):
                is_old &= ~actor.contains(sweep.points_world, sweep.time_ns, _OLD_MARGIN_M)
    return _Sweep(
        np.isin(sweep.semantic_class, [i for i, name in names.items() if name in MOVES]),
        np.isin(sweep.semantic_class, [i for i, name in names.items() if name in STATIC]),
        (moving, resting),
        beyond_s,
        (is_old, is_static(sweep, actors)),
    )


def _beyond_box(
    actor: ActorTrack,
    points_world: Float[np.ndarray, "n 3"],
    times_ns: Int64[np.ndarray, " n"],
    outside_ns: Int64[np.ndarray, " n"],
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Return the returns near an actor, and their distances beyond its box along an axis."""
    rows = np.flatnonzero(outside_ns < _BEYOND_S[-1] * 1e9)
    places = actor.trajectory.held_positions_m(times_ns[rows])[:, :2]
    reach_m = np.linalg.norm(actor.size_lwh_m) / 2 + _NEAR_M
    rows = rows[(np.abs(points_world[rows, :2] - places) < reach_m).all(axis=1)]
    local = actor.trajectory.to_src(points_world[rows], times_ns[rows])
    return rows, (np.abs(local) - actor.size_lwh_m / 2).max(axis=1)


def _shells(values: Float64[np.ndarray, " n"], edges: Sequence[float]) -> list[int]:
    counts = [int((values <= edges[0]).sum())]
    return counts + [int(((values > a) & (values <= b)).sum()) for a, b in pairwise(edges)]


def _table(title: str, columns: dict[str, list[int]], rows: Sequence[float]) -> str:
    lines = [f"\n| {title} | " + " | ".join(columns) + " |", "|---:" * (1 + len(columns)) + "|"]
    for row, *counts in zip(rows, *columns.values(), strict=True):
        lines.append(f"| {row:g} | " + " | ".join(f"{n:,}" for n in counts) + " |")
    return "\n".join(lines) + "\n"


def _seconds(job: Callable[[], object]) -> float:
    times = []
    for _ in range(5):
        start = time.process_time()
        job()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log")
    parser.add_argument("--sweeps", type=int, default=8)
    options, write = parser.parse_args(), sys.stdout.write
    log = read_log(LogReading(source=options.log))
    chosen = log.sweeps[:: max(1, len(log.sweeps) // options.sweeps)][: options.sweeps]
    parts = [_measured(s.load(), log.actors, dict(log.semantic_names)) for s in chosen]
    moves = np.concatenate([p.moves for p in parts])
    static = np.concatenate([p.static for p in parts])
    moving, resting = (np.concatenate([p.beyond_m[k] for p in parts]) for k in range(2))
    columns: dict[str, list[int]] = {}
    for name, own, other in (("moving", moving, resting), ("at rest", resting, moving)):
        is_alone = other > _NEAR_M
        columns[f"{name}: moves"] = _shells(own[moves & is_alone], _BEYOND_M)
        columns[f"{name}: static"] = _shells(own[static & is_alone], _BEYOND_M)
    write(_table("up to m beyond the box", columns, _BEYOND_M))
    beyond_s = np.concatenate([p.beyond_s for p in parts])
    columns = {
        "moves": _shells(beyond_s[moves], _BEYOND_S),
        "static": _shells(beyond_s[static], _BEYOND_S),
    }
    write(_table("up to s beyond the labels", columns, _BEYOND_S))
    is_own = moves & (moving <= _NEAR_M) & (resting > _NEAR_M)
    old, new = (np.concatenate([p.is_kept[k] for p in parts]) for k in range(2))
    write("\n| near moving actors | at the sweep's time | at their own times |\n|---:|---:|---:|\n")
    write(f"| {is_own.sum():,} | {(is_own & old).sum():,} | {(is_own & new).sum():,} |\n")
    sweep = chosen[0].load()
    write(
        f"\n{len(sweep.points_world):,} returns, {len(log.actors)} actors: "
        f"is_static {_seconds(lambda: is_static(sweep, log.actors)):.3f} s, "
        f"actor_labels {_seconds(lambda: actor_labels(sweep, log.actors)):.3f} s\n"
    )


if __name__ == "__main__":
    main()
