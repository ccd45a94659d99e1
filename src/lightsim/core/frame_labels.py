"""Labels of one picture: the actor of every pixel, and visibility and boxes of every actor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int32

Box = tuple[int, int, int, int]
"""Left, top, right and bottom edge in pixels; right and bottom are exclusive."""


@dataclass(frozen=True)
class ActorLabel:
    """Label of one actor in one picture; amodal values ignore occlusion.

    Args:
        number: of the actor, the same in all frames of a scenario.
        visible_px: pixels that show the actor.
        amodal_px: pixels of the picture that would show it without occluders, at least 1.
        visibility: visible_px / amodal_px.
        visible_box: box of the visible pixels; None if there are none.
        amodal_box: box of the amodal pixels.
    """

    actor_id: str
    number: int
    visible_px: int
    amodal_px: int
    visibility: float
    visible_box: Box | None
    amodal_box: Box


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """Labels of one picture.

    Args:
        actors: every actor that has a mesh and whose amodal mask is not empty.
        actor_index: number of the actor that each pixel shows; negative without one.
    """

    actors: tuple[ActorLabel, ...]
    actor_index: Int32[np.ndarray, "h w"]

    @cached_property
    def by_actor(self) -> dict[str, ActorLabel]:
        """Labels by the actor's id."""
        return {label.actor_id: label for label in self.actors}

    def mask(self, label: ActorLabel) -> Bool[np.ndarray, "h w"]:
        """Return the pixels that show an actor."""
        return self.actor_index == label.number
