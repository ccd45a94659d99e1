"""Settings of the step from observed radiance to base colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class IntrinsicConfig:
    """How radiance becomes base colour."""

    method: Literal["labels", "divide"] = "labels"
    """"labels" finds shadows in the pictures; "divide" trusts the rendered light (baseline)."""
    reach_m: float = 3.0
    """Distance of the farthest patches of the same surface that each is compared with; such a
    pair counts half as much as a near one."""
    edge_error_m: float = 0.4
    """How far rendered shadow edges may lie from the true ones."""
    unseen_shadow: float = 0.1
    """Probability that something unseen shadows a patch that every rendering lights."""
    island_m2: float = 5.0
    """Smaller shadows that no rendering knows, amid light (or the reverse), are dark or bright
    things such as windows and lane marks."""
    deep_shade: tuple[float, float] = (0.1, 0.3)
    """Fraction of an open sky's light up to which a quotient is worth nothing, and from which on it
    counts fully; in between and below, colours come from surfaces near by that face alike."""
