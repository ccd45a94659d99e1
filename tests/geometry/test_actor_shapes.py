"""Whole vehicles from what was seen of them; symmetric completion and default shapes."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.fields import TsdfGrid
from lightsim.core.frames import Trajectory
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.actors.body import DEVIATION, HATCHBACK, SEDAN, VAN, Body, Proportions
from lightsim.geometry.actors.fit import VehicleMeasurements, fit_body
from lightsim.geometry.actors.shape import actor_surface, mirrored

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
        (ActorKind.TRUCK, np.array([8.0, 2.5, 3.2]), (0.7, 0.95)),
        (ActorKind.PEDESTRIAN, np.array([0.7, 0.6, 1.7]), (0.4, 0.9)),
        (ActorKind.MOTORCYCLE, np.array([2.1, 0.8, 1.2]), (0.8, 1.05)),
    ],
)
def test_every_kind_has_a_closed_shape_in_its_box(kind, size, fill) -> None:
    mesh, evidence = actor_surface(_track(kind, size), None)
    no_pane = np.zeros(len(mesh.vertices), dtype=bool)
    assert (evidence.provenance(mesh.vertices, no_pane) == Provenance.INFERRED).all()
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
    """Of a kind without a body of its own."""
    mesh, evidence = actor_surface(_track(ActorKind.TRAILER), _half_seen_box())
    side = np.abs(mesh.vertices[:, 0]) < 1.5
    side &= np.abs(mesh.vertices[:, 2]) < 0.4
    seen = mesh.vertices[side & (mesh.vertices[:, 1] > 0), 1]
    unseen = mesh.vertices[side & (mesh.vertices[:, 1] < 0), 1]
    assert abs(float(np.median(seen)) - 0.7) < 0.01
    assert abs(float(np.median(unseen)) + 0.7) < 0.03
    no_pane = np.zeros(len(mesh.vertices), dtype=bool)
    found = evidence.provenance(mesh.vertices, no_pane)
    assert (found[side & (mesh.vertices[:, 1] > 0.4)] == Provenance.MEASURED).all()
    assert (found[side & (mesh.vertices[:, 1] < -0.4)] == Provenance.MIRRORED).all()
    assert (found[np.abs(mesh.vertices[:, 1]) < 0.05] == Provenance.INFERRED).all()
    mesh, evidence = actor_surface(_track(ActorKind.BARRIER), _half_seen_box())
    no_pane = np.zeros(len(mesh.vertices), dtype=bool)
    assert Provenance.MIRRORED not in evidence.provenance(mesh.vertices, no_pane)


def test_observation_outweighs_its_mirror_image() -> None:
    sdf = np.array([[[1.0], [0.0]]], dtype=np.float32)
    weight = np.array([[[1.0], [0.0]]], dtype=np.float32)
    mixed, total = mirrored(sdf, weight, 0.25)
    np.testing.assert_allclose(mixed.ravel(), [1.0, 1.0])
    np.testing.assert_allclose(total.ravel(), [1.0, 0.25])


def _surface_points(body: Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points of a body's surface: random ones moved there along the distance's gradient."""
    points = rng.uniform(-0.5, 0.5, (8 * count, 3)) * body.size_lwh_m
    for _ in range(8):
        step = 1e-4
        slope = np.stack(
            [
                (body.distance_m(points + step * axis) - body.distance_m(points - step * axis))
                / (2 * step)
                for axis in np.eye(3)
            ],
            axis=1,
        )
        steep = np.maximum((slope**2).sum(axis=1, keepdims=True), 0.1)
        points -= slope * body.distance_m(points)[:, None] / steep
    return points[np.abs(body.distance_m(points)) < 1e-3][:count]


def _varied(prior: Proportions, rng: np.random.Generator) -> Body:
    noise = np.clip(rng.standard_normal(len(prior)), -1.5, 1.5)
    return Body(Proportions(*(np.array(prior) + noise * np.array(DEVIATION))), SIZE)


