"""Triangles split until no edge is longer than a limit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32


def split_long_edges(
    values: Float64[np.ndarray, "n c"],
    faces: Int32[np.ndarray, "m 3"],
    edge_m: float,
    most_faces: int,
) -> tuple[Float64[np.ndarray, "n2 c"], Int32[np.ndarray, "m2 3"]]:
    """Halve edges longer than `edge_m` (by the first three columns) until there is none, or the
    next round would make more than `most_faces`.

    An edge is split in all its faces at once, so no cracks open.
    """
    while True:
        corners = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        low, high = np.sort(corners, axis=1).astype(np.int64).T
        # One integer an edge: `unique` of rows takes ten times as long.
        keys, edge_of_corner = np.unique(low * len(values) + high, return_inverse=True)
        ends = values[np.stack(np.divmod(keys, len(values)), axis=1)]
        is_long = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1) > edge_m
        n_faces = len(faces) + int(is_long[edge_of_corner].sum())
        if not is_long.any() or n_faces > most_faces:
            return values, faces
        middle = np.full(len(keys), -1, dtype=np.int32)
        middle[is_long] = len(values) + np.arange(is_long.sum(), dtype=np.int32)
        values = np.concatenate([values, ends[is_long].mean(axis=1)])
        faces = _split_faces(faces, middle[edge_of_corner.reshape(-1)].reshape(-1, 3))


def _split_faces(
    faces: Int32[np.ndarray, "m 3"], middles: Int32[np.ndarray, "m 3"]
) -> Int32[np.ndarray, "k 3"]:
    """Faces (a, b, c) with the new vertices on ab, bc, ca (-1: none) as 1 to 4 faces each."""
    count = (middles >= 0).sum(axis=1)
    # Turned so that one split edge is ab, and with two, the whole one is ca.
    turn = np.where(count == 1, (middles >= 0).argmax(axis=1), 0)
    turn = np.where(count == 2, ((middles < 0).argmax(axis=1) + 1) % 3, turn)
    order = (np.arange(3)[None, :] + turn[:, None]) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middles, order, axis=1).T
    patterns = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    pieces = [
        np.stack(corners, axis=1)[count == number]
        for number, triangles in patterns.items()
        for corners in triangles
    ]
    return np.concatenate(pieces).astype(np.int32)
