"""Leaves as cards: what rays, shadows and files understand, as dense as beams found a crown."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.statistics import weighted_median
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.materials import VEGETATION
from lightsim.geometry.surface import keep_faces, quad_mesh

# Edge of a card: so much near by, and this fraction of the distance from the path further away.
_LEAST_CARD_M, _MOST_CARD_M, _CARD = 0.15, 0.4, 1 / 120
# Parts of a voxel along each axis, about as large as a card.
_PARTS = 3
_MEAN_COSINE = 0.5
"""Of a direction with normals that point anywhere: a card stops, on average, half of its area (Ross
1981, The radiation regime and architecture of plant stands)."""


def without_shreds(mesh: TriMesh, crowns: Crowns) -> TriMesh:
    """A measured surface without what a grid of samples made of crowns."""
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    return keep_faces(mesh, ~crowns.contain(centres))


def crown_cards(crowns: Crowns, rng: np.random.Generator) -> TriMesh:
    """Square cards of random orientation that stop as much light as the leaves did; black, frame
    world, measured, fronts towards the path.

    The area of leaves in a voxel is its volume times extinction over the mean cosine. Cards stand
    at returns, and anywhere in the voxel where it has too few.
    """
    middle = crowns.middle_m
    edge, count = _sizes(crowns, middle, crowns.voxel_m, crowns.extinction, rng)
    first = crowns.first_return
    voxel = np.repeat(np.arange(len(middle)), np.diff(first))
    order = _spread(crowns, voxel, rng)
    rank = np.arange(len(voxel)) - first[voxel]
    chosen = order[rank < count[voxel]]
    rest = np.repeat(np.arange(len(middle)), np.maximum(count - np.diff(first), 0))
    anywhere = middle[rest] + (rng.random((len(rest), 3)) - 0.5) * crowns.voxel_m
    centres = np.concatenate([crowns.returns_m[chosen], anywhere])
    cards = _cards(crowns, centres, edge[np.concatenate([voxel[chosen], rest])], rng)
    return cards.with_provenance(Provenance.MEASURED)


def _spread(
    crowns: Crowns, voxel: Int64[np.ndarray, " r"], rng: np.random.Generator
) -> Int64[np.ndarray, " r"]:
    """Order of the returns, voxel by voxel: one from each part of the voxel, then the second ones.
    Several returns of one leaf would make a clump of cards, which lets more light through."""
    place = (crowns.returns_m - crowns.low_m) / crowns.voxel_m
    part = np.floor(_PARTS * (place - np.floor(place))).astype(np.int64) @ [_PARTS**2, _PARTS, 1]
    key = voxel * _PARTS**3 + part
    shuffled = rng.permutation(len(key))
    by_part = shuffled[np.argsort(key[shuffled], kind="stable")]
    _, start, size = np.unique(key[by_part], return_index=True, return_counts=True)
    turn = np.zeros(len(key), np.int64)
    turn[by_part] = np.arange(len(key)) - np.repeat(start, size)
    return np.lexsort((rng.random(len(key)), turn, voxel))


def cards_above(
    crowns: Crowns, middle: Float64[np.ndarray, "n 3"], cell_m: float, rng: np.random.Generator
) -> TriMesh:
    """The same in cells that no beam reached, as dense as the crown is elsewhere and no denser than
    most are: of distant ones only fronts stop beams. Inferred.

    Args:
        middle: of the cells, frame world.
        cell_m: their edge.
    """
    if not len(middle):
        return _cards(crowns, middle, np.zeros(0), rng).with_provenance(Provenance.INFERRED)
    usual = crowns.usual_extinction
    returns = np.bincount(crowns.crown, np.diff(crowns.first_return), len(crowns))
    usual = np.minimum(usual, weighted_median(usual[:, None], returns))
    own = crowns.crown[KDTree(crowns.middle_m).query(middle)[1]]
    edge, count = _sizes(crowns, middle, cell_m, usual[own], rng)
    cell = np.repeat(np.arange(len(middle)), count)
    centres = middle[cell] + (rng.random((len(cell), 3)) - 0.5) * cell_m
    return _cards(crowns, centres, edge[cell], rng).with_provenance(Provenance.INFERRED)


def _sizes(
    crowns: Crowns,
    middle: Float64[np.ndarray, "n 3"],
    cell_m: float,
    extinction: Float64[np.ndarray, " n"],
    rng: np.random.Generator,
) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Edge of the cards in each cell, and how many; rounded at random, so that sums are right."""
    eyes = crowns.nearest_eyes(middle)
    distance = np.linalg.norm((middle - eyes)[:, :2], axis=1)
    edge = np.clip(_CARD * distance, _LEAST_CARD_M, _MOST_CARD_M)
    wanted = extinction * cell_m**3 / (_MEAN_COSINE * edge**2)
    return edge, np.floor(wanted + rng.random(len(wanted))).astype(np.int64)


def _cards(
    crowns: Crowns,
    centres: Float64[np.ndarray, "c 3"],
    edge_m: Float64[np.ndarray, " c"],
    rng: np.random.Generator,
) -> TriMesh:
    """Squares whose normals point anywhere within the hemisphere towards the path: cameras see
    their fronts."""
    normal, other = (rng.standard_normal(centres.shape) for _ in range(2))
    towards = crowns.nearest_eyes(centres) - centres
    normal *= np.where((normal * towards).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    along = np.cross(normal, other)
    sides = []
    for side in (along, np.cross(normal, along)):
        length = np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
        sides.append(0.5 * edge_m[:, None] * side / length)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = np.stack([centres + a * sides[0] + b * sides[1] for a, b in signs], axis=1)
    quads = np.arange(4 * len(centres)).reshape(-1, 4)
    return quad_mesh(corners.reshape(-1, 3), quads, VEGETATION)
