"""Beams of a sweep, with and without returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.frames import Trajectory
from lightsim.core.rows import Rows
from lightsim.core.sensors import LidarSweep

# Row of a beam without a return.
NO_ROW = -1


@dataclass(frozen=True, eq=False)
class Beams(Rows):
    """Rays of LiDARs in frame `world`, each at its own time.

    Args:
        origins_world: positions of the sensor, metres.
        directions_world: unit vectors.
        times_ns: time of each measurement.
        device: number of the LiDAR in the log.
        range_m: distance of the return; inf without one.
        row: of the return in its sweep, NO_ROW without one.
    """

    origins_world: Float64[np.ndarray, "n 3"]
    directions_world: Float64[np.ndarray, "n 3"]
    times_ns: Int64[np.ndarray, " n"]
    device: Int64[np.ndarray, " n"]
    range_m: Float64[np.ndarray, " n"]
    row: Int64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def is_returned(self) -> Bool[np.ndarray, " n"]:
        """Beams with a return."""
        return self.row != NO_ROW

    def at(self, distance_m: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Return points at a distance along each beam, frame `world`."""
        return self.origins_world + distance_m[:, None] * self.directions_world

    def moved(self, motion: Float64[np.ndarray, "n 4 4"]) -> Beams:
        """Return the beams, each transformed by its own rigid motion of the world."""
        rotation = motion[:, :3, :3]
        origins = np.einsum("nij,nj->ni", rotation, self.origins_world) + motion[:, :3, 3]
        directions = np.einsum("nij,nj->ni", rotation, self.directions_world)
        return Beams(origins, directions, self.times_ns, self.device, self.range_m, self.row)


def returned_beams(sweep: LidarSweep, device: Int64[np.ndarray, " n"]) -> Beams:
    """Return the beams of a sweep's returns, in its order."""
    # In double precision: directions of far returns are needed to a hundredth of a degree.
    along = sweep.points_world.astype(np.float64) - sweep.origins_world
    range_m = np.linalg.norm(along, axis=1)
    return Beams(
        sweep.origins_world.astype(np.float64),
        along / np.maximum(range_m, 1e-9)[:, None],
        sweep.times_ns,
        device,
        range_m,
        np.arange(len(range_m)),
    )


def unreturned_beams(
    directions_ego: Float64[np.ndarray, "n 3"],
    times_ns: Int64[np.ndarray, " n"],
    returned: Beams,
    ego: Trajectory,
) -> Beams:
    """Return beams without return, from their directions in frame `ego`.

    Args:
        returned: beams of the same LiDAR and sweep with returns, which give the sensor's positions.
        ego: `world_from_ego`.
    """
    rotation = ego.held_at(times_ns)[:, :3, :3]
    order = np.argsort(returned.times_ns, kind="stable")
    # Times relative to the sweep: nanoseconds since 1970 exceed a float's precision.
    knots, start_ns = returned.times_ns[order], int(returned.times_ns.min())
    origins = [
        np.interp(times_ns - start_ns, knots - start_ns, returned.origins_world[order, axis])
        for axis in range(3)
    ]
    count = len(times_ns)
    return Beams(
        np.stack(origins, axis=1),
        np.einsum("nij,nj->ni", rotation, directions_ego),
        times_ns,
        np.full(count, returned.device[0], dtype=np.int64),
        np.full(count, np.inf),
        np.full(count, NO_ROW, dtype=np.int64),
    )


def in_ego(beams: Beams, ego: Trajectory) -> Float64[np.ndarray, "n 3"]:
    """Return directions in frame `ego` at each beam's own time."""
    rotation = ego.held_at(beams.times_ns)[:, :3, :3]
    return np.einsum("nji,nj->ni", rotation, beams.directions_world)
