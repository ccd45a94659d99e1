"""Evidence of an actor's surface: returns, returns on the mirrored half, the default shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from lightsim.core.mesh import Provenance
from lightsim.geometry.actors.body import Body


@dataclass(frozen=True, eq=False)
class ActorEvidence:
    """Weights of the sources of an actor's signed distances, on a grid.

    Args:
        low_m: position of sample (0, 0, 0), frame `actor`.
        voxel_m: distance between samples.
        measured: weight of measurements.
        mirrored: weight of measurements on the other half, mirrored.
        default: weight of the kind's default shape, equal everywhere.
        body: body of a vehicle, with its panes and tyres.
    """

    low_m: Float[np.ndarray, "3"]
    voxel_m: float
    measured: Float[np.ndarray, "x y z"]
    mirrored: Float[np.ndarray, "x y z"]
    default: float
    body: Body | None = None

    def provenance(
        self, points_actor: Float[np.ndarray, "n 3"], is_pane: Bool[np.ndarray, " n"]
    ) -> UInt8[np.ndarray, " n"]:
        """Return the `Provenance` of points of the surface: the source of the largest weight.

        Panes of a measured cabin are interpolated, because beams pass through them.
        """
        measured = self._look_up(self.measured, points_actor)
        mirrored = self._look_up(self.mirrored, points_actor)
        found = np.select(
            [np.maximum(measured, mirrored) < self.default, is_pane, measured < mirrored],
            [Provenance.INFERRED, Provenance.INTERPOLATED, Provenance.MIRRORED],
            Provenance.MEASURED,
        )
        return found.astype(np.uint8)

    def _look_up(
        self, values: Float[np.ndarray, "x y z"], points_actor: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, " n"]:
        """Return values at points by trilinear interpolation."""
        index = ((points_actor - self.low_m) / self.voxel_m).T
        return np.asarray(ndimage.map_coordinates(values, index, order=1, mode="nearest"))
