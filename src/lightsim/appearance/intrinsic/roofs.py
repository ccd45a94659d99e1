"""Heights of unobserved roof edges, estimated from the shadows that they cast in the images.

The ray from a lit patch to the sun is free, and the ray from a shadowed patch is occluded (shadow
carving, Savarese et al. 2007, doi:10.1007/s11263-006-8323-9). Where such rays cross the plane of a
wall above its observed part, they constrain the height of its roof edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.special import ndtr

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.labels import (
    ObservedSurfels,
    label_shadows,
    rendered_visibility,
    softened_prior,
)
from lightsim.core.buildings import Roofline
from lightsim.core.profiles import energy_of_filling

# The values below were chosen on synthetic streets; their sensitivity was not measured.

# Distance in metres within which patches belong to the wall itself.
_OFF_WALL_M = 0.3
# Least cosine between the sun's direction and a wall's normal.
_MIN_COSINE = 0.05
# Least number of patches whose rays cross one wall.
_MIN_PATCHES = 200
# Least prior probability of a free and of an occluded ray: an error of the roof affects all patches
# behind it, so none of them is certain.
_MIN_OPEN = 0.2
# Least probability of a label that counts.
_CERTAIN = 0.7
# Log-likelihood of one label, in nats: far below that of an independent observation, as errors of
# neighbours are correlated.
_LABEL_NATS = 0.1
# Greatest sum of these for one cell of a wall.
_CELL_NATS = 1.0


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Patches whose ray to the sun crosses the unobserved part of one wall's plane.

    Args:
        rows: indices of the patches.
        column: column of the wall that each ray crosses.
        z_m: height of the crossing, frame world.
    """

    rows: Int64[np.ndarray, " k"]
    column: Int64[np.ndarray, " k"]
    z_m: Float64[np.ndarray, " k"]


def carve_roofs(
    rooflines: Sequence[Roofline],
    observed: ObservedSurfels,
    sun_world: Float[np.ndarray, "3"],
    config: IntrinsicConfig,
) -> list[Roofline]:
    """Estimate the unobserved heights of rooflines from shadows; observed ones are unchanged.

    Args:
        rooflines: estimates from views and priors.
        observed: patches of the street; the two columns of `visibility` are without and with the
            prisms of `rooflines`.
        sun_world: direction towards the sun.
        config: settings of the shadow labels.
    """
    crossings = {k: _crossings(r, observed, sun_world) for k, r in enumerate(rooflines)}
    crossings = {k: c for k, c in crossings.items() if len(c.rows) >= _MIN_PATCHES}
    if not crossings:
        return list(rooflines)
    # Behind unobserved roofs the prior of the labels is the roof's own uncertainty instead of the
    # rendering of one estimate.
    visibility = rendered_visibility(observed.light)
    rows = np.concatenate([c.rows for c in crossings.values()])
    visibility[rows] = 1.0
    for k, crossing in crossings.items():
        visibility[crossing.rows] *= _open_probability(rooflines[k], crossing)
    prior = softened_prior(visibility, observed.graph, config)
    lit = label_shadows(observed, config, prior).lit
    return [
        roofline.solved(_top_energies(roofline, crossings[k], lit)) if k in crossings else roofline
        for k, roofline in enumerate(rooflines)
    ]


def _crossings(
    roofline: Roofline, observed: ObservedSurfels, sun_world: Float[np.ndarray, "3"]
) -> _Crossings:
    wall = roofline.wall
    cosine = float(wall.normal @ sun_world)
    nothing = np.zeros(0, dtype=np.int64)
    if cosine > -_MIN_COSINE or roofline.is_seen.all():
        return _Crossings(nothing, nothing, np.zeros(0))
    light, places = observed.light, observed.surfels.position.astype(np.float64)
    _, front_m = wall.place(places)
    crossing = places - (front_m / cosine)[:, None] * sun_world
    s, _ = wall.place(crossing)
    column = np.floor((s - wall.span_m[0]) / roofline.cell_m).astype(np.int64)
    is_on = (front_m > _OFF_WALL_M) & (column >= 0) & (column < len(roofline.top))
    is_on &= light.is_lit_enough & (light.visibility[:, 0] > 0.5)
    column = np.where(is_on, column, 0)
    shown_m = wall.height_m[0] + roofline.cell_m * roofline.shown
    is_on &= ~roofline.is_seen[column] & (crossing[:, 2] > shown_m[column])
    rows = np.flatnonzero(is_on)
    return _Crossings(rows, column[rows], crossing[rows, 2])


def _open_probability(roofline: Roofline, crossing: _Crossings) -> Float64[np.ndarray, " k"]:
    """Prior probability that the roof edge is below each crossing."""
    height = np.maximum(crossing.z_m - roofline.ground_m[crossing.column], roofline.cell_m)
    expected = np.maximum(roofline.height_m[crossing.column], roofline.cell_m)
    below = np.asarray(ndtr(np.log(height / expected) / roofline.log_std))
    return _MIN_OPEN + (1 - 2 * _MIN_OPEN) * below


def _top_energies(
    roofline: Roofline, crossing: _Crossings, lit: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "s t"]:
    """Energy of each possible roof height in each column, in nats."""
    shape = (roofline.energy.shape[0], roofline.energy.shape[1] - 1)
    cell = np.floor((crossing.z_m - roofline.wall.height_m[0]) / roofline.cell_m).astype(np.int64)
    is_inside = cell < shape[1]
    counts = []
    for is_certain in (lit[crossing.rows] > _CERTAIN, lit[crossing.rows] < 1 - _CERTAIN):
        count = np.zeros(shape)
        chosen = is_inside & is_certain
        np.add.at(count, (crossing.column[chosen], cell[chosen]), 1.0)
        counts.append(np.minimum(_LABEL_NATS * count, _CELL_NATS))
    return energy_of_filling(*counts)
