"""Set panes of glass into walls: cut the wall, add the pane at its depth and reveals around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.facade_cells import BEHIND_M
from lightsim.geometry.completion.glass import Pane
from lightsim.geometry.completion.walls import UP, WALL_CELL_M
from lightsim.geometry.materials import FACADE, GLASS
from lightsim.geometry.surface import keep_faces, parallelogram

# Surface up to this far in front of a wall is replaced by its panes, in metres; ledges are further
# out. Behind the wall the limit is `BEHIND_M`.
_FRONT_M = 0.2
# Extension of a pane beyond its hole on each side, in metres, so that no gap opens.
_OVERLAP_M = 0.02
# Corners nearer to a cutting line than this lie on it, in metres.
_ON_LINE_M = 1e-4


def glaze(mesh: TriMesh, panes: Sequence[Pane]) -> TriMesh:
    """Replace surface by panes; frame world, black, without texture.

    A pane is interpolated between measured surface, or inferred where the surrounding wall is
    inferred.

    Args:
        mesh: static surface, frame world.
        panes: rectangles of glass.
    """
    if not panes:
        return mesh
    is_inferred = mesh.has_provenance(Provenance.INFERRED)
    faces = _Faces(mesh)
    glass: list[TriMesh] = []
    for pane in panes:
        replaced = faces.cut_open(pane)
        is_mostly_inferred = len(replaced) > 0 and is_inferred[replaced].mean() > 0.5
        source = Provenance.INFERRED if is_mostly_inferred else Provenance.INTERPOLATED
        glass.append(_pane_mesh(pane).with_provenance(source))
    return concatenate_meshes([faces.joined(), *glass])


class _Faces:
    """A mesh whose faces are split and dropped; `_row` is the original face of each."""

    def __init__(self, mesh: TriMesh) -> None:
        self._mesh = mesh
        self._vertices = mesh.vertices.astype(np.float64)
        self._faces = mesh.faces.astype(np.int64)
        self._row = np.arange(len(mesh.faces))

    def joined(self) -> TriMesh:
        """Return the remaining mesh."""
        mesh, row = self._mesh, self._row
        material, provenance = mesh.face_material, mesh.face_provenance
        left = replace(
            mesh,
            vertices=self._vertices.astype(np.float32),
            faces=self._faces.astype(np.int32),
            base_colour=np.zeros((len(self._vertices), 3), dtype=np.float32),
            face_material=None if material is None else material[row],
            face_provenance=None if provenance is None else provenance[row],
        )
        return keep_faces(left, np.ones(len(row), dtype=bool))

    def cut_open(self, pane: Pane) -> Int64[np.ndarray, " k"]:
        """Drop the wall within a pane's rectangle; return the original rows of dropped faces."""
        wall = pane.wall
        along = float(wall.origin_m @ wall.along)
        edges = [(wall.along, along + s) for s in pane.span_m]
        edges += [(UP, z) for z in pane.height_m]
        near = self._touching(pane)
        faces, row = self._faces[near], self._row[near]
        for axis, at_m in edges:
            faces, row = self._split(faces, row, axis, at_m)
        s, z, out = _local(self._vertices[faces].mean(axis=1), pane)
        is_in = (s > pane.span_m[0]) & (s < pane.span_m[1]) & (out > -BEHIND_M) & (out < _FRONT_M)
        is_in &= (z > pane.height_m[0]) & (z < pane.height_m[1])
        self._faces = np.concatenate([np.delete(self._faces, near, axis=0), faces[~is_in]])
        self._row = np.concatenate([np.delete(self._row, near), row[~is_in]])
        return row[is_in]

    def _touching(self, pane: Pane) -> Int64[np.ndarray, " k"]:
        """Return the rows of faces near the wall whose box in its plane meets the pane."""
        limits = (pane.span_m, pane.height_m, (-BEHIND_M, _FRONT_M))
        is_touching = np.ones(len(self._faces), dtype=bool)
        for values, (low, high) in zip(_local(self._vertices, pane), limits, strict=True):
            # Faces with all corners beyond one side of the box cannot meet it.
            is_touching &= (values > low)[self._faces].any(axis=1)
            is_touching &= (values < high)[self._faces].any(axis=1)
        return np.flatnonzero(is_touching)

    def _split(
        self,
        faces: Int64[np.ndarray, "n 3"],
        row: Int64[np.ndarray, " n"],
        axis: Float64[np.ndarray, "3"],
        at_m: float,
    ) -> tuple[Int64[np.ndarray, "m 3"], Int64[np.ndarray, " m"]]:
        """Split faces across the plane `points @ axis == at_m` into three; return original rows."""
        side = self._vertices[faces] @ axis - at_m
        is_crossing = (side.max(axis=1) > _ON_LINE_M) & (side.min(axis=1) < -_ON_LINE_M)
        side = side[is_crossing]
        # Rotate corners so that the single corner on its side comes first; this preserves
        # orientation.
        is_above = side > 0
        is_alone = np.where(is_above.sum(axis=1, keepdims=True) == 1, is_above, ~is_above)
        turn = (is_alone.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[is_crossing], turn, axis=1).T
        side = np.take_along_axis(side, turn, axis=1)
        part = side[:, :1] / (side[:, :1] - side[:, 1:])
        points = self._vertices
        cuts = [
            points[a] + part[:, [k]] * (points[other] - points[a]) for k, other in enumerate((b, c))
        ]
        on_b = len(points) + np.arange(len(side))
        on_c = on_b + len(side)
        self._vertices = np.concatenate([points, *cuts])
        made = [
            np.stack(corners, axis=1)
            for corners in ((a, on_b, on_c), (on_b, b, c), (on_b, c, on_c))
        ]
        rows = np.concatenate([row[~is_crossing], np.tile(row[is_crossing], 3)])
        return np.concatenate([faces[~is_crossing], *made]), rows


def _local(
    points: Float64[np.ndarray, "n 3"], pane: Pane
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return place along the wall, height, and distance before the wall around the pane."""
    s, out = pane.wall.place(points)
    return s, points[:, 2], out - pane.wall_m


def _pane_mesh(pane: Pane) -> TriMesh:
    """Return the pane and the four reveals that join it to the wall, with outward normals."""
    wall, grown = pane.wall, np.array([-_OVERLAP_M, _OVERLAP_M])
    width, height = np.ptp(pane.span_m) * wall.along, np.ptp(pane.height_m) * UP
    deep = (pane.wall_m - pane.out_m) * wall.normal
    (s0, s1), (z0, z1) = pane.span_m, pane.height_m
    left_low, right_low, left_high = (
        wall.at(np.array(s), np.array(z), pane.out_m) for s, z in ((s0, z0), (s1, z0), (s0, z1))
    )
    across, up = np.array(pane.span_m) + grown, np.array(pane.height_m) + grown
    corner = wall.at(across[:1], up[:1], pane.out_m)[0]
    reveals = [
        parallelogram(left_low, height, deep, WALL_CELL_M, FACADE),
        parallelogram(right_low, deep, height, WALL_CELL_M, FACADE),
        parallelogram(left_low, deep, width, WALL_CELL_M, FACADE),
        parallelogram(left_high, width, deep, WALL_CELL_M, FACADE),
    ]
    glass = parallelogram(corner, np.ptp(across) * wall.along, np.ptp(up) * UP, WALL_CELL_M, GLASS)
    return concatenate_meshes([glass, *reveals])
