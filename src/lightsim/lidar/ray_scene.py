"""Surfaces on the beams of one sweep: the static scene, and each actor at each beam's own time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, Shaped

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import MakeCaster, RayCaster, RayHits
from lightsim.core.mesh import TriMesh
from lightsim.core.rows import Rows
from lightsim.core.scenario import ActorPlacement
from lightsim.core.sensors import SWEEP_HOLD_S
from lightsim.lidar.beams import Beams

# Body of a beam that meets no surface.
NOTHING = -2
# Body of a beam that meets the static scene.
STATIC = -1


@dataclass(frozen=True, eq=False)
class Surfaces(Rows):
    """First surface on each beam.

    Args:
        distance_m: along the beam; inf without a surface.
        body: NOTHING, STATIC, or the number of a placement.
        normal: unit vector of the surface at the hit; 0 without a surface.
        cosine: absolute cosine between beam and normal.
        roughness: of the surface's material.
    """

    distance_m: Float64[np.ndarray, " n"]
    body: Int64[np.ndarray, " n"]
    normal: Float64[np.ndarray, "n 3"]
    cosine: Float64[np.ndarray, " n"]
    roughness: Float64[np.ndarray, " n"]

    @classmethod
    def nothing(cls, count: int) -> Surfaces:
        """Return beams without a surface, to be filled in."""
        body = np.full(count, NOTHING, dtype=np.int64)
        normal = np.zeros((count, 3))
        return cls(np.full(count, np.inf), body, normal, np.zeros(count), np.ones(count))

    def nearer(self, other: Surfaces) -> Surfaces:
        """Return the nearer of two surfaces on each beam."""
        nearest = self.chosen(np.arange(len(self.body)))
        rows = np.flatnonzero(other.distance_m < self.distance_m)
        nearest.fill(rows, other.chosen(rows))
        return nearest


class RayScene:
    """Caster of beams against a static scene and placed actors.

    Args:
        static: caster over the static meshes.
        placements: actors; those absent at the sweep's time are ignored.
        time_ns: of the sweep.
        make_caster: constructor of ray casters.
    """

    def __init__(
        self,
        static: RayCaster,
        placements: Sequence[ActorPlacement],
        time_ns: int,
        make_caster: MakeCaster,
    ) -> None:
        self._static = static
        self._time_ns = time_ns
        present = [(n, p) for n, p in enumerate(placements) if is_there(p.track, time_ns)]
        parked = [(n, p) for n, p in present if not p.track.is_moving]
        moving = [(n, p) for n, p in present if p.track.is_moving]
        self._parked_bodies = np.array([n for n, _ in parked], dtype=np.int64)
        # Parked actors have one caster; a moving one has its own, since beams are moved for it.
        self._parked = make_caster([placed(p, time_ns) for _, p in parked])
        self._moving = [(n, p.track, make_caster([placed(p, time_ns)])) for n, p in moving]

    def cast(self, beams: Beams) -> Surfaces:
        """Return the first surface on each beam."""
        return self.cast_static(beams).nearer(self.cast_actors(beams))

    def cast_static(self, beams: Beams) -> Surfaces:
        """Return the first static surface on each beam."""
        found = self._static.intersect(beams.origins_world, beams.directions_world)
        bodies = np.full(len(self._static.meshes), STATIC, dtype=np.int64)
        return _surfaces(found, self._static.meshes, bodies, beams)

    def cast_actors(self, beams: Beams) -> Surfaces:
        """Return the first actor on each beam, with moving actors at the beam's own time.

        Instead of the actor, the beam is moved, by the actor's motion from the beam's time to the
        sweep's.
        """
        found = self._parked.intersect(beams.origins_world, beams.directions_world)
        nearest = _surfaces(found, self._parked.meshes, self._parked_bodies, beams)
        for body, track, caster in self._moving:
            rows = np.flatnonzero(_may_meet(beams, caster.meshes[0], track, self._time_ns))
            if not len(rows):
                continue
            # Distances along a beam do not change by a rigid motion, so hits need no correction.
            carried = carried_to(beams.chosen(rows), track, self._time_ns)
            hits = caster.intersect(carried.origins_world, carried.directions_world)
            met = Surfaces.nothing(len(beams))
            met.fill(rows, _surfaces(hits, caster.meshes, np.array([body]), carried))
            nearest = nearest.nearer(met)
        return nearest


def is_there(track: ActorTrack, time_ns: int) -> bool:
    """Return true if an actor is present for the beams of a sweep."""
    return track.is_present(time_ns, SWEEP_HOLD_S)


def placed(placement: ActorPlacement, time_ns: int) -> TriMesh:
    """Return an actor's mesh in frame `world` at the time of a sweep."""
    pose = placement.track.world_from_actor(time_ns, SWEEP_HOLD_S)
    return placement.asset.mesh.transformed(pose)


def carried_to(beams: Beams, track: ActorTrack, time_ns: int) -> Beams:
    """Return beams moved with an actor from each beam's own time to another time."""
    there = track.trajectory.held(time_ns).matrix
    return beams.moved(there @ np.linalg.inv(track.trajectory.held_at(beams.times_ns)))


def _may_meet(
    beams: Beams, mesh: TriMesh, track: ActorTrack, time_ns: int
) -> Bool[np.ndarray, " n"]:
    """Return the beams that may meet an actor; all others are certain to miss it.

    A beam may meet it if it passes the actor's centre by less than the mesh's radius plus its
    motion.
    """
    centre = track.trajectory.held(time_ns).translation_m
    reach_m = np.linalg.norm(mesh.vertices - centre, axis=1).max(initial=0.0)
    towards = centre - beams.origins_world
    # Distance along the beam of its point nearest to the centre, not behind the sensor.
    along = np.maximum((towards * beams.directions_world).sum(axis=1), 0.0)
    past = np.linalg.norm(towards - along[:, None] * beams.directions_world, axis=1)
    return past < reach_m + _swept_m(beams, track, time_ns)


def _swept_m(beams: Beams, track: ActorTrack, time_ns: int) -> float:
    """Return the greatest distance of an actor during the beams from its position at a time, in
    metres."""
    measured_ns = beams.times_ns
    ends_ns = [f(initial=time_ns) for f in (measured_ns.min, measured_ns.max)]
    places = track.trajectory.held_at(np.array([time_ns, *ends_ns]))[:, :3, 3]
    return float(np.linalg.norm(places - places[0], axis=1).max())


def _surfaces(
    hits: RayHits, meshes: Sequence[TriMesh], bodies: Int64[np.ndarray, " m"], beams: Beams
) -> Surfaces:
    found = Surfaces.nothing(len(beams))
    found.distance_m[:] = hits.distance_m
    for index, mesh in enumerate(meshes):
        rows = np.flatnonzero(hits.is_hit & (hits.mesh_index == index))
        if not len(rows):
            continue
        face = hits.face_index[rows]
        corners = mesh.vertices[mesh.faces[face]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Normals of faces instead of smooth ones: the LiDAR's response depends on the true
        # incidence.
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        found.body[rows] = bodies[index]
        found.normal[rows] = normal
        found.cosine[rows] = np.abs((normal * beams.directions_world[rows]).sum(axis=1))
        found.roughness[rows] = _roughness(mesh, face)
    return found


def _roughness(mesh: TriMesh, face: Shaped[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
    known = np.array([material.roughness for material in mesh.materials])
    if mesh.face_material is None:
        return np.full(len(face), known[0])
    return known[mesh.face_material[face]]
