"""Settings of the step from observed radiance to base colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class IntrinsicConfig:
    """Settings of the intrinsic decomposition."""

    method: Literal["labels", "divide"] = "labels"
    """"labels" detects shadows in the images; "divide" divides by the rendered light (baseline)."""
    reach_m: float = 3.0
    """Greatest distance of two compared patches of one surface; a pair at this distance has half
    the weight of a close one."""
    edge_error_m: float = 0.4
    """Standard deviation of the position of rendered shadow edges."""
    unseen_shadow: float = 0.1
    """Probability that an unobserved occluder shadows a patch that is lit in every rendering."""
    island_m2: float = 5.0
    """Area below which isolated labels that contradict every rendering are reset to it: they are
    mostly dark or bright objects, such as windows and lane marks."""
    deep_shade: tuple[float, float] = (0.1, 0.3)
    """Fractions of an open sky's light: below the first the quotient of radiance and light has
    weight 0, above the second weight 1. The remaining weight is that of the surface around."""
