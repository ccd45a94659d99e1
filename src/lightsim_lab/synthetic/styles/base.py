"""Parts of a style of the synthetic street."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.textures import Finish

# Smallest x of the street, frame `street`, in metres. The ego vehicle starts at x = 0.
STREET_START_M = -55.0
# Largest x of the street, in metres: the longest log ends at x = 52.
STREET_END_M = 125.0


@dataclass(frozen=True, eq=False)
class StreetStyle:
    """Builders of one style. All of them are reproducible functions of the plan.

    Args:
        make_finishes: finishes by material name.
        build_background: static parts, frame `street`, one per material.
        build_participants: actors; arguments are the plan, the speed of the ego vehicle in m/s, and
            whether a dense column of faster cars replaces the oncoming traffic.
        car_rows: y and heading, frame `street`, of the rows in which an edit may insert a car.
    """

    make_finishes: Callable[[StreetPlan], dict[str, Finish]]
    build_background: Callable[[StreetPlan], tuple[Part, ...]]
    build_participants: Callable[[StreetPlan, float, bool], tuple[Participant, ...]]
    car_rows: tuple[tuple[float, float], ...]
