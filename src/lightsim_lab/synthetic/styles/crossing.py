"""A junction of the style `city`, before which the ego vehicle of standing streets waits."""

from __future__ import annotations

from collections.abc import Iterable

from lightsim_lab.synthetic.buildings import Building
from lightsim_lab.synthetic.shapes import Part

# Range of x, frame `street`, in metres, of the road that crosses. The front of the ego vehicle
# stands at 3.4 m and ends at most 4 m further.
CROSSING_M = (7.5, 16.5)


def is_crossed(low_m: float, high_m: float) -> bool:
    """Return True if a range of x overlaps the crossing road."""
    return low_m < CROSSING_M[1] and high_m > CROSSING_M[0]


def beside_crossing(houses: Iterable[Building]) -> list[Building]:
    """Return the houses that do not stand on the crossing road."""
    return [h for h in houses if not is_crossed(h.start_m, h.start_m + h.width_m)]


def furniture_beside_crossing(parts: Iterable[Part]) -> list[Part]:
    """Return the furniture whose middle is not on the crossing road."""
    # The middle, so that trunk and crown, or pole and sign, are kept or removed together.
    kept = []
    for part in parts:
        middle_m = float(part.vertices[:, 0].min() + part.vertices[:, 0].max()) / 2
        if not is_crossed(middle_m, middle_m):
            kept.append(part)
    return kept