@pytest.mark.parametrize("prior", [SEDAN, HATCHBACK, VAN])
def test_a_body_is_found_again_from_the_returns_of_one_side(prior, rng) -> None:
    """Half of it unseen, and every tenth return from within, as through a pane."""
    true = _varied(prior, rng)
    points = _surface_points(true, 1500, rng)
    seen = points[points[:, 1] > 0.2]
    seen = seen + 0.02 * rng.standard_normal(seen.shape)
    stray = rng.uniform(-0.3, 0.3, (len(seen) // 10, 3)) * SIZE
    free = points[:400] * 1.25
    free = free[true.distance_m(free) > 0.1]
    measured = VehicleMeasurements(np.concatenate([seen, stray]), free, np.ones(len(free)))
    error = np.abs(fit_body(ActorKind.CAR, SIZE, measured).distance_m(points))
    typical = np.abs(Body(prior, SIZE).distance_m(points))
    assert np.median(error) < 0.025
    assert np.percentile(error, 90) < 0.08
    assert error.mean() < 0.7 * typical.mean()


def test_a_body_is_symmetric_and_stands_on_its_wheels() -> None:
    body = Body(SEDAN, SIZE)
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * SIZE
    np.testing.assert_array_equal(
        body.distance_m(points), body.distance_m(points * np.array([1.0, -1.0, 1.0]))
    )
    # Under the wheels it touches the box's floor, between them it does not.
    axle = (0.5 - SEDAN.front_wheel) * SIZE[0]
    floor = np.array([[axle, 0.75, -0.745], [0.0, 0.75, -0.7], [0.0, 0.0, 0.0]])
    assert (body.distance_m(floor) < 0).tolist() == [True, False, True]


def test_panes_are_where_a_car_has_glass() -> None:
    body = Body(SEDAN, SIZE)
    side, up, ahead = np.eye(3)[1], np.eye(3)[2], np.array([0.7, 0.0, 0.7])
    cases = (
        ((0.0, 0.72, 0.4), side, True),  # front door
        ((0.0, 0.85, -0.2), side, False),  # below the sill
        ((1.6, 0.7, 0.1), side, False),  # beside the hood
        ((0.7, 0.0, 0.45), ahead, True),  # windshield
        ((1.7, 0.0, 0.15), up, False),  # hood
        ((-0.2, 0.0, 0.72), up, False),  # roof
        ((-1.25, 0.0, 0.45), -ahead * [1, 1, -1], True),  # rear window
    )
    points, normals, expected = (np.array(column) for column in zip(*cases, strict=True))
    assert body.is_pane(points, normals).tolist() == expected.tolist()


def test_details_that_were_measured_move_the_body(rng) -> None:
    """A bulge of 8 cm on one door, whose half nobody saw on the other side."""
    body = Body(SEDAN, SIZE)
    points = _surface_points(body, 6000, rng).astype(np.float32)
    points = points[points[:, 1] > 0.3]
    near = (np.abs(points[:, 0]) < 0.5) & (points[:, 2] < 0.1) & (points[:, 2] > -0.4)
    points[near, 1] += 0.08
    mesh, evidence = actor_surface(_track(ActorKind.CAR), None, points)
    here = (np.abs(mesh.vertices[:, 0]) < 0.3) & (np.abs(mesh.vertices[:, 2] + 0.15) < 0.1)
    found = mesh.vertices[here & (mesh.vertices[:, 1] > 0.3)].astype(np.float64)
    assert 0.03 < float(np.median(body.distance_m(found))) < 0.09
    no_pane = np.zeros(len(mesh.vertices), dtype=bool)
    of = evidence.provenance(mesh.vertices, no_pane)
    assert (of[here & (mesh.vertices[:, 1] > 0.3)] == Provenance.MEASURED).all()
    assert (of[here & (mesh.vertices[:, 1] < -0.3)] == Provenance.MIRRORED).all()
