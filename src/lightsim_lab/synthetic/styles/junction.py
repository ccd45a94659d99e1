"""The style `city` with a junction and cross traffic, before which the ego vehicle waits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.styles.base import StreetStyle
from lightsim_lab.synthetic.styles.city import CITY, LANE_M, build_city, build_city_participants
from lightsim_lab.synthetic.styles.crossing import CROSSING_M, is_crossed
from lightsim_lab.synthetic.styles.traffic import draw_car

# Lane centre x (m), heading (rad), position y at time 0 (m) and speed (m/s) of each crossing car.
# In the first second one car passes in front of the ego vehicle, in four seconds three.
_CROSS_TRAFFIC = (
    (10.0, -np.pi / 2, 6.0, 6.5),
    (10.0, -np.pi / 2, 22.0, 6.5),
    (14.0, np.pi / 2, -12.0, 7.0),
    (14.0, np.pi / 2, -26.0, 7.0),
)


def _waiting_participants(
    plan: StreetPlan, ego_speed_m_s: float, has_fast_traffic: bool
) -> tuple[Participant, ...]:
    """Return the usual participants, those on the road at rest, and cars that cross."""
    people: list[Participant] = []
    for actor in build_city_participants(plan, 0.0):
        x, y, z = actor.start_m
        is_car = actor.kind is ActorKind.CAR
        half_m = actor.size_lwh_m[0] / 2
        if is_car and abs(y) < LANE_M and is_crossed(x - half_m, x + half_m):
            # The car ahead of the ego vehicle waits beyond the junction.
            x = CROSSING_M[1] + half_m + 2.0
        if not (is_car and is_crossed(x - half_m, x + half_m)):
            speed_m_s = 0.0 if is_car else actor.speed_m_s
            people.append(replace(actor, start_m=(x, y, z), speed_m_s=speed_m_s))
    # Streams 11 and 12 are those of the ego vehicle's body and of cross traffic.
    rng = np.random.default_rng([plan.seed, 12])
    for x, heading, y, speed_m_s in _CROSS_TRAFFIC:
        people.append(draw_car(rng, (x, y, heading), speed_m_s))
    return tuple(people)


JUNCTION = StreetStyle(
    CITY.make_finishes,
    partial(build_city, has_crossing=True),
    _waiting_participants,
    CITY.car_rows,
)
