"""Sweeps of an edited log: recorded returns of unchanged beams, simulated ones of all others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.datasets.pandaset.tracks import label_of
from lightsim.lidar.beams import Beams
from lightsim.lidar.ray_scene import (
    NOTHING,
    STATIC,
    RayScene,
    Surfaces,
    is_there,
)
from lightsim.lidar.response import BeamResponses, Response, looks_of

# Distance along a beam, in metres, up to which a return belongs to the static scene behind a
# removed actor. Chosen; sensitivity not measured.
_SAME_M = 0.3


@dataclass(frozen=True, eq=False)
class Change:
    """Difference between a recorded and an edited log that is relevant for LiDAR beams.

    Args:
        kept: actors with unchanged poses.
        removed: tracks of actors that are absent or elsewhere in the edited log.
        removed_shapes: such actors that have a mesh.
        new: actors that are absent or elsewhere in the recorded log.
        is_ego_moved: the LiDARs themselves have other poses.
    """

    kept: tuple[ActorPlacement, ...]
    removed: tuple[ActorTrack, ...]
    removed_shapes: tuple[ActorPlacement, ...]
    new: tuple[ActorPlacement, ...]
    is_ego_moved: bool = False

    @classmethod
    def between(cls, recorded: Scenario, scenario: Scenario) -> Change:
        """Return the change from a recorded log to a scenario that edits made from it.

        Objects that no edit touches are identical in both.
        """
        # By identity, since comparing tracks and meshes by value is slow.
        before = {id(p) for p in recorded.placements}
        after = {id(p) for p in scenario.placements}
        left = {id(t) for t in scenario.tracks if t.actor_id not in scenario.removed}
        return cls(
            tuple(p for p in scenario.placements if id(p) in before),
            tuple(t for t in recorded.tracks if id(t) not in left),
            tuple(p for p in recorded.placements if id(p) not in after),
            tuple(p for p in scenario.placements if id(p) not in before),
            scenario.ego is not recorded.ego,
        )

    def at(self, time_ns: int) -> Change:
        """Return the part of the change that concerns a sweep."""
        return Change(
            self.kept,
            tuple(t for t in self.removed if is_there(t, time_ns)),
            tuple(p for p in self.removed_shapes if is_there(p.track, time_ns)),
            tuple(p for p in self.new if is_there(p.track, time_ns)),
            self.is_ego_moved,
        )

    @property
    def is_none(self) -> bool:
        """True if no beam is affected."""
        return not (self.removed or self.new or self.is_ego_moved)


@dataclass(frozen=True, eq=False)
class SimulatedBeams:
    """Beams of a sweep and their responses.

    Args:
        beams: in the order of the recorded rows, then those without a recorded return.
        is_kept: the recorded return is unchanged.
        range_m: of all others; inf without a return.
        responses: responses to all others.
    """

    beams: Beams
    is_kept: Bool[np.ndarray, " n"]
    range_m: Float64[np.ndarray, " n"]
    responses: BeamResponses


class LidarSimulator:
    """Simulator of the sweeps of one twin.

    Args:
        static: caster over the twin's static scene.
        response: of the recording's LiDARs.
        class_by_label: the log's number of a point class, by its name.
        make_caster: constructor of ray casters.
    """

    def __init__(
        self,
        static: RayCaster,
        response: Response,
        class_by_label: Mapping[str, int],
        make_caster: MakeCaster,
    ) -> None:
        self._static = static
        self._response = response
        self._class_by_label = class_by_label
        self._make_caster = make_caster

    def edited(
        self, beams: Beams, change: Change, time_ns: int, rng: np.random.Generator
    ) -> SimulatedBeams:
        """Return a sweep in which only beams that meet a change are simulated."""
        new = self._scene(change.new, time_ns).cast_actors(beams)
        removed = self._scene(change.removed_shapes, time_ns).cast_actors(beams)
        # Boxes in addition to meshes: reconstructed meshes of actors miss parts, such as mirrors.
        in_removed = _in_any(beams, change.removed, time_ns)
        rows = np.flatnonzero((new.body != NOTHING) | (removed.body != NOTHING) | in_removed)
        some, new = beams.chosen(rows), new.chosen(rows)
        rest = self._surfaces(some, change.kept, time_ns)
        # A recorded return is more accurate than the twin, so it limits new actors.
        open_m = np.where(some.is_returned, some.range_m, rest.distance_m)
        met_removed = _met_removed(some, in_removed[rows], removed.chosen(rows), rest)
        open_m[met_removed] = rest.distance_m[met_removed]
        is_changed = met_removed | (new.distance_m < open_m)
        # Bodies are numbered over new actors, then unchanged ones.
        bodies = (*change.new, *change.kept)
        rest.body[rest.body >= 0] += len(change.new)
        met = new.nearer(rest).chosen(is_changed)
        return self._simulated(beams, rows[is_changed], met, bodies, rng, is_all=False)

    def whole(
        self,
        beams: Beams,
        placements: Sequence[ActorPlacement],
        time_ns: int,
        rng: np.random.Generator,
    ) -> SimulatedBeams:
        """Return a sweep in which every beam is simulated."""
        rows = np.arange(len(beams))
        met = self._surfaces(beams, placements, time_ns)
        return self._simulated(beams, rows, met, placements, rng, is_all=True)

    def _scene(self, placements: Sequence[ActorPlacement], time_ns: int) -> RayScene:
        return RayScene(self._static, placements, time_ns, self._make_caster)

    def _surfaces(
        self, beams: Beams, placements: Sequence[ActorPlacement], time_ns: int
    ) -> Surfaces:
        """Return the first surface on each beam, with the static scene refined by its recorded
        returns."""
        scene = self._scene(placements, time_ns)
        static = scene.cast_static(beams)
        # Each LiDAR has its own donors.
        for device in np.unique(beams.device).tolist():
            rows = np.flatnonzero((beams.device == device) & (static.body == STATIC))
            static.distance_m[rows] = self._response.refined_m(
                device, beams.chosen(rows), static.chosen(rows)
            )
        return static.nearer(scene.cast_actors(beams))

    def _simulated(
        self,
        beams: Beams,
        rows: Int64[np.ndarray, " k"],
        met: Surfaces,
        bodies: Sequence[ActorPlacement],
        rng: np.random.Generator,
        *,
        is_all: bool,
    ) -> SimulatedBeams:
        """Return the sweep with some beams simulated and the others as recorded."""
        count = len(beams)
        responses, range_m = BeamResponses.nothing(count), np.full(count, np.inf)
        is_kept = beams.is_returned & (not is_all)
        # Simulated beams replace their recorded returns.
        is_kept[rows] = False
        for device in np.unique(beams.device[rows]).tolist():
            for body in np.unique(met.body).tolist():
                part = np.flatnonzero((met.body == body) & (beams.device[rows] == device))
                if body == NOTHING or not len(part):
                    continue
                own, surfaces = beams.chosen(rows[part]), met.chosen(part)
                found = self._of_body(device, own, surfaces, _placement(bodies, body), rng)
                # Distances of the twin have no noise, recorded ones do.
                noise = rng.normal(0.0, self._response.noise_m.get(device, 0.0), len(part))
                responses.fill(rows[part], found)
                range_m[rows[part]] = np.where(
                    found.is_returned, surfaces.distance_m + noise, np.inf
                )
        return SimulatedBeams(beams, is_kept, range_m, responses)

    def _of_body(
        self,
        device: int,
        beams: Beams,
        met: Surfaces,
        placement: ActorPlacement | None,
        rng: np.random.Generator,
    ) -> BeamResponses:
        points, looks = beams.at(met.distance_m), looks_of(beams, met)
        if placement is None:
            return self._response.respond(device, "", None, (points, looks), rng)
        track = placement.track
        local = track.trajectory.to_src(points, beams.times_ns)
        found = self._response.respond(device, track.actor_id, track.kind, (local, looks), rng)
        # An actor's own label is certain; a donor's class may be that of a mislabelled point.
        known = self._class_by_label.get(label_of(track))
        if known is not None:
            found.semantic_class[found.is_returned] = known
        return found


def _placement(bodies: Sequence[ActorPlacement], body: int) -> ActorPlacement | None:
    return None if body == STATIC else bodies[body]


def _in_any(beams: Beams, tracks: Sequence[ActorTrack], time_ns: int) -> Bool[np.ndarray, " n"]:
    """Return the beams whose returns lie in one of the actors' boxes."""
    is_in = np.zeros(len(beams), dtype=bool)
    rows = np.flatnonzero(beams.is_returned)
    own = beams.chosen(rows)
    points = own.at(own.range_m)
    for track in tracks:
        is_in[rows[track.returns_inside(points, own.times_ns)[0]]] = True
    return is_in


def _met_removed(
    beams: Beams, in_removed: Bool[np.ndarray, " n"], removed: Surfaces, rest: Surfaces
) -> Bool[np.ndarray, " n"]:
    """Return the beams that met a removed actor.

    A return must lie in its box, and nearer to its mesh than to the remaining scene. Without a
    return, the actor's mesh must be the first surface.
    """
    with np.errstate(invalid="ignore"):
        off_rest = np.abs(beams.range_m - rest.distance_m)
        is_rest = (off_rest <= np.abs(beams.range_m - removed.distance_m)) & (off_rest < _SAME_M)
    return np.where(beams.is_returned, in_removed & ~is_rest, removed.distance_m < rest.distance_m)
