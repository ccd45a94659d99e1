"""A mesh whose faces have looks, cut along the zero of fields so that looks end there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int64
from tools.shipped_models.level_set import Field, Points, Shape

from lightsim_lab.synthetic.shapes import Part


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """Triangles with a look each.

    Args:
        look: index into `names` of each face.
    """

    vertices: Points
    faces: Int64[np.ndarray, "m 3"]
    look: Int64[np.ndarray, " m"]
    names: tuple[str, ...]

    @staticmethod
    def plain(name: str, vertices: Points, faces: Int64[np.ndarray, "m 3"]) -> PaintedMesh:
        """Of one look."""
        return PaintedMesh(vertices, faces, np.zeros(len(faces), dtype=np.int64), (name,))

    def painted(self, name: str, shape: Shape) -> PaintedMesh:
        """With the look inside of the shape, to its edge."""
        mesh, is_inside = self.cut(shape(self.vertices))
        look = np.where(is_inside, len(self.names), mesh.look)
        return replace(mesh, look=look, names=(*self.names, name))

    def lined(self, name: str, shape: Shape, limits: Shape, width_m: float) -> PaintedMesh:
        """With a line along the shape's edge where the limits are negative. The line is thinner
        than faces, so that it is cut out before it is asked for."""
        mesh = self
        for offset in (-width_m / 2, width_m / 2):
            mesh, _ = mesh.cut(shape(mesh.vertices) + offset)
        middle = mesh.vertices[mesh.faces].mean(axis=1)
        is_line = (np.abs(shape(middle)) < width_m / 2) & (limits(middle) < 0)
        look = np.where(is_line, len(self.names), mesh.look)
        return replace(mesh, look=look, names=(*self.names, name))

    def cut(self, field: Field) -> tuple[PaintedMesh, Bool[np.ndarray, " k"]]:
        """With edges along the zero of a field of the vertices, and which faces lie inside."""
        faces, vertices = self.faces, self.vertices
        field = np.where(field == 0, 1e-12, field)
        inside = (field < 0)[faces]
        count = inside.sum(axis=1)
        is_cut = (count > 0) & (count < 3)
        # Turned so that the first corner is the one that lies apart from the other two.
        apart = np.where(count == 1, inside.argmax(axis=1), (~inside).argmax(axis=1))[is_cut]
        order = (apart[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[is_cut], order, axis=1).T
        pairs = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
        edges, number = np.unique(pairs, axis=0, return_inverse=True)
        start, end = edges.T
        part = field[start] / (field[start] - field[end])
        added = vertices[start] + part[:, None] * (vertices[end] - vertices[start])
        ab, ac = len(vertices) + number.reshape(2, -1)
        pieces = [np.stack(corners, axis=1) for corners in ((a, ab, ac), (ab, b, c), (ab, c, ac))]
        is_apart_inside = count[is_cut] == 1
        mesh = PaintedMesh(
            np.concatenate([vertices, added]),
            np.concatenate([faces[~is_cut], *pieces]),
            np.concatenate([self.look[~is_cut], *[self.look[is_cut]] * 3]),
            self.names,
        )
        inside_pieces = [is_apart_inside, ~is_apart_inside, ~is_apart_inside]
        return mesh, np.concatenate([count[~is_cut] == 3, *inside_pieces])

    def parts(self) -> list[Part]:
        """What shows each name of `names`; names may stand there more than once."""
        return [
            _part(name, self.vertices, self.faces[self.look == k])
            for k, name in enumerate(self.names)
            if (self.look == k).any()
        ]


def _part(name: str, vertices: Points, faces: Int64[np.ndarray, "m 3"]) -> Part:
    used, index = np.unique(faces, return_inverse=True)
    points = vertices[used].astype(np.float32)
    return Part(name, points, index.reshape(-1, 3).astype(np.int32), points[:, :2])
