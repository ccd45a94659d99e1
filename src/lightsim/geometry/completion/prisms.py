"""What no view shows of buildings: the tops of near walls, roofs, rear and side walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Shaped

from lightsim.core.buildings import Roofline
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.completion.rooflines import INSET_M
from lightsim.geometry.materials import FACADE

_RETREAT_M = 0.15
"""Hidden parts of a wall stand this far behind: they must not shade what was measured of it."""
_END_INSET_M = 1.0
"""Side walls keep this far from the ends of their front, where another measured wall may meet it:
its panes bulge inwards as far as that."""


def roof_casters(rooflines: Sequence[Roofline]) -> TriMesh:
    """A mesh that casts shadows and that no camera sees; frame world, black, may be empty.

    Its walls keep clear of the measured ones, which may lie a little behind the fitted plane, and
    of those that meet the wall at its ends.
    """
    quads = [
        quad
        for roofline in rooflines
        for run in _runs(roofline.top, roofline.depth_m, roofline.shown)
        for quad in _prism(roofline, run)
    ]
    points = np.array(quads, dtype=np.float32).reshape(-1, 3)
    start = 4 * np.arange(len(quads), dtype=np.int32)[:, None]
    faces = np.concatenate([start + [[0, 1, 2]], start + [[0, 2, 3]]]).astype(np.int32)
    mesh = TriMesh("world", points, faces, np.zeros_like(points), (FACADE,))
    return mesh.with_provenance(Provenance.INFERRED)


def _runs(*profiles: Shaped[np.ndarray, " s"]) -> list[tuple[int, int]]:
    """First and one past the last column of each stretch where no profile changes."""
    changes = np.any([np.diff(profile) != 0 for profile in profiles], axis=0)
    borders = [0, *(np.flatnonzero(changes) + 1).tolist(), len(profiles[0])]
    return list(pairwise(borders))


def _prism(roofline: Roofline, run: tuple[int, int]) -> Iterator[Float64[np.ndarray, "4 3"]]:
    """One stretch; corners counter-clockwise from outside."""
    first, end = run
    wall, cell = roofline.wall, roofline.cell_m
    s0, s1 = wall.span_m[0] + cell * np.array([first, end])
    low, high = float(roofline.ground_m[first:end].min()), float(roofline.top_m[first])
    hidden = wall.height_m[0] + cell * (float(roofline.shown[first]) - 1)

    def quad(*corners: tuple[float, float, float]) -> Float64[np.ndarray, "4 3"]:
        s, z, out = np.array(corners).T
        return wall.at(s, z) + out[:, None] * wall.normal

    front, inset = -_RETREAT_M, -INSET_M
    if roofline.top[first] > roofline.shown[first]:
        yield quad((s0, hidden, front), (s1, hidden, front), (s1, high, front), (s0, high, front))
    if roofline.depth_m[first] == 0 or roofline.top[first] == 0:
        return
    s0 += _END_INSET_M if first == 0 else 0.0
    s1 -= _END_INSET_M if end == len(roofline.top) else 0.0
    if s1 <= s0:
        return
    rear = inset - float(roofline.depth_m[first])
    yield quad((s0, high, front), (s1, high, front), (s1, high, rear), (s0, high, rear))
    yield quad((s1, low, rear), (s0, low, rear), (s0, high, rear), (s1, high, rear))
    yield quad((s0, low, rear), (s0, low, inset), (s0, high, inset), (s0, high, rear))
    yield quad((s1, low, inset), (s1, low, rear), (s1, high, rear), (s1, high, inset))
