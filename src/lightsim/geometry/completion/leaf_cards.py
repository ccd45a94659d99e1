"""Foliage as square cards with the extinction that beams measured."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.statistics import weighted_median
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.materials import VEGETATION
from lightsim.geometry.surface import keep_faces, quad_mesh

# Least and greatest edge of a card, in metres.
_CARD_M = (0.15, 0.4)
# Edge of a card as a fraction of its distance from the path: about half a degree.
_CARD = 1 / 120
# Parts of a voxel along each axis among which cards are distributed; a part is about as large as a
# card.
_PARTS = 3
# Mean cosine between a direction and normals of uniform distribution: a card stops, on average,
# half of its area (Ross 1981, The radiation regime and architecture of plant stands).
_MEAN_COSINE = 0.5


def without_crown_surface(mesh: TriMesh, crowns: Crowns) -> TriMesh:
    """Remove the measured surface within crowns, which is replaced by cards."""
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    return keep_faces(mesh, ~crowns.contain(centres))


def crown_cards(crowns: Crowns, rng: np.random.Generator) -> TriMesh:
    """Return square cards of random orientation with the extinction of the leaves.

    The mesh is black, frame world, measured; fronts face the path. The area of leaves in a voxel is
    its volume times extinction divided by the mean cosine. Cards are placed at returns, and at
    random in the voxel where it has too few.

    Args:
        crowns: measured crowns.
        rng: random generator.
    """
    middle = crowns.middle_m
    edge, count = _sizes(crowns, middle, crowns.voxel_m, crowns.extinction, rng)
    first = crowns.first_return
    voxel = np.repeat(np.arange(len(middle)), np.diff(first))
    order = _dispersed(crowns, voxel, rng)
    rank = np.arange(len(voxel)) - first[voxel]
    chosen = order[rank < count[voxel]]
    rest = np.repeat(np.arange(len(middle)), np.maximum(count - np.diff(first), 0))
    anywhere = middle[rest] + (rng.random((len(rest), 3)) - 0.5) * crowns.voxel_m
    centres = np.concatenate([crowns.returns_m[chosen], anywhere])
    cards = _cards(crowns, centres, edge[np.concatenate([voxel[chosen], rest])], rng)
    return cards.with_provenance(Provenance.MEASURED)


def _dispersed(
    crowns: Crowns, voxel: Int64[np.ndarray, " r"], rng: np.random.Generator
) -> Int64[np.ndarray, " r"]:
    """Order the returns of each voxel so that successive returns lie in different parts of it.

    Several cards at returns of one leaf would overlap and let more light through.
    """
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
    """Return cards in cells that no beam reached; inferred.

    Their extinction is the median of the crown's voxels, limited to the median of all crowns,
    because only the fronts of distant crowns stop beams.

    Args:
        crowns: measured crowns.
        middle: centres of the cells, frame world.
        cell_m: edge of the cells.
        rng: random generator.
    """
    if not len(middle):
        return _cards(crowns, middle, np.zeros(0), rng).with_provenance(Provenance.INFERRED)
    usual = crowns.median_extinction
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
    """Return the edge of each cell's cards, and their number, rounded at random."""
    eyes = crowns.nearest_path_points(middle)
    distance = np.linalg.norm((middle - eyes)[:, :2], axis=1)
    edge = np.clip(_CARD * distance, *_CARD_M)
    wanted = extinction * cell_m**3 / (_MEAN_COSINE * edge**2)
    return edge, np.floor(wanted + rng.random(len(wanted))).astype(np.int64)


def _cards(
    crowns: Crowns,
    centres: Float64[np.ndarray, "c 3"],
    edge_m: Float64[np.ndarray, " c"],
    rng: np.random.Generator,
) -> TriMesh:
    """Return squares with normals of uniform distribution in the hemisphere towards the path."""
    normal, other = (rng.standard_normal(centres.shape) for _ in range(2))
    towards = crowns.nearest_path_points(centres) - centres
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
