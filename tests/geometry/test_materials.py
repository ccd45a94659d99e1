"""Material classes by label and by shape."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.actors import ActorKind
from lightsim.core.fields import GroundMap
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.geometry.materials import classify_background, material_of, material_of_actor
from lightsim.geometry.surface import make_mesh


@pytest.mark.parametrize(
    ("name", "material"),
    [
        ("Road", "asphalt"),
        ("Lane Line Marking", "asphalt"),
        ("Road Barriers", "matte"),
        ("Sidewalk", "pavement"),
        ("Pickup Truck", "car paint"),
        ("Building", "facade"),
        ("Vegetation", "vegetation"),
        ("Pedestrian with Object", "cloth"),
        ("Other Static Object", "matte"),
    ],
)
def test_labels_name_materials(name: str, material: str) -> None:
    assert material_of(name).name == material


@pytest.mark.parametrize(
    ("kind", "material"),
    [
        (ActorKind.OTHER_VEHICLE, "car paint"),
        (ActorKind.MOTORCYCLE, "car paint"),
        (ActorKind.PEDESTRIAN, "cloth"),
        (ActorKind.SIGN, "metal"),
        (ActorKind.CONE, "matte"),
        (ActorKind.OTHER, "matte"),
    ],
)
def test_kinds_have_materials(kind: ActorKind, material: str) -> None:
    assert material_of_actor(kind).name == material


def _sheet(u: np.ndarray, v: np.ndarray) -> TriMesh:
    """A square of 4 m in steps of 0.5 m, spanned by two unit vectors."""
    n = 9
    a, b = np.meshgrid(*[np.linspace(0, 4, n)] * 2, indexing="ij")
    points = a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    k = np.arange(n * n).reshape(n, n)
    quad = [k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]]
    p, q, r, s = (x.ravel() for x in quad)
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return make_mesh("world", points, faces)


def _log(points: np.ndarray, names: dict[int, str]) -> DrivingLog:
    n = len(points)
    sweep = LidarSweep(
        "0",
        0,
        points.astype(np.float32),
        np.zeros((n, 3), np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        np.full(n, -1, np.int16),
        np.full(n, 7, np.int16),
    )
    ego = Trajectory("world", "ego", np.array([0], dtype=np.int64), np.eye(4)[None])
    lazy = LazySweep("0", 0, lambda: sweep)
    return DrivingLog("toy", {}, (), (lazy,), ego, (), None, {}, (), names)


def test_labels_win_near_returns_and_shape_elsewhere() -> None:
    x, y, z = np.eye(3)
    mesh = concatenate_meshes([_sheet(x, y), _sheet(y, z)])
    ground = GroundMap(np.zeros(2), 1.0, np.zeros((5, 5), np.float32), np.ones((5, 5), dtype=bool))
    log = _log(np.array([[3.5, b, 0.0] for b in np.linspace(0, 4, 33)]), {7: "Sidewalk"})
    found = classify_background(mesh, log, ground)
    names = np.array([m.name for m in found.materials])[found.face_material]
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    assert (names[centre[:, 0] > 3.2] == "pavement").all()
    assert (names[(centre[:, 2] == 0) & (centre[:, 0] < 2)] == "asphalt").all()
    assert (names[centre[:, 2] > 1.2] == "facade").all()
