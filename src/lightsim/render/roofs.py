"""Sun visibility behind unobserved roofs, as a mean over equally probable shapes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from lightsim.core.casting import RayCaster
from lightsim.core.dome import Sun
from lightsim.core.solar import angle_between_deg

# Suns within this angle of the recorded one, in degrees, cast shadows where images show them.
# Chosen; sensitivity not measured.
_OBSERVED_DEG = 1.0


@dataclass(frozen=True, eq=False)
class UncertainRoofs:
    """Equally probable shapes of the unobserved parts of buildings.

    A shadow is the mean over all shapes, which is the expected light: it is soft where its edge is
    uncertain, and a misplaced soft edge has a smaller error than a hard one.

    Args:
        make_shapes: returns a caster over the unobserved parts of each shape, from the lowest
            roofs to the highest; called at the first sun.
        recorded_sun: sun of the recording. Its observed shadows selected one shape, which is used
            for this sun.
    """

    make_shapes: Callable[[], Sequence[RayCaster]]
    recorded_sun: Sun | None

    @cached_property
    def shapes(self) -> Sequence[RayCaster]:
        """Casters of the shapes, made at the first access; the recorded sun does not need them."""
        return self.make_shapes()

    def are_observed(self, sun: Sun) -> bool:
        """Return true if the images show the shadows of this sun."""
        if self.recorded_sun is None:
            return False
        angle_deg = angle_between_deg(sun.direction_world, self.recorded_sun.direction_world)
        return bool(angle_deg < _OBSERVED_DEG)

    def open_fraction(
        self, points_world: Float32[np.ndarray, "n 3"], sun: Sun
    ) -> Float32[np.ndarray, " n"]:
        """Return the fraction of roof shapes that leave the centre of the sun's disc visible."""
        direction = sun.direction_world / np.linalg.norm(sun.direction_world)
        towards = np.broadcast_to(direction.astype(np.float32), points_world.shape)
        # From the highest shape downwards: each step traces only the rays that are still occluded.
        count = np.full(len(points_world), len(self.shapes), dtype=np.float32)
        rows = np.arange(len(points_world))
        # A ray that passes over the roofs of one shape passes over all lower shapes.
        for number, caster in reversed(list(enumerate(self.shapes))):
            rows = rows[caster.is_occluded(points_world[rows], towards[rows])]
            count[rows] = number
        return count / np.float32(len(self.shapes))
