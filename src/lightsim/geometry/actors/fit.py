"""Robust maximum a posteriori fit of a vehicle's proportions to LiDAR measurements.

The prior is Gaussian around the typical proportions of a body type. Several types are fitted, and
the most probable one is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorKind
from lightsim.core.statistics import charbonnier_roots
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
"""Kinds of actors that have a parametric body."""

# Sensitivity of the fit to these constants is not measured.

# Standard deviation of measured distances; the loss is linear far beyond it.
_NOISE_M = 0.04
# Number of neighbouring samples with the weight of one, since their errors are correlated.
_CORRELATED = 8.0
# Fraction of a lorry's length, from the front, that has side windows.
_CAB_FRACTION = 0.3
# Penalty on types other than the typical one of the box, as twice the negative log-likelihood.
_OTHER_TYPE = 8.0
# Number of body types that are fitted, in order of their initial cost; limits the time.
_MAX_FITTED_TYPES = 2


@dataclass(frozen=True, eq=False)
class VehicleMeasurements:
    """Measurements of a vehicle, frame `actor`.

    Args:
        surface_actor: points of its surface.
        free_actor: points in free space.
        free_weight: weight of each free point, at most 1.
    """

    surface_actor: Float[np.ndarray, "n 3"]
    free_actor: Float[np.ndarray, "m 3"]
    free_weight: Float[np.ndarray, " m"]


def typical_body(kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"]) -> Body:
    """Return the most likely body of a vehicle by its kind and its box alone."""
    types = _TYPES[kind]
    if types[0] is not SEDAN:
        return _body(kind, types[0], size_lwh_m)
    length, _, height = (float(v) for v in size_lwh_m)
    # Usual sizes of passenger cars, in metres; sensitivity not measured.
    if height >= 1.85:
        return Body(VAN, size_lwh_m)
    is_sedan = length > 4.3 and height < 1.6
    return Body(SEDAN if is_sedan else HATCHBACK, size_lwh_m)


def fit_body(
    kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"], measured: VehicleMeasurements
) -> Body:
    """Return the most probable body given the measurements; the typical one without any.

    Raises:
        KeyError: the kind has no body (see `HAS_BODY`).
    """
    typical = typical_body(kind, size_lwh_m)
    if len(measured.surface_actor) == 0:
        return typical
    deviation = np.array(DEVIATION)

    def penalty(prior: Proportions) -> float:
        return 0.0 if prior is typical.proportions else _OTHER_TYPE

    ranked = sorted(
        _TYPES[kind],
        key=lambda prior: _cost(prior, prior, deviation, size_lwh_m, measured) + penalty(prior),
    )
    fits = []
    for prior in ranked[:_MAX_FITTED_TYPES]:
        cost, found = _refined(prior, deviation, size_lwh_m, measured)
        fits.append((cost + penalty(prior), found))
    return _body(kind, min(fits, key=lambda fit: fit[0])[1], size_lwh_m)


def _body(kind: ActorKind, found: Proportions, size_lwh_m: Float[np.ndarray, "3"]) -> Body:
    return Body(found, size_lwh_m, _CAB_FRACTION if kind is ActorKind.TRUCK else 1.0)


def _residuals(
    found: Float64[np.ndarray, " p"],
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    measured: VehicleMeasurements,
) -> Float64[np.ndarray, " r"]:
    """Return the residuals of measurements and proportions, in standard deviations."""
    body = Body(Proportions(*found.tolist()), size_lwh_m)
    unit = np.float64(1 / (_NOISE_M * np.sqrt(_CORRELATED)))
    points = np.concatenate([measured.surface_actor, measured.free_actor]).astype(np.float64)
    distance = unit * body.distance_m(points)
    # Free points are an error only inside the body.
    free = distance[len(measured.surface_actor) :]
    free[:] = np.maximum(-free, 0.0) * np.sqrt(measured.free_weight)
    return np.concatenate([charbonnier_roots(distance), (found - np.array(prior)) / deviation])


def _cost(
    found: Proportions,
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    measured: VehicleMeasurements,
) -> float:
    residuals = _residuals(np.array(found), prior, deviation, size_lwh_m, measured)
    return float(residuals @ residuals)


def _refined(
    prior: Proportions,
    deviation: Float64[np.ndarray, " p"],
    size_lwh_m: Float[np.ndarray, "3"],
    measured: VehicleMeasurements,
) -> tuple[float, Proportions]:
    """Return cost and proportions of a least-squares fit that starts at the prior (Levenberg-
    Marquardt, Moré 1978, doi:10.1007/BFb0067700)."""
    from scipy.optimize import least_squares

    fit = least_squares(
        _residuals,
        np.array(prior),
        args=(prior, deviation, size_lwh_m, measured),
        # SciPy's other methods decompose Jacobians by BLAS, whose two threads took seven times as
        # much processor time on busy cores.
        method="lm",
        x_scale=deviation,
        diff_step=1e-3,
        # Differs from a tolerance of 1e-10 by at most 4 mm on 37 cars of a street.
        ftol=1e-4,
    )
    # SciPy's cost is half the sum of squares, `_cost` the whole sum.
    return 2 * float(fit.cost), Proportions(*fit.x.tolist())
