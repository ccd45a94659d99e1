"""Subdivision of triangles until no edge is longer than a limit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

# Function that returns which edges to split, from the values at both ends and the edges of faces.
Choice = Callable[[Float64[np.ndarray, "k 2 c"], Int64[np.ndarray, "m 3"]], Bool[np.ndarray, " k"]]


def longer_than(edge: float) -> Choice:
    """Return a function that selects the edges longer than `edge`; columns 0 to 2 are positions."""
    return lambda ends, _: np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1) > edge


def split_edges(
    values: Float64[np.ndarray, "n c"],
    faces: Int32[np.ndarray, "m 3"],
    is_split: Choice,
    most_faces: int,
) -> tuple[Float64[np.ndarray, "n2 c"], Int32[np.ndarray, "m2 3"], bool]:
    """Halve edges until `is_split` selects none, or the next round would exceed `most_faces`.

    An edge is split in all its faces at once, so no cracks appear. Values of new vertices are the
    means of both ends.

    Returns:
        Values, faces, and whether no selected edge remains.
    """
    # An edge cannot be halved more often: float64 numbers have 53 binary digits.
    for _ in range(64):
        keys, edge_of_corner = edges_of(faces, len(values))
        ends = values[keys]
        is_chosen = is_split(ends, edge_of_corner.reshape(-1, 3))
        n_faces = len(faces) + int(is_chosen[edge_of_corner].sum())
        if not is_chosen.any() or n_faces > most_faces:
            return values, faces, not is_chosen.any()
        middle = np.full(len(keys), -1, dtype=np.int32)
        middle[is_chosen] = len(values) + np.arange(is_chosen.sum(), dtype=np.int32)
        values = np.concatenate([values, ends[is_chosen].mean(axis=1)])
        faces = _split_faces(faces, middle[edge_of_corner].reshape(-1, 3))
    return values, faces, False


def edges_of(
    faces: Int32[np.ndarray, "m 3"], n_vertices: int
) -> tuple[Int64[np.ndarray, "k 2"], Int64[np.ndarray, " m3"]]:
    """Return the distinct edges as pairs of vertices (low, high), and the edge of each corner.

    The edge of a corner starts at it; its index is returned.
    """
    corners = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    low, high = np.sort(corners, axis=1).astype(np.int64).T
    # One integer per edge: `np.unique` of rows takes ten times as long.
    keys, edge_of_corner = np.unique(low * n_vertices + high, return_inverse=True)
    return np.stack(np.divmod(keys, n_vertices), axis=1), edge_of_corner.reshape(-1)


def _split_faces(
    faces: Int32[np.ndarray, "m 3"], middles: Int32[np.ndarray, "m 3"]
) -> Int32[np.ndarray, "k 3"]:
    """Replace faces (a, b, c) by 1 to 4 faces with the new vertices on ab, bc, ca (-1: none)."""
    count = (middles >= 0).sum(axis=1)
    # Rotate the corners: a single split edge becomes ab; of two split edges, the unsplit one is ca.
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
