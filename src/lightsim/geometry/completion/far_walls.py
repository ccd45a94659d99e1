"""Walls with too few returns for a mesh: far ends of rows, fronts of cross streets, and side walls
above low roofs.

Their returns lie on one upright plane to within centimetres, hardly any beam passes through it, and
no view shows sky there, as it would between wires. Without these walls the background proxy would
show them at a wrong distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.planes import THICKNESS_M, Pieces, walls_among
from lightsim.geometry.completion.view_evidence import WALL_VIEW_M, ViewEvidence
from lightsim.geometry.completion.walls import lie_on

# The values below were chosen on streets 0 and 731; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).


class _Returns:
    """Returns that may belong to walls without a mesh."""

    lowest_m = 0.8  # Height above the ground from which they are used.
    known_m = 0.6  # Distance from known surface within which they are explained.
    thin_m = 0.25  # Edge of the cubes of which one return each is used.
    cell_m = 1.0  # Edge of the cubes in which returns represent one square of a wall.
    around_m = 1.0  # Radius in plan around a return in which its normal is estimated.


# Least fraction of the beams towards a wall that end on it. Candidates on streets 0 and 731 have
# below .45 (trees, hedges, cars) or above .75 (walls).
_MIN_STOPPED = 0.6
# Greatest fraction of lines of sight to a wall that end in the sky.
_MAX_SKY = 0.1
# Height of the lowest returns up to which a wall reaches the ground, in metres: low roofs are
# higher.
_NEAR_GROUND_M = 3.0
# Depth of a wall's foot below the ground, in metres, so that no gap opens there.
_FOOT_M = 0.25


def find_far_walls(
    known: Sequence[Wall],
    beams: Beams,
    evidence: ViewEvidence,
    crowns: Crowns,
    ground: GroundMap,
    caster: RayCaster,
) -> list[Wall]:
    """Find upright planes with returns that neither a mesh nor a known wall explains, greatest
    first.

    Args:
        known: walls that are known already.
        beams: beams that ended on static surfaces.
        evidence: the views of the log.
        crowns: foliage, which explains returns.
        ground: height of the walls' feet.
        caster: over the measured background and vehicles at rest.

    Raises:
        InputError: a matte does not fit its camera.
    """
    new = _unexplained(known, beams, crowns, ground, caster)
    return [
        _on_ground(wall, ground)
        for wall in walls_among(_pieces(new))
        if _stops_beams(wall, beams) and not _shows_sky(wall, evidence)
    ]


def _unexplained(
    known: Sequence[Wall], beams: Beams, crowns: Crowns, ground: GroundMap, caster: RayCaster
) -> Beams:
    """Return a subsample of the beams that ended above the ground and away from known surface."""
    height = beams.ends[:, 2] - ground.look_up(beams.ends[:, :2].astype(np.float64))
    high = beams.select(height > _Returns.lowest_m)
    high = high.select(np.unique(_cubes(high.ends, _Returns.thin_m), axis=0, return_index=True)[1])
    origins, ends = high.origins.astype(np.float64), high.ends.astype(np.float64)
    way = ends - origins
    distance = np.linalg.norm(way, axis=1)
    hits = caster.intersect(origins, way / np.maximum(distance, 1e-9)[:, None])
    is_new = (hits.distance_m > distance + _Returns.known_m) & ~crowns.contain(ends)
    is_new &= ~lie_on(known, ends, _Returns.known_m)
    return high.select(is_new)


def _cubes(points: Float[np.ndarray, "n 3"], edge_m: float) -> Int64[np.ndarray, "n 3"]:
    return np.floor(points / edge_m).astype(np.int64)


def _pieces(beams: Beams) -> Pieces:
    """Return a piece of surface for each return.

    Its normal is perpendicular to the line fitted in plan to the returns around it. The returns in
    a cube share the area of one of its sides.
    """
    points = beams.ends.astype(np.float64)
    _, cube, count = np.unique(
        _cubes(points, _Returns.cell_m), axis=0, return_inverse=True, return_counts=True
    )
    xy, area = points[:, :2], _Returns.cell_m**2 / count[cube.reshape(-1)]
    tree = KDTree(xy)
    pairs = tree.query_pairs(_Returns.around_m, output_type="ndarray")
    spread = np.zeros((len(xy), 2, 2))
    for own, other in (pairs.T, pairs.T[::-1]):
        offset = xy[other] - xy[own]
        np.add.at(spread, own, area[other, None, None] * offset[:, :, None] * offset[:, None, :])
    normal = np.linalg.eigh(spread)[1][:, :, 0]
    is_away = ((beams.origins[:, :2] - xy) * normal).sum(axis=1) < 0
    return Pieces(points[:, None], np.where(is_away[:, None], -normal, normal), area)


def _stops_beams(wall: Wall, beams: Beams) -> bool:
    """Return whether most beams that reach a wall end on its plane instead of behind it."""
    start, end = (
        ((places - wall.origin_m) @ wall.normal).astype(np.float64)
        for places in (beams.origins, beams.ends)
    )
    reaching = np.flatnonzero((start > 0) & (end < THICKNESS_M))
    start, end = start[reaching], end[reaching]
    beams = beams.select(reaching)
    origins = beams.origins.astype(np.float64)
    place = origins + (start / (start - end))[:, None] * (beams.ends - origins)
    s, _ = wall.place(place)
    is_in = (s > wall.span_m[0]) & (s < wall.span_m[1])
    is_in &= (place[:, 2] > wall.height_m[0]) & (place[:, 2] < wall.height_m[1])
    is_stopped = end[is_in] > -THICKNESS_M
    return bool(is_stopped.sum() >= max(1, _MIN_STOPPED * len(is_stopped)))


def _shows_sky(wall: Wall, evidence: ViewEvidence) -> bool:
    """Return whether views show sky at a wall."""
    shape = [max(1, int((b - a) / _Returns.cell_m)) for a, b in (wall.span_m, wall.height_m)]
    places = wall.at(*wall.grid(_Returns.cell_m, tuple(shape))).reshape(-1, 3)
    classes = [
        view.classes_at(view.sightlines(places, WALL_VIEW_M)) > 0 for view in evidence.views()
    ]
    is_sky = np.concatenate([np.zeros(0, dtype=bool), *classes])
    return bool(is_sky.sum() > _MAX_SKY * len(is_sky))


def _on_ground(wall: Wall, ground: GroundMap) -> Wall:
    """Extend a wall with a low foot to the ground 1 m in front of it."""
    places = wall.at(np.linspace(*wall.span_m, 5), np.zeros(5), 1.0)
    lowest = float(ground.look_up(places[:, :2]).min())
    low, high = wall.height_m
    foot = lowest if low - lowest < _NEAR_GROUND_M else low
    return replace(wall, height_m=(foot - _FOOT_M, high))
