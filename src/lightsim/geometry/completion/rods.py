"""An upright rod, and its tests against beams that pass it or end on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

# Greatest distance of a pole from the path or along a beam, in metres; beams are sparse beyond.
# All values here and in `poles` were chosen on log 002 and streets 0 and 77; only their joint
# effect was measured (docs/benchmarks/reconstruction.md).
REACH_M = 35.0
# Least radius of a pole, in metres.
MIN_RADIUS_M = 0.03


class _BeamTest:
    """Test of a rod against beams that pass it and end on it."""

    beside_m = (0.05, 0.6)  # Range of distances from the surface of passing beams.
    behind_m = 0.7  # Least distance of their ends behind the axis.
    min_passes = 4  # Least number of passing beams on each side.
    at_m = 0.35  # Greatest distance from the axis of the ends of beams that end on the rod.
    min_solid = 0.6  # Least fraction of beams towards the rod that end on it.
    max_beside = 0.4  # Greatest ratio of beams that end beside it to those that end on it.
    above_m = 0.8  # Height above a rod that is tested for its end.


@dataclass(frozen=True, eq=False)
class Pole:
    """An upright rod, frame world.

    Args:
        foot_m: foot of its axis, on the ground.
        slant: slant of the axis, in metres per metre of height.
        radius_m: radius at the foot.
        taper: change of the radius per metre of height.
        measured_m: lowest and highest z that beams reached.
        top_m: z of the upper end.
        is_open: whether the position of its end is unknown, because no beam passed directly above
            it or ended nearby.
    """

    foot_m: Float64[np.ndarray, "3"]
    slant: Float64[np.ndarray, "2"]
    radius_m: float
    taper: float
    measured_m: tuple[float, float]
    top_m: float
    is_open: bool = True

    def axis_at(self, z: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Return the points of the axis at these z."""
        across = self.foot_m[:2] + (z - self.foot_m[2])[:, None] * self.slant
        return np.concatenate([across, z[:, None]], axis=1)

    def radius_at(self, z: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the radius at these z."""
        radius = self.radius_m + self.taper * (z - self.foot_m[2])
        return np.maximum(radius, MIN_RADIUS_M)


def is_free_standing(
    pole: Pole, origins: Float32[np.ndarray, "b 3"], ends: Float32[np.ndarray, "b 3"]
) -> bool:
    """Return whether beams pass on both sides of a rod and end on it."""
    beside, is_past, is_on_rod = _beams_by(pole, pole.measured_m, origins, ends)
    radius = float(pole.radius_at(np.array([0.5 * sum(pole.measured_m)]))[0])
    near, far = radius + _BeamTest.beside_m[0], radius + _BeamTest.beside_m[1]
    passes = [int((is_past & (side > near) & (side < far)).sum()) for side in (beside, -beside)]
    is_aimed = np.abs(beside) < 0.5 * radius
    met, passed = int((is_aimed & is_on_rod).sum()), int((is_aimed & is_past).sum())
    is_own = is_on_rod & (np.abs(beside) < near)
    is_wider = is_on_rod & (np.abs(beside) > near) & (np.abs(beside) < far)
    is_thin = bool(is_wider.sum() < _BeamTest.max_beside * is_own.sum())
    return (
        is_thin
        and min(passes) >= _BeamTest.min_passes
        and met >= _BeamTest.min_solid * (met + passed)
    )


def ends_openly(
    pole: Pole, origins: Float32[np.ndarray, "b 3"], ends: Float32[np.ndarray, "b 3"]
) -> bool:
    """Return whether no beam observes the space directly above a rod."""
    span = (pole.top_m + 0.1, pole.top_m + _BeamTest.above_m)
    beside, is_past, is_on_rod = _beams_by(pole, span, origins, ends)
    passed = is_past & (np.abs(beside) < _BeamTest.beside_m[0])
    near = is_on_rod & (np.abs(beside) < _BeamTest.beside_m[1])
    return int(passed.sum()) < 2 and int(near.sum()) < 2


def _beams_by(
    pole: Pole,
    span_m: tuple[float, float],
    origins: Float32[np.ndarray, "b 3"],
    ends: Float32[np.ndarray, "b 3"],
) -> tuple[Float32[np.ndarray, " b"], Bool[np.ndarray, " b"], Bool[np.ndarray, " b"]]:
    """Return the distance of each beam beside the axis, and whether it ends behind or on the rod.

    Only beams that reach the axis between the heights `span_m` are marked.
    """
    centre = pole.axis_at(np.array([0.5 * sum(span_m)]))[0, :2].astype(np.float32)
    start, way = centre - origins[:, :2], ends[:, :2] - origins[:, :2]
    length = np.maximum(np.linalg.norm(way, axis=1), np.float32(1e-6))
    along = (start * way).sum(axis=1) / length
    beside = (start[:, 0] * way[:, 1] - start[:, 1] * way[:, 0]) / length
    height = origins[:, 2] + (ends[:, 2] - origins[:, 2]) * along / length
    is_level = (height > span_m[0]) & (height < span_m[1]) & (along > 0) & (along < REACH_M)
    is_past = is_level & (length > along + _BeamTest.behind_m)
    is_on_rod = is_level & (np.abs(length - along) < _BeamTest.at_m)
    return beside, is_past, is_on_rod
