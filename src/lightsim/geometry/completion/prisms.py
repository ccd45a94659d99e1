"""Parts of buildings that no view shows: tops of near walls, roofs, rear and side walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Float64, Shaped

from lightsim.core.buildings import Roofline
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.completion.neighbours import INSET_M
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import quad_mesh

# Depth of the unobserved part of a wall behind its plane, in metres, so that it does not shade the
# measured part.
_SETBACK_M = 0.15
# Distance behind the front at which side walls begin, and within which a measured parallel wall
# replaces a side or rear wall, in metres; panes deviate inwards by as much.
_CLEARANCE_M = 1.2
# Number of test points along each edge of a wall.
_SAMPLES = 6
# Least absolute cosine between the normals of parallel walls.
_PARALLEL = 0.8
# Fraction of test points on a measured wall above which the wall is already present.
_PRESENT_FRACTION = 0.1


def unobserved_building_parts(
    rooflines: Sequence[Roofline], background: TriMesh, *, make_caster: MakeCaster
) -> TriMesh:
    """Return the unobserved parts of buildings as a mesh that only casts shadows.

    Args:
        rooflines: roofline of each wall.
        background: visible surfaces; no side or rear wall is added where it has one.
        make_caster: builds the ray caster.

    Returns:
        A mesh in frame world, black, inferred; it may be empty.
    """
    parts = [_parts(roofline) for roofline in rooflines]
    quads = np.concatenate([np.zeros((0, 4, 3)), *(quads for quads, _ in parts)])
    is_kept = np.concatenate([np.zeros(0, dtype=bool), *(is_hidden for _, is_hidden in parts)])
    candidates = np.flatnonzero(~is_kept)
    caster, normals = make_caster([background]), background.face_normals()
    is_kept[candidates] = ~_is_measured(quads[candidates], caster, normals)
    corners = quads[is_kept].reshape(-1, 3)
    mesh = quad_mesh(corners, np.arange(len(corners)).reshape(-1, 4), FACADE)
    return mesh.with_provenance(Provenance.INFERRED)


def _parts(roofline: Roofline) -> tuple[Float64[np.ndarray, "q 4 3"], Bool[np.ndarray, " q"]]:
    """Return the unobserved quads of a building, frame world, and whether each is needed.

    Side and rear walls may be measured already, and are tested.
    """
    quads: list[Quad] = []
    is_hidden: list[bool] = []
    for run in _runs(roofline.top, roofline.depth_m, roofline.shown):
        for made, is_certain in (
            (_prism(roofline, run), True),
            (_free_walls(roofline, run), False),
        ):
            for quad in made:
                quads.append(quad)
                is_hidden.append(is_certain)
    s, z, out = np.array(quads, dtype=np.float64).reshape(-1, 3).T
    places = roofline.wall.at(s, z) + out[:, None] * roofline.wall.normal
    return places.reshape(-1, 4, 3), np.array(is_hidden, dtype=bool)


def _runs(*profiles: Shaped[np.ndarray, " s"]) -> list[tuple[int, int]]:
    """Return first and one past the last column of each stretch without a change of any profile."""
    changes = np.any([np.diff(profile) != 0 for profile in profiles], axis=0)
    borders = [0, *(np.flatnonzero(changes) + 1).tolist(), len(profiles[0])]
    return list(pairwise(borders))


Corner = tuple[float, float, float]
"""s and z, and distance in front of the wall's plane, in metres."""
Quad = tuple[Corner, Corner, Corner, Corner]
"""Corners counter-clockwise from outside."""


def _prism(roofline: Roofline, run: tuple[int, int]) -> Iterator[Quad]:
    """Yield the unobserved front and the roof of one stretch."""
    first, end = run
    wall, cell = roofline.wall, roofline.cell_m
    s0, s1 = wall.span_m[0] + cell * np.array([first, end])
    low = wall.height_m[0] + cell * (float(roofline.shown[first]) - 1)
    high, out = float(roofline.top_m[first]), -_SETBACK_M
    if roofline.top[first] > roofline.shown[first]:
        yield (s0, low, out), (s1, low, out), (s1, high, out), (s0, high, out)
    if roofline.depth_m[first] > 0 and roofline.top[first] > 0:
        rear = -INSET_M - float(roofline.depth_m[first])
        yield (s0, high, out), (s1, high, out), (s1, high, rear), (s0, high, rear)


def _free_walls(roofline: Roofline, run: tuple[int, int]) -> Iterator[Quad]:
    """Yield the rear and side walls of one stretch."""
    first, end = run
    if roofline.depth_m[first] == 0 or roofline.top[first] == 0:
        return
    s0, s1 = roofline.wall.span_m[0] + roofline.cell_m * np.array([first, end])
    low, high = float(roofline.ground_m[first:end].min()), float(roofline.top_m[first])
    near, far = -_CLEARANCE_M, -INSET_M - float(roofline.depth_m[first])
    yield (s1, low, far), (s0, low, far), (s0, high, far), (s1, high, far)
    if far < near:
        yield (s0, low, far), (s0, low, near), (s0, high, near), (s0, high, far)
        yield (s1, low, near), (s1, low, far), (s1, high, far), (s1, high, near)


def _is_measured(
    quads: Float64[np.ndarray, "q 4 3"], caster: RayCaster, normals: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " q"]:
    """Return whether measured parallel walls lie near the quads."""
    across, up = quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0]
    normal = np.cross(across, up)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps, indexing="ij"))
    start = (quads[:, 0] - _CLEARANCE_M * normal)[:, None] + u * across[:, None] + v * up[:, None]
    towards = np.broadcast_to(normal[:, None], start.shape).reshape(-1, 3)
    hits = caster.intersect(start.reshape(-1, 3), towards)
    is_near = hits.is_hit & (hits.distance_m < 2 * _CLEARANCE_M)
    is_wall = np.zeros(len(towards), dtype=bool)
    cosine = (normals[hits.face_index[is_near]] * towards[is_near]).sum(axis=1)
    is_wall[is_near] = np.abs(cosine) > _PARALLEL
    return is_wall.reshape(-1, _SAMPLES**2).mean(axis=1) > _PRESENT_FRACTION
