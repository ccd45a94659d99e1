"""Beams of a recording, and the responses of its LiDARs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import ActorPlacement
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.datasets.pandaset.numbered import TABLES, numbered_files
from lightsim.datasets.pandaset.places import SWEEPS
from lightsim.datasets.pandaset.sweeps import read_rows
from lightsim.datasets.safe_pickle import Table
from lightsim.lidar.beams import Beams, in_ego, returned_beams, unreturned_beams
from lightsim.lidar.ray_scene import (
    STATIC,
    RayScene,
    Surfaces,
    is_there,
)
from lightsim.lidar.response import (
    MOST_DONORS,
    BeamResponses,
    Donors,
    Response,
    fitted_planes,
    looks_of,
    nearest,
)
from lightsim.lidar.scan_pattern import (
    ScanDirections,
    find_rings,
    missing_in_raster,
    missing_in_rings,
)
from lightsim.progress import Progress

# Sweeps, evenly distributed over the log, from which the elevations of the rings are estimated.
# Chosen; sensitivity not measured.
_RING_SWEEPS = 8

# Neighbouring sweeps from which the missing directions of a raster are taken. Chosen; sensitivity
# not measured.
_RASTER_SWEEPS = 2
# Distance between a return and the mesh, along the normal, up to which they agree, in metres: more
# than nine tenths of the returns of PandaSet's sequence 002.
_SAME_M = 0.1


def sweep_paths(source: Path) -> Mapping[int, Path]:
    """Return the sweeps' files of a recording in PandaSet's layout, by the number in the frame
    stem."""
    return numbered_files(source / SWEEPS, TABLES).paths


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """Sweep as stored, with all of its beams.

    Args:
        sweep: in the world of the twin.
        rows: the stored columns, row by row with `sweep`.
        beams: the rows' beams in their order, then those without a return.
    """

    sweep: LidarSweep
    rows: Table
    beams: Beams

    @property
    def responses(self) -> BeamResponses:
        """Responses to the beams."""
        count = len(self.beams)
        found = BeamResponses.nothing(count)
        returned = BeamResponses(
            np.ones(len(self.rows["i"]), dtype=bool),
            self.rows["i"].astype(np.float32),
            self.sweep.semantic_class.astype(np.int64),
        )
        found.fill(np.arange(len(self.rows["i"])), returned)
        return found


class RecordedBeams:
    """Reader of the sweeps of one recording with their beams.

    Args:
        log: in the world of the twin.
        paths: files of the sweeps, by the number in the frame stem.
    """

    def __init__(self, log: DrivingLog, paths: Mapping[int, Path]) -> None:
        self._log = log
        self._paths = paths

    def of(self, lazy: LazySweep) -> RecordedSweep:
        """Return a sweep with all beams."""
        sweep, rows, device = self._load(lazy)
        returned = returned_beams(sweep, device)
        parts = [returned]
        for number in np.unique(device).tolist():
            of_device = returned.chosen(device == number)
            missing = self._missing(lazy, number, of_device)
            parts.append(
                unreturned_beams(missing.vectors, missing.times_ns, of_device, self._log.ego)
            )
        return RecordedSweep(sweep, rows, Beams.joined(parts))

    def _load(self, lazy: LazySweep) -> tuple[LidarSweep, Table, Int64[np.ndarray, " n"]]:
        rows, is_good = read_rows(self._paths[int(lazy.stem)])
        rows = {name: column[is_good] for name, column in rows.items()}
        return lazy.load(), rows, rows["d"].astype(np.int64)

    def _missing(self, lazy: LazySweep, device: int, returned: Beams) -> ScanDirections:
        found = ScanDirections.of(in_ego(returned, self._log.ego), returned.times_ns)
        if found.is_spinning:
            return missing_in_rings(found, self._rings.get(device, np.empty(0)))
        near = sorted(self._log.sweeps, key=lambda s: abs(s.time_ns - lazy.time_ns))
        others = [self._directions(s).get(device) for s in near[1 : 1 + _RASTER_SWEEPS]]
        return missing_in_raster(found, [o for o in others if o is not None])

    def _directions(self, lazy: LazySweep, least_m: float = 0.0) -> dict[int, ScanDirections]:
        sweep, _, device = self._load(lazy)
        beams = returned_beams(sweep, device)
        beams = beams.chosen(beams.range_m >= least_m)
        directions = ScanDirections.of(in_ego(beams, self._log.ego), beams.times_ns)
        numbers = np.unique(beams.device).tolist()
        return {number: directions.chosen(beams.device == number) for number in numbers}

    @cached_property
    def _rings(self) -> dict[int, Float64[np.ndarray, " k"]]:
        sweeps = self._log.sweeps
        chosen = sweeps[:: max(1, len(sweeps) // _RING_SWEEPS)]
        found: dict[int, list[ScanDirections]] = {}
        for lazy in chosen:
            # Coordinates in steps of 4 mm make the elevation of returns within 4 m inaccurate.
            for device, directions in self._directions(lazy, least_m=4.0).items():
                found.setdefault(device, []).append(directions)
        return {device: find_rings(several) for device, several in found.items()}


def learn_response(
    beams: RecordedBeams,
    sweeps: Sequence[LazySweep],
    static: RayCaster,
    placements: Sequence[ActorPlacement],
    make_caster: MakeCaster,
    progress: Progress,
) -> Response:
    """Return the responses of the LiDARs in some sweeps of a recording.

    A beam is used if the surface it met is known: the twin agrees with its return, or the beam has
    no return and the twin gives the surface.
    """
    found: dict[tuple[int, str], list[Donors]] = {}
    noise: dict[int, list[float]] = {}
    for number, lazy in enumerate(progress.track(sweeps, "LiDAR response", len(sweeps))):
        recorded = beams.of(lazy)
        for device in np.unique(recorded.beams.device).tolist():
            noise.setdefault(device, []).extend(_noise_m(recorded.beams, device, number))
        step = int(np.ceil(len(recorded.beams) * len(sweeps) / MOST_DONORS))
        rows = np.arange(number % step, len(recorded.beams), step)
        chosen, responses = recorded.beams.chosen(rows), recorded.responses.chosen(rows)
        scene = RayScene(static, placements, lazy.time_ns, make_caster)
        for key, donors in _donors(chosen, responses, scene, placements, lazy.time_ns):
            found.setdefault(key, []).append(donors)
    return Response(
        {key: Donors.joined(several) for key, several in found.items()},
        {p.track.actor_id: p.track.kind for p in placements},
        {device: float(np.median(values)) for device, values in noise.items() if values},
    )


def _donors(
    beams: Beams,
    responses: BeamResponses,
    scene: RayScene,
    placements: Sequence[ActorPlacement],
    time_ns: int,
) -> list[tuple[tuple[int, str], Donors]]:
    met = scene.cast(beams)
    # Beams without a return take their distance from the twin.
    distance = np.where(beams.is_returned, beams.range_m, met.distance_m)
    met = replace(met, distance_m=distance)
    points = beams.at(np.where(np.isfinite(distance), distance, 0.0))
    places = points.copy()
    is_own, is_in_other = np.zeros(len(beams), dtype=bool), np.zeros(len(beams), dtype=bool)
    for number, placement in enumerate(placements):
        track = placement.track
        if not is_there(track, time_ns):
            continue
        inside, local = track.returns_inside(points, beams.times_ns)
        is_met = met.body[inside] == number
        is_own[inside[is_met]] = is_in_other[inside[~is_met]] = True
        places[inside[is_met]] = local[is_met]
    is_static = (met.body == STATIC) & np.isfinite(distance)
    is_known = is_own | (is_static & (~is_in_other | _agrees(beams, scene, met)))
    looks = looks_of(beams, met)
    parts: list[tuple[tuple[int, str], Donors]] = []
    for device in np.unique(beams.device).tolist():
        for body in np.unique(met.body[is_known]).tolist():
            rows = np.flatnonzero(is_known & (met.body == body) & (beams.device == device))
            name = "" if body == STATIC else placements[body].track.actor_id
            donors = Donors(places[rows].astype(np.float32), looks[rows], responses.chosen(rows))
            parts.append(((device, name), donors))
    return parts


def _agrees(beams: Beams, scene: RayScene, met: Surfaces) -> Bool[np.ndarray, " n"]:
    """Return the beams whose return lies on the static surface of the twin."""
    cast = scene.cast_static(beams)
    with np.errstate(invalid="ignore"):
        return np.abs(cast.distance_m - met.distance_m) * cast.cosine < _SAME_M


def _noise_m(beams: Beams, device: int, seed: int) -> tuple[float, ...]:
    """Return the standard deviation of ranges in one sweep, in metres; empty with too few returns.

    It is the deviation of returns from the plane through their eight neighbours in the sweep,
    estimated by the median, which is robust to edges.
    """
    own = beams.chosen(beams.is_returned & (beams.device == device))
    # Nearer returns suffer from the steps of 4 mm, farther ones from sparse neighbours. The numbers
    # here are chosen; sensitivity not measured.
    own = own.chosen((own.range_m > 4.0) & (own.range_m < 40.0))
    if len(own) < 100:
        return ()
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(own), min(len(own), 4000), replace=False)
    points = own.at(own.range_m)
    around = nearest(KDTree(own.directions_world), own.directions_world[rows], 9)[1][:, 1:]
    centre, normal, _ = fitted_planes(
        points[around], np.ones(around.shape), np.zeros((len(rows), 3))
    )
    along = (normal * own.directions_world[rows]).sum(axis=1)
    # At grazing incidence an error of the plane becomes a large error of the range.
    is_met = np.abs(along) > 0.3
    if not is_met.any():
        return ()
    off = ((points[rows] - centre) * normal).sum(axis=1)[is_met] / along[is_met]
    # 1.4826 turns a median deviation into a standard deviation. The plane has noise too: three
    # parameters from eight neighbours.
    scatter = 1.4826 * np.median(np.abs(off)) / np.sqrt(1.0 + 3.0 / 8.0)
    return (float(scatter),)
