"""Calibration of the evidence of views: what views show at places that beams say are occupied or
free.

    python benchmarks/view_evidence.py WORK ...

Occupied: LiDAR returns from static surfaces (of held-out sweeps, if there are some). Free: places
on the same beams, at least 1 m before their ends. Per distance from the camera: fractions of views
that show sky and a surface that the mesh does not explain, where no surface of the mesh hides the
place; the log-odds of one view; how often a second view of a place shows the same; and how far from
the returns the mesh lies.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.lidar_returns import is_static
from lightsim.geometry.completion.view_evidence import (
    DEPTH_TOLERANCE_M,
    WALL_VIEW_M,
    ViewEvidence,
)
from lightsim.render.casters.embree import make_embree_caster

_RANGES_M = (0.0, 15.0, 30.0, 60.0, WALL_VIEW_M)
_BEAMS = 4000
"""Beams of each sweep, at most."""
_HIGH_M = 1.0
"""Places lower than this above the sensor's path are left out: no view shows sky there."""
_BEFORE_M = 1.0


@dataclass
class _Places:
    """Places, and how many views showed each as sky, as unexplained surface, and at all, by
    distance."""

    points: np.ndarray
    sky: np.ndarray
    matter: np.ndarray
    views: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> _Places:
        none = np.zeros((len(_RANGES_M) - 1, len(points)), np.int64)
        return _Places(points, none, none.copy(), none.copy())


def main() -> int:
    parser = argparse.ArgumentParser(description="calibration of the evidence of views")
    parser.add_argument("works", type=Path, nargs="+")
    for folder in parser.parse_args().works:
        work = Workspace(folder)
        occupied, free = (_Places.of(points) for points in _beams(work))
        beyond = _count(work, occupied, free)
        sys.stdout.write(f"\n{folder}\n\n{_table(occupied, free)}\n{_depths(beyond)}")
    return 0


def _beams(work: Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Ends of beams on static surfaces, and places on the beams before them."""
    rng, log = np.random.default_rng(0), work.log
    used = {sweep.time_ns for sweep in work.training_log.sweeps}
    held = [sweep for sweep in log.sweeps if sweep.time_ns not in used]
    ends, before = [], []
    for lazy in held or log.sweeps:
        sweep = lazy.load()
        rows = np.flatnonzero(is_static(sweep, log.actors))
        rows = rng.choice(rows, min(_BEAMS, len(rows)), replace=False)
        start, end = (a[rows].astype(np.float64) for a in (sweep.origins_world, sweep.points_world))
        way = end - start
        length = np.linalg.norm(way, axis=1)
        part = rng.uniform(0.0, 1.0, len(rows)) * np.maximum(length - _BEFORE_M, 0.0)
        place = start + way * (part / np.maximum(length, 1e-9))[:, None]
        ends.append(end[end[:, 2] > start[:, 2] + _HIGH_M])
        before.append(place[place[:, 2] > start[:, 2] + _HIGH_M])
    return np.concatenate(ends), np.concatenate(before)


def _count(work: Workspace, occupied: _Places, free: _Places) -> np.ndarray:
    """Count what views show; return how far behind the returns the mesh lies, in metres."""
    log = work.training_log
    evidence = ViewEvidence(
        (f, log.cameras[f.camera_name], partial(work.sky_matte, f)) for f in log.frames
    )
    caster = make_embree_caster([work.assets.background])
    beyond: list[np.ndarray] = []
    for view in evidence.views():
        classes = view.classes
        for places in (occupied, free):
            sightlines = view.sightlines(places.points, WALL_VIEW_M)
            behind_m = sightlines.beyond_m(caster)
            if places is occupied:
                beyond.append(behind_m)
            shown = sightlines.select(behind_m > -DEPTH_TOLERANCE_M)
            behind_m = behind_m[behind_m > -DEPTH_TOLERANCE_M]
            kind = classes[shown.pixel]
            is_matter = (kind < 0) & ((np.abs(behind_m) < DEPTH_TOLERANCE_M) | np.isinf(behind_m))
            at = np.digitize(shown.distance_m, _RANGES_M) - 1, shown.row
            places.views[at] += 1
            places.sky[at] += kind > 0
            places.matter[at] += is_matter
    return np.concatenate(beyond)


def _table(occupied: _Places, free: _Places) -> str:
    rows = [
        "| distance m | views | sky, occupied | sky, free | surface, occupied | surface, free |"
    ]
    rows[0] += " odds of sky | odds of surface | second view, sky | second view, surface |"
    rows.append("|---|" + "---:|" * 9)
    for k in range(len(_RANGES_M) - 1):
        fractions = [
            getattr(places, name)[k].sum() / max(places.views[k].sum(), 1)
            for name in ("sky", "matter")
            for places in (occupied, free)
        ]
        odds = [np.log((a + 1e-4) / (b + 1e-4)) for a, b in (fractions[:2], fractions[2:])]
        second = [_second(getattr(occupied, n)[k], occupied.views[k]) for n in ("sky", "matter")]
        figures = [*(f"{100 * f:.2f} %" for f in fractions), *(f"{o:.1f}" for o in odds)]
        figures += [f"{100 * s:.0f} %" for s in second]
        name = f"{_RANGES_M[k]:.0f} to {_RANGES_M[k + 1]:.0f}"
        total = int(occupied.views[k].sum() + free.views[k].sum())
        rows.append(f"| {name} | {total} | {' | '.join(figures)} |")
    return "\n".join(rows) + "\n"


def _second(shown: np.ndarray, views: np.ndarray) -> float:
    """Fraction of second views that show the same as a first one that shows it."""
    pairs = (shown * (views - 1)).sum()
    return float((shown * (shown - 1)).sum() / max(pairs, 1))


def _depths(beyond_m: np.ndarray) -> str:
    found = np.abs(beyond_m[np.isfinite(beyond_m)])
    quantiles = " | ".join(f"{q:.2f}" for q in np.percentile(found, (50, 80, 90, 95)))
    return f"Mesh beside returns, m, 50, 80, 90 and 95 %: {quantiles}\n"


if __name__ == "__main__":
    sys.exit(main())
