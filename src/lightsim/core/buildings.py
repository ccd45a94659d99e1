"""Walls of buildings and the height profiles of their roof edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.special import expit

from lightsim.core.profiles import best_profile, least_energies

# Prior cost of a step of the roof profile, in nats. Chosen with the next one on synthetic streets;
# their sensitivity was not measured.
_STEP = 4.0
# Prior cost of each metre of such a step, in nats.
_STEP_PER_M = 0.2


@dataclass(frozen=True, eq=False)
class Wall:
    """Rectangle of a vertical plane through measured faces, frame `world`.

    Args:
        origin_m: the point of the plane with s = 0 and z = 0.
        normal: horizontal, away from the building.
        along: horizontal, in the plane; from left to right for an observer outside.
        span_m: lowest and highest s.
        height_m: lowest and highest z.
    """

    origin_m: Float64[np.ndarray, "3"]
    normal: Float64[np.ndarray, "3"]
    along: Float64[np.ndarray, "3"]
    span_m: tuple[float, float]
    height_m: tuple[float, float]

    def at(
        self, s: Float64[np.ndarray, "*n"], z: Float64[np.ndarray, "*n"], out_m: float = 0.0
    ) -> Float64[np.ndarray, "*n 3"]:
        """World position of (s, z), `out_m` in front of the plane."""
        up = np.array([0.0, 0.0, 1.0])
        place = s[..., None] * self.along + z[..., None] * up
        return self.origin_m + place + out_m * self.normal

    def grid(
        self, cell_m: float, shape: tuple[int, ...]
    ) -> tuple[Float64[np.ndarray, "s z"], Float64[np.ndarray, "s z"]]:
        """Return s and z of the centres of square cells, from the lowest corner upwards."""
        s, z = (
            low + (np.arange(count) + 0.5) * cell_m
            for low, count in zip((self.span_m[0], self.height_m[0]), shape, strict=True)
        )
        s, z = np.meshgrid(s, z, indexing="ij")
        return s, z

    def place(
        self, points_world: Float64[np.ndarray, "*n 3"]
    ) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
        """Return s of points, and their signed distance in front of the plane, in metres."""
        offset = points_world - self.origin_m
        return offset @ self.along, offset @ self.normal


@dataclass(frozen=True)
class WallPart:
    """Rectangle of a wall with level edges.

    Args:
        span_m, height_m: lowest and highest s along the wall, and z.
    """

    wall: Wall
    span_m: tuple[float, float]
    height_m: tuple[float, float]

    def middle(self, out_m: float = 0.0) -> Float64[np.ndarray, "3"]:
        """Return the centre in frame `world`, `out_m` in front of the wall's plane."""
        s, z = (np.array(np.mean(limits)) for limits in (self.span_m, self.height_m))
        return self.wall.at(s, z, out_m)

    def holds(self, place_world: Float64[np.ndarray, "3"], out_m: float, within_m: float) -> bool:
        """Return whether a point lies within the limits of the rectangle, and its distance in front
        of the plane differs from `out_m` by less than `within_m`."""
        (s,), (out,) = self.wall.place(place_world[None])
        is_in = self.span_m[0] < s < self.span_m[1]
        is_in &= self.height_m[0] < place_world[2] < self.height_m[1]
        return bool(is_in and abs(out - out_m) < within_m)


@dataclass(frozen=True, eq=False)
class Roofline:
    """Roof edge of one wall, as a height for each column of cells.

    Args:
        wall: the plane.
        cell_m: width of a column, and unit of heights along it.
        ground_m: z of the ground before each column.
        energy: cost of each number of filled cells from the bottom, in nats.
        shown: number of cells up to the highest one with a measurement or a view that shows matter.
        top: number of cells below the roof edge.
        is_seen: whether a view shows the sky above the roof edge.
        depth_m: of the building behind; 0 behind fences.
        log_std: standard deviation of the log height where no view shows the roof edge.
    """

    wall: Wall
    cell_m: float
    ground_m: Float64[np.ndarray, " s"]
    energy: Float32[np.ndarray, "s t"]
    shown: Int64[np.ndarray, " s"]
    top: Int64[np.ndarray, " s"]
    is_seen: Bool[np.ndarray, " s"]
    depth_m: Float64[np.ndarray, " s"]
    log_std: float

    @property
    def s_m(self) -> Float64[np.ndarray, " s"]:
        """Centre of each column along the wall, in metres."""
        return self.wall.span_m[0] + (np.arange(len(self.top)) + 0.5) * self.cell_m

    @property
    def top_m(self) -> Float64[np.ndarray, " s"]:
        """z of the roof edge, in metres."""
        return self.wall.height_m[0] + self.top * self.cell_m

    @property
    def height_m(self) -> Float64[np.ndarray, " s"]:
        """Height of the roof edge above the ground, in metres."""
        return self.top_m - self.ground_m

    def filled(self) -> Float64[np.ndarray, "s c"]:
        """Return the probability that each cell lies below the roof edge. It follows from two
        energies: of the best profile with the cell below the edge, and of the best one without."""
        # Min-marginals instead of marginals: the ratio of the best profiles on either side of the
        # question. A cell is below the roof edge if more cells are filled than its own number.
        energy = self.energy.astype(np.float64)
        least = least_energies(energy, _STEP, _STEP_PER_M * self.cell_m)
        free = np.minimum.accumulate(least, axis=1)[:, :-1]
        filled = np.minimum.accumulate(least[:, ::-1], axis=1)[:, ::-1][:, 1:]
        return np.asarray(expit(free - filled))

    def solved(self, further: Float64[np.ndarray, "s t"] | None = None) -> Roofline:
        """Return the roofline with the most probable profile.

        Args:
            further: energy to add in columns whose roof edge no view shows, nats.
        """
        energy = self.energy.astype(np.float64)
        if further is not None:
            energy = energy + np.where(self.is_seen[:, None], 0.0, further)
        # The whole profile is solved again, because steps couple observed and other columns.
        top = best_profile(energy, _STEP, _STEP_PER_M * self.cell_m)
        # An observed edge is evidence of its own and must not move by a prior on its neighbours.
        top = top if further is None else np.where(self.is_seen, self.top, top)
        return replace(self, top=top, energy=energy.astype(np.float32))
