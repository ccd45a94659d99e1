"""Symmetric completion and default shapes of actors."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.fields import TsdfGrid
from lightsim.core.frames import Trajectory
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.actors.cabin import close_cabin
from lightsim.geometry.actors.complete import actor_surface, mirrored
from lightsim.geometry.actors.evidence import ActorEvidence

SIZE = np.array([4.4, 1.8, 1.5])


def _track(kind: ActorKind, size: np.ndarray = SIZE) -> ActorTrack:
    pose = Trajectory("world", "actor", np.array([0], dtype=np.int64), np.eye(4)[None])
    return ActorTrack("a", kind, size, pose, False)


def _volume_m3(mesh: TriMesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("kind", "size", "fill"),
    [
        (ActorKind.CAR, SIZE, (0.5, 0.9)),
        (ActorKind.PICKUP, np.array([5.5, 2.0, 1.9]), (0.5, 0.9)),
        (ActorKind.TRUCK, np.array([8.0, 2.5, 3.2]), (0.8, 1.0)),
        (ActorKind.PEDESTRIAN, np.array([0.7, 0.6, 1.7]), (0.4, 0.9)),
        (ActorKind.MOTORCYCLE, np.array([2.1, 0.8, 1.2]), (0.8, 1.05)),
    ],
)
def test_every_kind_has_a_closed_shape_in_its_box(kind, size, fill) -> None:
    mesh, evidence = actor_surface(_track(kind, size), None)
    assert (evidence.provenance(mesh.vertices) == Provenance.INFERRED).all()
    assert (np.abs(mesh.vertices) <= size / 2 + 0.03).all()
    assert mesh.vertices[:, 2].max() > 0.9 * size[2] / 2
    assert fill[0] < _volume_m3(mesh) / float(np.prod(size)) < fill[1]
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def _half_seen_box() -> TsdfGrid:
    """A box narrower than the label, seen on its side y > 0 only."""
    voxel, blocks = 0.1, np.array([7, 4, 3])
    coords = np.argwhere(np.ones(tuple(blocks.tolist()), dtype=bool)).astype(np.int32)
    origin = -voxel * (8 * blocks - 1) / 2
    empty = np.zeros((len(coords), 8, 8, 8), dtype=np.float32)
    grid = TsdfGrid("actor", origin, voxel, 0.3, coords, empty, empty)
    sdf, weight = np.zeros_like(empty), np.zeros_like(empty)
    for b in range(len(coords)):
        p = grid.positions(b)
        q = np.abs(p) - np.array([1.9, 0.7, 0.7])
        distance = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)
        sdf[b] = np.clip(distance, -0.3, 0.3)
        weight[b] = (p[..., 1] > 0.2) * 3.0
    return TsdfGrid("actor", origin, voxel, 0.3, coords, sdf, weight)


def test_the_unseen_half_mirrors_the_seen_one() -> None:
    mesh, evidence = actor_surface(_track(ActorKind.CAR), _half_seen_box())
    side = np.abs(mesh.vertices[:, 0]) < 1.5
    side &= np.abs(mesh.vertices[:, 2]) < 0.4
    seen = mesh.vertices[side & (mesh.vertices[:, 1] > 0), 1]
    unseen = mesh.vertices[side & (mesh.vertices[:, 1] < 0), 1]
    assert abs(float(np.median(seen)) - 0.7) < 0.01
    assert abs(float(np.median(unseen)) + 0.7) < 0.03
    found = evidence.provenance(mesh.vertices)
    assert (found[side & (mesh.vertices[:, 1] > 0.4)] == Provenance.MEASURED).all()
    assert (found[side & (mesh.vertices[:, 1] < -0.4)] == Provenance.MIRRORED).all()
    assert (found[np.abs(mesh.vertices[:, 1]) < 0.05] == Provenance.INFERRED).all()
    _, evidence = actor_surface(_track(ActorKind.BARRIER), _half_seen_box())
    assert Provenance.MIRRORED not in evidence.provenance(mesh.vertices)


def test_observation_outweighs_its_mirror_image() -> None:
    sdf = np.array([[[1.0], [0.0]]], dtype=np.float32)
    weight = np.array([[[1.0], [0.0]]], dtype=np.float32)
    mixed, total = mirrored(sdf, weight, 0.25)
    np.testing.assert_allclose(mixed.ravel(), [1.0, 1.0])
    np.testing.assert_allclose(total.ravel(), [1.0, 0.25])


def test_hollow_cabin_is_closed_and_its_panes_are_named() -> None:
    """A box whose upper half has pillars at its corners alone, as a cabin seen through glass."""
    voxel = 0.06
    low = np.array([-2.2, -0.9, -0.8])
    axes = [low[i] + voxel * np.arange(n) for i, n in enumerate((74, 31, 27))]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    size = np.array([4.0, 1.6, 1.4])
    box = np.maximum(np.maximum(np.abs(x) - 2.0, np.abs(y) - 0.8), np.abs(z) - 0.7)
    pillar = (np.abs(x) > 1.8) & (np.abs(y) > 0.65)
    is_window_band = (z > 0.1) & (z < 0.6)
    sdf = np.where(is_window_band & ~pillar, 0.18, np.clip(box, -0.18, 0.18)).astype(np.float32)
    closed = close_cabin(ActorKind.CAR, sdf, low, voxel, size)
    inside = is_window_band & (box < -2 * voxel)
    assert (sdf[inside & ~pillar] > 0).all()
    assert (closed[inside] < 0).all()
    assert (closed[box > 2 * voxel] > 0).all()
    assert np.array_equal(close_cabin(ActorKind.PICKUP, sdf, low, voxel, size), sdf)
    ones = np.ones_like(sdf)
    evidence = ActorEvidence(low, voxel, ones, 0 * ones, 0.1, sdf - closed)
    panes = np.array([[0.0, 0.72, 0.35], [0.0, 0.78, -0.4]])
    assert evidence.is_glass(panes).tolist() == [True, False]
    assert evidence.provenance(panes).tolist() == [Provenance.INTERPOLATED, Provenance.MEASURED]
