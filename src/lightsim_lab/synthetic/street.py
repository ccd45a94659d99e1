"""Geometry and materials of a synthetic street, built in the style of its plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lightsim_lab.synthetic.ego_body import build_ego_body
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan, Style
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.styles.base import StreetStyle
from lightsim_lab.synthetic.styles.boulevard import BOULEVARD
from lightsim_lab.synthetic.styles.city import CITY
from lightsim_lab.synthetic.styles.industrial import INDUSTRIAL
from lightsim_lab.synthetic.styles.junction import JUNCTION
from lightsim_lab.synthetic.styles.suburban import SUBURBAN
from lightsim_lab.synthetic.textures import Finish

_STYLES: Mapping[Style, StreetStyle] = {
    "city": CITY,
    "suburban": SUBURBAN,
    "boulevard": BOULEVARD,
    "industrial": INDUSTRIAL,
}


@dataclass(frozen=True, eq=False)
class Street:
    """Geometry and materials of the whole scene.

    Args:
        background: static parts, frame `street`.
        participants: actors, each in its own frame `actor`.
        finishes: finishes by material name.
        ego_body: parts of the ego vehicle, frame `ego`; empty if no sensor sees it.
    """

    plan: StreetPlan
    background: tuple[Part, ...]
    participants: tuple[Participant, ...]
    finishes: Mapping[str, Finish]
    ego_body: tuple[Part, ...] = ()


def build_street(
    plan: StreetPlan,
    ego_speed_m_s: float,
    has_fast_traffic: bool = False,
    is_standing: bool = False,
) -> Street:
    """Build the street of a plan; it is reproducible.

    Args:
        is_standing: the ego vehicle has a body and waits at a junction with cross traffic; only in
            the style city.
    """
    style = JUNCTION if is_standing else style_of(plan)
    return Street(
        plan,
        style.build_background(plan),
        style.build_participants(plan, ego_speed_m_s, has_fast_traffic),
        style.make_finishes(plan),
        build_ego_body(plan) if is_standing else (),
    )


def build_background(plan: StreetPlan) -> tuple[Part, ...]:
    """Build the static parts, frame `street`, one per material."""
    return style_of(plan).build_background(plan)


def build_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool = False
) -> tuple[Participant, ...]:
    """Draw the actors.

    Args:
        has_fast_traffic: a dense column of faster cars replaces the oncoming traffic.
    """
    return style_of(plan).build_participants(plan, ego_speed_m_s, has_fast_traffic)


def style_of(plan: StreetPlan) -> StreetStyle:
    """Return the builders of a plan's style."""
    return _STYLES[plan.style]
