"""Roofs that no view reaches, as uncertain as they are: what lets the sun by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from lightsim.core.casting import RayCaster
from lightsim.core.dome import Sun
from lightsim.core.solar import angle_between_deg

_TOLD_DEG = 1.0
"""Shadows of a sun this near to the recorded one lie where the pictures show them."""


@dataclass(frozen=True, eq=False)
class UncertainRoofs:
    """Equally probable guesses of what no view shows of buildings.

    A shadow is the mean over all of them: expected light. It is soft where nobody knows where it
    ends, and a false edge costs less than a hard one would.

    Args:
        make_guesses: a caster over the hidden parts of each guess, from the lowest roofs to the
            highest; called when a sun first asks.
        told_by: sun of the recording, whose shadows chose the one guess that is used for it.
    """

    make_guesses: Callable[[], Sequence[RayCaster]]
    told_by: Sun | None

    @cached_property
    def guesses(self) -> Sequence[RayCaster]:
        """Made once; the recorded sun asks for none."""
        return self.make_guesses()

    def are_told(self, sun: Sun) -> bool:
        """Whether the pictures show the shadows of this sun."""
        if self.told_by is None:
            return False
        angle_deg = angle_between_deg(sun.direction_world, self.told_by.direction_world)
        return bool(angle_deg < _TOLD_DEG)

    def open_fraction(
        self, points_world: Float32[np.ndarray, "n 3"], sun: Sun
    ) -> Float32[np.ndarray, " n"]:
        """Fraction of the guesses that let the centre of the sun's disc be seen from points."""
        direction = sun.direction_world / np.linalg.norm(sun.direction_world)
        towards = np.broadcast_to(direction.astype(np.float32), points_world.shape)
        count = np.full(len(points_world), len(self.guesses), dtype=np.float32)
        rows = np.arange(len(points_world))
        # What passes roofs passes all lower ones.
        for number, caster in reversed(list(enumerate(self.guesses))):
            rows = rows[caster.is_occluded(points_world[rows], towards[rows])]
            count[rows] = number
        return count / np.float32(len(self.guesses))
