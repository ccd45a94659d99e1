"""What no view shows of buildings: the tops of near walls, roofs, rear and side walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64, Shaped

from lightsim.core.buildings import Roofline
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.completion.neighbours import INSET_M
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import quad_mesh

_RETREAT_M = 0.15
"""Hidden parts of a wall stand this far behind: they must not shade what was measured of it."""
_CLEARANCE_M = 1.2
"""Side walls start this far behind the front. This near to a measured wall of the same direction
side and rear walls are left to that: panes bulge inwards as far."""
_SAMPLES, _PARALLEL, _STANDING = 6, 0.8, 0.1
"""Points along each edge at which that is asked; cosine; and fraction of them that must meet it."""


def roof_casters(
    rooflines: Sequence[Roofline], background: TriMesh, *, make_caster: MakeCaster
) -> TriMesh:
    """A mesh that casts shadows and that no camera sees; frame world, black, may be empty.

    Args:
        rooflines: of the measured walls.
        background: what is visible; where a wall of it stands already, none is added.
        make_caster: builds the ray caster.
    """
    caster = make_caster([background])
    normals = background.face_normals()
    quads = [
        quad
        for roofline in rooflines
        for run in _runs(roofline.top, roofline.depth_m, roofline.shown)
        for quad in (*_prism(roofline, run), *_free_walls(roofline, run, caster, normals))
    ]
    corners = np.array(quads, dtype=np.float64).reshape(-1, 3)
    mesh = quad_mesh(corners, np.arange(len(corners)).reshape(-1, 4), FACADE)
    return mesh.with_provenance(Provenance.INFERRED)


def _runs(*profiles: Shaped[np.ndarray, " s"]) -> list[tuple[int, int]]:
    """First and one past the last column of each stretch where no profile changes."""
    changes = np.any([np.diff(profile) != 0 for profile in profiles], axis=0)
    borders = [0, *(np.flatnonzero(changes) + 1).tolist(), len(profiles[0])]
    return list(pairwise(borders))


Corner = tuple[float, float, float]
"""s, z, and metres in front of the wall's plane."""


def _quad(roofline: Roofline, *corners: Corner) -> Float64[np.ndarray, "4 3"]:
    """Corners in frame world, counter-clockwise from outside if they are given so."""
    s, z, out = np.array(corners).T
    return roofline.wall.at(s, z) + out[:, None] * roofline.wall.normal


def _prism(roofline: Roofline, run: tuple[int, int]) -> Iterator[Float64[np.ndarray, "4 3"]]:
    """The front that no view shows, and the roof of one stretch."""
    first, end = run
    wall, cell = roofline.wall, roofline.cell_m
    s0, s1 = wall.span_m[0] + cell * np.array([first, end])
    low = wall.height_m[0] + cell * (float(roofline.shown[first]) - 1)
    high, out = float(roofline.top_m[first]), -_RETREAT_M
    if roofline.top[first] > roofline.shown[first]:
        yield _quad(roofline, (s0, low, out), (s1, low, out), (s1, high, out), (s0, high, out))
    if roofline.depth_m[first] > 0 and roofline.top[first] > 0:
        rear = -INSET_M - float(roofline.depth_m[first])
        yield _quad(roofline, (s0, high, out), (s1, high, out), (s1, high, rear), (s0, high, rear))


def _free_walls(
    roofline: Roofline,
    run: tuple[int, int],
    caster: RayCaster,
    normals: Float[np.ndarray, "m 3"],
) -> Iterator[Float64[np.ndarray, "4 3"]]:
    """Rear and side walls of one stretch where none was measured."""
    first, end = run
    if roofline.depth_m[first] == 0 or roofline.top[first] == 0:
        return
    s0, s1 = roofline.wall.span_m[0] + roofline.cell_m * np.array([first, end])
    low, high = float(roofline.ground_m[first:end].min()), float(roofline.top_m[first])
    near, far = -_CLEARANCE_M, -INSET_M - float(roofline.depth_m[first])
    rear = _quad(roofline, (s1, low, far), (s0, low, far), (s0, high, far), (s1, high, far))
    left = _quad(roofline, (s0, low, far), (s0, low, near), (s0, high, near), (s0, high, far))
    right = _quad(roofline, (s1, low, near), (s1, low, far), (s1, high, far), (s1, high, near))
    walls = (rear, left, right) if far < near else (rear,)
    yield from (q for q in walls if not _stands_already(q, caster, normals))


def _stands_already(
    quad: Float64[np.ndarray, "4 3"], caster: RayCaster, normals: Float[np.ndarray, "m 3"]
) -> bool:
    """Whether a measured wall stands where the quad would."""
    across, up = quad[1] - quad[0], quad[3] - quad[0]
    normal = np.cross(across, up)
    normal /= max(float(np.linalg.norm(normal)), 1e-9)
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps, indexing="ij"))
    start = quad[0] + u * across + v * up - _CLEARANCE_M * normal
    hits = caster.intersect(start, np.broadcast_to(normal, start.shape).copy())
    is_near = hits.is_hit & (hits.distance_m < 2 * _CLEARANCE_M)
    cosine = np.abs(normals[hits.face_index[is_near]] @ normal)
    return bool((cosine > _PARALLEL).sum() > _STANDING * len(start))
