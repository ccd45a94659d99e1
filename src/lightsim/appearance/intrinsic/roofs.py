"""Roofs that no view reaches, found from the shadows that they cast in the pictures.

The sun is one more camera: what it lights, it sees. A lit patch proves that nothing stands on its
way to the sun, a shadowed one that something does (shadow carving, Savarese et al. 2007,
doi:10.1007/s11263-006-8323-9). Where that way crosses a wall's plane above all that was seen of
it, patches vote for the height of its roof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.special import ndtr

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.labels import (
    Observed,
    label_shadows,
    rendered_visibility,
    softened_prior,
)
from lightsim.core.buildings import Roofline
from lightsim.core.profiles import energy_of_filling

# Patches this near to a wall's plane belong to it.
_OFF_WALL_M = 0.3
# Walls that the sun meets at a smaller cosine, and those with fewer patches, stay as they are.
_LEAST_COSINE, _LEAST_PATCHES = 0.05, 200
# All patches behind one roof are wrong together where it is: none of them may be sure.
_LEAST_OPEN = 0.2
# A label this sure is a vote.
_SURE = 0.7
# Of one vote, and of all for a cell at most, nats. Not measured alone.
_VOTE, _VOTES = 0.1, 1.0


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Patches whose way to the sun crosses the unseen part of one wall.

    Args:
        rows: the patches.
        column: of the wall.
        z_m: height of the crossing.
    """

    rows: Int64[np.ndarray, " k"]
    column: Int64[np.ndarray, " k"]
    z_m: Float64[np.ndarray, " k"]


def carve_roofs(
    rooflines: Sequence[Roofline],
    observed: Observed,
    sun_world: Float[np.ndarray, "3"],
    config: IntrinsicConfig,
) -> list[Roofline]:
    """The rooflines with the heights that shadows ask for; those that views show stay.

    Args:
        rooflines: as views and priors have them.
        observed: patches of the street; `visibility` without and with the prisms of `rooflines`.
        sun_world: direction towards the sun.
        config: how shadows are found.
    """
    crossings = {k: _crossings(r, observed, sun_world) for k, r in enumerate(rooflines)}
    crossings = {k: c for k, c in crossings.items() if len(c.rows) >= _LEAST_PATCHES}
    if not crossings:
        return list(rooflines)
    believed = rendered_visibility(observed.light)
    rows = np.concatenate([c.rows for c in crossings.values()])
    believed[rows] = 1.0
    for k, crossing in crossings.items():
        believed[crossing.rows] *= _open_probability(rooflines[k], crossing)
    prior = softened_prior(believed, observed.graph, config)
    lit = label_shadows(observed, config, prior).lit
    return [
        roofline.solved(_votes(roofline, crossings[k], lit)) if k in crossings else roofline
        for k, roofline in enumerate(rooflines)
    ]


def _crossings(
    roofline: Roofline, observed: Observed, sun_world: Float[np.ndarray, "3"]
) -> _Crossings:
    wall = roofline.wall
    cosine = float(wall.normal @ sun_world)
    nothing = np.zeros(0, dtype=np.int64)
    if cosine > -_LEAST_COSINE or roofline.is_seen.all():
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
    """That the roof lies below each crossing, before shadows are asked."""
    height = np.maximum(crossing.z_m - roofline.ground_m[crossing.column], roofline.cell_m)
    expected = np.maximum(roofline.height_m[crossing.column], roofline.cell_m)
    below = np.asarray(ndtr(np.log(height / expected) / roofline.log_std))
    return _LEAST_OPEN + (1 - 2 * _LEAST_OPEN) * below


def _votes(
    roofline: Roofline, crossing: _Crossings, lit: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "s t"]:
    """Nats against each top."""
    shape = (roofline.energy.shape[0], roofline.energy.shape[1] - 1)
    cell = np.floor((crossing.z_m - roofline.wall.height_m[0]) / roofline.cell_m).astype(np.int64)
    is_inside = cell < shape[1]
    counts = []
    for is_sure in (lit[crossing.rows] > _SURE, lit[crossing.rows] < 1 - _SURE):
        count = np.zeros(shape)
        chosen = is_inside & is_sure
        np.add.at(count, (crossing.column[chosen], cell[chosen]), 1.0)
        counts.append(np.minimum(_VOTE * count, _VOTES))
    return energy_of_filling(*counts)
