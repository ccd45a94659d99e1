"""Size and hash function of a hash grid; a module of its own, so that settings load no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from lightsim.errors import InputError

# Factors of the x, y and z cell in the hash (Mueller et al., equation 4).
PRIMES = (1, 2654435761, 805459861)
# Factor of the salt in the hash: the next prime of instant-ngp's list.
SALT_PRIME = 3674653429


@dataclass(frozen=True)
class HashGridSpec:
    """Size of a hash grid; cell sizes decrease geometrically from coarsest to finest.

    Mueller et al. 2022 (doi:10.1145/3528223.3530127), equations 2 and 3, without the rounding.
    """

    levels: int = 12
    """Number of grids of different cell size."""
    features: int = 2
    """Values per entry."""
    log2_entries: int = 20
    """Base-2 logarithm of the entries per level; all levels are hashed."""
    coarsest_m: float = 4.0
    """Cell size of the first level."""
    finest_m: float = 0.1
    """Cell size of the last level."""

    def __post_init__(self) -> None:
        sizes = self.levels >= 1 and self.features >= 1 and 3 <= self.log2_entries <= 28
        if not sizes or not 0.0 < self.finest_m <= self.coarsest_m < math.inf:
            raise InputError(
                "the hash grid has an impossible size",
                got=self,
                expected="levels, features >= 1, log2_entries 3 to 28, 0 < finest_m <= coarsest_m",
            )

    @property
    def output_dim(self) -> int:
        """Return the number of features of one point over all levels."""
        return self.levels * self.features

    def table_shape(self) -> tuple[int, int]:
        """Return (entries over all levels, features)."""
        return self.levels * 2**self.log2_entries, self.features

    def cells_per_m(self) -> Float32[np.ndarray, "levels"]:
        """Return the inverse cell size of each level, coarsest first."""
        sizes = np.geomspace(self.coarsest_m, self.finest_m, self.levels)
        return (1.0 / sizes).astype(np.float32)
