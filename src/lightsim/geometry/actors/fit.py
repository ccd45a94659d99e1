"""A vehicle's proportions from what was measured of it (robust maximum a posteriori).

Priors are typical proportions of kinds of bodies and their spread; the type that explains the
measurements best is taken, so that a van is no sedan with a very high trunk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorKind
from lightsim.geometry.actors.body import (
    BOX,
    DEVIATION,
    HATCHBACK,
    PICKUP,
    SEDAN,
    VAN,
    Body,
    Proportions,
)

_CARS = (SEDAN, HATCHBACK, VAN)
_TYPES: dict[ActorKind, tuple[Proportions, ...]] = {
    ActorKind.CAR: _CARS,
    ActorKind.OTHER_VEHICLE: (*_CARS, PICKUP, BOX),
    ActorKind.PICKUP: (PICKUP,),
    ActorKind.TRUCK: (BOX, VAN, PICKUP),
    ActorKind.BUS: (BOX,),
}
HAS_BODY = frozenset(_TYPES)
"""Kinds whose vehicles have such a body."""
_HATCHBACK_BELOW_M, _VAN_FROM_M, _TALL_FROM_M = 4.3, 1.85, 1.6
_NOISE_M = 0.04
"""Of measured distances, beam by beam; residuals far beyond it count less and less."""
_CAB = 0.3
"""Lorries have side windows on this part of their length."""
_OTHER_TYPE = 8.0
"""What the evidence for another type than the box's shape suggests must exceed, twice the log."""
_STARTS = 2
_ROUNDS = 12
_CORRELATED = 8.0
"""Neighbouring samples tell the same: so many count as one."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured of a vehicle, frame `actor`.

    Args:
        surface_actor: points of its surface.
        free_actor: points that beams passed.
        free_weight: trust in each of them, at most 1.
    """

    surface_actor: Float[np.ndarray, "n 3"]
    free_actor: Float[np.ndarray, "m 3"]
    free_weight: Float[np.ndarray, " m"]


def typical_body(kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"]) -> Body:
    """The body of a kind of vehicle of which nothing is known but its box."""
    types = _TYPES[kind]
    if types[0] is not SEDAN:
        return _body(kind, types[0], size_lwh_m)
    length, _, height = (float(v) for v in size_lwh_m)
    if height >= _VAN_FROM_M:
        return Body(VAN, size_lwh_m)
    is_sedan = length > _HATCHBACK_BELOW_M and height < _TALL_FROM_M
    return Body(SEDAN if is_sedan else HATCHBACK, size_lwh_m)


def fit_body(kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"], seen: Measured) -> Body:
    """The body that explains the measurements best; the typical one where there are none.

    Raises:
        KeyError: a kind that has no body (`HAS_BODY`).
    """
    typical = typical_body(kind, size_lwh_m)
    if len(seen.surface_actor) == 0:
        return typical
    deviation = np.array(DEVIATION)

    def penalty(prior: Proportions) -> float:
        return 0.0 if prior is typical.proportions else _OTHER_TYPE

    ranked = sorted(
        _TYPES[kind],
        key=lambda prior: _cost(prior, prior, deviation, size_lwh_m, seen) + penalty(prior),
    )
    fits = []
    for prior in ranked[:_STARTS]:
        cost, found = _refined(prior, deviation, size_lwh_m, seen)
        fits.append((cost + penalty(prior), found))
    return _body(kind, min(fits, key=lambda fit: fit[0])[1], size_lwh_m)


def _body(kind: ActorKind, found: Proportions, size_lwh_m: Float[np.ndarray, "3"]) -> Body:
    return Body(found, size_lwh_m, _CAB if kind is ActorKind.TRUCK else 1.0)


def _residuals(
    found: Float64[np.ndarray, " p"],
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    seen: Measured,
) -> Float64[np.ndarray, " r"]:
    """Of measurements and proportions, in standard deviations."""
    body = Body(Proportions(*found.tolist()), size_lwh_m)
    unit = np.float64(1 / (_NOISE_M * np.sqrt(_CORRELATED)))
    surface = unit * body.distance_m(seen.surface_actor.astype(np.float64))
    inside = np.maximum(-body.distance_m(seen.free_actor.astype(np.float64)), 0.0)
    free = unit * inside * np.sqrt(seen.free_weight)
    return np.concatenate([_robust(surface), _robust(free), (found - np.array(prior)) / deviation])


def _robust(residual: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Square roots of Charbonnier's loss, with the residual's sign."""
    return np.sign(residual) * np.sqrt(2 * (np.sqrt(1 + residual**2) - 1))


def _cost(
    found: Proportions,
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    seen: Measured,
) -> float:
    residuals = _residuals(np.array(found), prior, deviation, size_lwh_m, seen)
    return float(residuals @ residuals)


def _refined(
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    seen: Measured,
) -> tuple[float, Proportions]:
    """Cost and proportions after a bounded least-squares fit from the prior on."""
    from scipy.optimize import least_squares

    start = np.array(prior)
    fit = least_squares(
        _residuals,
        start,
        args=(prior, deviation, size_lwh_m, seen),
        bounds=(start - 4 * deviation, start + 4 * deviation),
        x_scale=deviation,
        diff_step=1e-3,
        max_nfev=_ROUNDS,
    )
    return 2 * float(fit.cost), Proportions(*fit.x.tolist())
