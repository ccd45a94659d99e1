"""Fitted bodies against real cars' shapes: CAD models, seen from one side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from lightsim.core.actors import ActorKind
from lightsim.geometry.actors.fit import VehicleMeasurements, fit_body
from lightsim.geometry.surface import make_mesh
from lightsim.render.casters.embree import make_embree_caster


def _outer_points(path: Path, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points that beams meet from outside, frame `actor`, and the box."""
    model = trimesh.load_scene(path).to_mesh()
    along, across = (
        (0, 2) if np.ptp(model.vertices[:, 0]) > np.ptp(model.vertices[:, 2]) else (2, 0)
    )
    vertices = model.vertices[:, [along, across, 1]]
    vertices = vertices - (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    size = np.ptp(vertices, axis=0)
    mesh = make_mesh("world", vertices.astype(np.float32), np.asarray(model.faces, np.int64))
    towards = rng.normal(size=(20_000, 3))
    towards[:, 2] = np.minimum(towards[:, 2], 0.2)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    origins = rng.uniform(-0.5, 0.5, (20_000, 3)) * size - 10 * towards
    hits = make_embree_caster([mesh]).intersect(origins, towards)
    return (origins + hits.distance_m[:, None] * towards)[hits.is_hit], size


@pytest.mark.parametrize(
    ("name", "kind", "within_10_cm"),
    [
        ("hatchback", ActorKind.CAR, 0.9),
        ("prius_hybrid", ActorKind.CAR, 0.9),
        ("suv", ActorKind.CAR, 0.8),
        ("pickup", ActorKind.PICKUP, 0.75),
        ("ambulance", ActorKind.TRUCK, 0.75),
    ],
)
def test_a_real_car_is_found_from_one_side(
    name: str, kind: ActorKind, within_10_cm: float, shared_data: Path, rng: np.random.Generator
) -> None:
    points, size = _outer_points(shared_data / "cad" / f"{name}.glb", rng)
    best = 0.0
    # Models face either way.
    for ahead in (1.0, -1.0):
        turned = points * np.array([ahead, 1.0, 1.0])
        seen = turned[(turned[:, 1] > 0.2) | (turned[:, 0] < -0.45 * size[0])]
        seen = seen[rng.choice(len(seen), 800, replace=False)]
        seen += 0.02 * rng.standard_normal(seen.shape)
        body = fit_body(kind, size, VehicleMeasurements(seen, np.zeros((0, 3)), np.zeros(0)))
        best = max(best, float((np.abs(body.distance_m(turned)) < 0.1).mean()))
    assert best > within_10_cm
