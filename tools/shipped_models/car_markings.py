"""What the surface of a car's body shows: panes, trim, lamps, seams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from tools.shipped_models.car_body import CarBody
from tools.shipped_models.level_set import Field, Points, Shape, grown
from tools.shipped_models.painted_mesh import PaintedMesh

_PILLAR_M, _SEAL_M, _SEAM_M = 0.075, 0.018, 0.012
"""Paint beside panes, black around them, and seams: their widths."""
_LEAST_SILL = 0.6
"""Side panes begin at the belt line, or at this part of the height if that is higher."""


def with_markings(mesh: PaintedMesh, body: CarBody) -> PaintedMesh:
    """The body's mesh with looks on it, the later over the earlier."""
    for line, limits in _seams(body):
        mesh = mesh.lined("black", line, limits, _SEAM_M)
    for look, shape in _trim(body) + _panes(body) + _lamps(body):
        mesh = mesh.painted(look, shape)
    return mesh


def _seams(body: CarBody) -> list[tuple[Shape, Shape]]:
    """Of doors, boot and bonnet: edges of the first shape where the second is negative."""
    design, p = body.design, body.design.proportions
    cowl, deck, tail, rear = (body.corners[k] for k in (3, 7, 8, 9))
    belt, sill = p.belt_height * design.height_m, (p.clearance + 0.09) * design.height_m
    half = design.width_m / 2
    doors = [0.5 * (p.cowl + p.front_wheel) + 0.055, *design.pillars]
    if design.panes_to < 1:
        doors.append(0.72)

    def door(u: float) -> Shape:
        return lambda v: v[:, 0] - body.ahead_m(u)

    def flank(v: Points) -> Field:
        return np.max([body.side_m(v) + 0.12, sill - v[:, 2], v[:, 2] - belt], axis=0)

    def boot(v: Points) -> Field:
        return np.maximum(np.abs(v[:, 1]) - 0.74 * half, 0.62 * tail[1] - v[:, 2])

    def rear_end(v: Points) -> Field:
        return np.maximum(v[:, 0] - rear[0] - 0.3, v[:, 2] - max(deck[1], tail[1]))

    def bonnet(v: Points) -> Field:
        return np.abs(v[:, 1]) - 0.8 * half

    def front_top(v: Points) -> Field:
        return np.maximum(cowl[0] - 0.03 - v[:, 0], 0.8 * cowl[1] - v[:, 2])

    return [*((door(u), flank) for u in doors), (boot, rear_end), (bonnet, front_top)]


def _trim(body: CarBody) -> list[tuple[str, Shape]]:
    """Sills, the ends' lower edges, the air intake."""
    design, p = body.design, body.design.proportions
    front, half = body.corners[1][0], design.width_m / 2
    sill = (p.clearance + 0.05) * design.height_m
    intake = (0.135 + 0.2 * p.hood_height) * design.height_m + 0.03

    def ends(v: Points) -> Field:
        x, y, z = np.abs(v).T
        return np.max([z - sill - 0.12, y - 0.72 * half, front - 0.1 - x], axis=0)

    def grille(v: Points) -> Field:
        x, y, z = v.T
        limits = [np.abs(z - intake) - 0.09, np.abs(y) - 0.62 * half, front - 0.3 - x]
        return np.max(limits, axis=0)

    return [("plastic", lambda v: v[:, 2] - sill), ("plastic", ends), ("plastic", grille)]


def _panes(body: CarBody) -> list[tuple[str, Shape]]:
    """Each with its seal; dark pillars between side panes."""
    design, p = body.design, body.design.proportions
    _, _, _, cowl, roof_front, _, roof_rear, deck = body.corners[:8]
    least = _LEAST_SILL if design.panes_to == 1 else 0.0
    sill, roof = max(p.belt_height, least) * design.height_m, (p.roof_height - 0.05)

    def side(v: Points) -> Field:
        x, _, z = v.T
        limits = [sill - z, body.side_m(v) + _PILLAR_M, z - roof * design.height_m]
        return np.max([*limits, body.ahead_m(design.panes_to) - x], axis=0)

    def pillar(u: float) -> Shape:
        return lambda v: np.maximum(np.abs(v[:, 0] - body.ahead_m(u)) - 0.035, side(v))

    panes = [side, *(_Screen(body, *ends) for ends in ((cowl, roof_front), (deck, roof_rear)))]
    found: list[tuple[str, Shape]] = []
    for pane in panes:
        found += [("plastic", grown(pane, _SEAL_M)), ("car_glass", pane)]
    return [*found, *(("plastic", pillar(u)) for u in design.pillars)]


@dataclass(frozen=True, eq=False)
class _Screen:
    """The pane between two corners of the profile, from pillar to pillar."""

    body: CarBody
    low: Float64[np.ndarray, "2"]
    high: Float64[np.ndarray, "2"]

    def __call__(self, v: Points) -> Field:
        x, y, z = v.T
        length = np.hypot(*(self.high - self.low))
        ahead, up = (self.high - self.low) / length
        along = (x - self.low[0]) * ahead + (z - self.low[1]) * up
        across = np.abs(y) - self.body.half_width_m(x, z) + _PILLAR_M
        limits = [0.03 - along, along - length + 0.07, self.low[1] - z]
        return np.max([*limits, -0.07 - self.body.side_m(v), across], axis=0)


def _lamps(body: CarBody) -> list[tuple[str, Shape]]:
    """Around the corners of both ends."""
    half = body.design.width_m / 2
    _, front, hood = body.corners[:3]
    tail, rear = body.corners[8:10]

    def corner(v: Points, z: float, high: float, inner: float) -> Field:
        return np.maximum(np.abs(v[:, 2] - z) - high, inner * half - np.abs(v[:, 1]))

    def head(high: float, inner: float) -> Shape:
        return lambda v: np.maximum(
            corner(v, hood[1] - 0.07, high, inner), front[0] - 0.34 - v[:, 0]
        )

    def back(v: Points) -> Field:
        return np.maximum(corner(v, tail[1] - 0.13, 0.085, 0.62), v[:, 0] - rear[0] - 0.22)

    return [("plastic", head(0.058, 0.55)), ("lamp", head(0.042, 0.56)), ("tail", back)]
