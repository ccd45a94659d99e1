"""What the parts of an actor's surface rest on: returns, the other half, its default shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage

from lightsim.core.mesh import Provenance

_GLASS_VOXELS = 1.0


@dataclass(frozen=True, eq=False)
class ActorEvidence:
    """The sources of an actor's signed distances, sample by sample.

    Args:
        low_m: position of sample (0, 0, 0), frame `actor`.
        voxel_m: distance between samples.
        measured: weight of what rays found.
        mirrored: weight of what rays found on the other half.
        default: weight of the kind's default shape, the same everywhere.
        filled_m: by how much closing the cabin lowered the signed distance.
    """

    low_m: Float[np.ndarray, "3"]
    voxel_m: float
    measured: Float32[np.ndarray, "x y z"]
    mirrored: Float32[np.ndarray, "x y z"]
    default: float
    filled_m: Float32[np.ndarray, "x y z"]

    def is_glass(self, points_actor: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Points of the closed surface where the measured one had a hole."""
        return self._look_up(self.filled_m, points_actor) > _GLASS_VOXELS * self.voxel_m

    def provenance(self, points_actor: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """The `Provenance` of points of the surface: the source that weighs most there; closed
        windows of a cabin that was seen are interpolated."""
        measured = self._look_up(self.measured, points_actor)
        mirrored = self._look_up(self.mirrored, points_actor)
        found = np.select(
            [
                np.maximum(measured, mirrored) < self.default,
                self.is_glass(points_actor),
                measured < mirrored,
            ],
            [Provenance.INFERRED, Provenance.INTERPOLATED, Provenance.MIRRORED],
            Provenance.MEASURED,
        )
        return found.astype(np.uint8)

    def _look_up(
        self, values: Float32[np.ndarray, "x y z"], points_actor: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, " n"]:
        """Trilinear between the samples."""
        index = ((points_actor - self.low_m) / self.voxel_m).T
        return np.asarray(ndimage.map_coordinates(values, index, order=1, mode="nearest"))
