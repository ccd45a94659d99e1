"""Settings of the step from observed radiance to base colour."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from lightsim.appearance.intrinsic.divide import DivideConfig


@dataclass(frozen=True)
class DelightConfig:
    """How radiance becomes base colour."""

    method: Literal["labels", "divide"] = "labels"
    """"labels" finds shadows in the pictures; "divide" trusts the rendered light (baseline)."""
    low: float = 0.02
    """Least base colour."""
    high: float = 0.95
    """Greatest base colour."""
    surfel_m: float = 0.25
    """Size of the patches that carry labels."""
    reach_m: float = 3.0
    """Distance of the farthest patches of the same surface that each is compared with; such a
    pair counts half as much as a near one."""
    edge_error_m: float = 0.4
    """How far rendered shadow edges may lie from the true ones."""
    trust_inferred: float = 0.75
    """Probability that an inferred (unmeasured) surface is there, as far as shadows go."""
    unseen_shadow: float = 0.1
    """Probability that something unseen shadows a patch that every rendering lights."""
    least_lit: float = 0.02
    """Probability that a patch is lit although every rendering shadows it."""
    prior_weight: float = 0.25
    """What these say of one patch counts this much: neighbours share their errors."""
    tone_std: float = 0.2
    """Spread of log base colour within a material."""
    hue_std: float = 0.08
    """Spread of its colour part."""
    cap: float = 3.0
    """Greatest energy of a pair, nats: what a change of material costs."""
    strength: float = 1.5
    """Weight of what pictures say against the rendered prior."""
    potts: float = 0.3
    """Energy of a shadow's edge itself, nats."""
    island_m2: float = 5.0
    """Smaller shadows that no rendering knows, amid light (or the reverse), are dark or bright
    things such as windows and lane marks."""
    rounds: int = 3
    """Turns between labels and the sun's strength."""
    min_pairs: int = 60
    """Fewer lit/shadowed pairs say nothing about the sun's strength."""
    deep_shade: tuple[float, float] = (0.1, 0.3)
    """Share of an open sky's light up to which a quotient is worth nothing, and from which on it
    counts fully; in between and below, colours come from surfaces near by that face alike."""
    divide: DivideConfig = field(default_factory=DivideConfig)
    """Settings of the baseline."""
