"""What ships: bodies on their level sets, markings cut out, wheels in arches, clothes."""

from __future__ import annotations

import numpy as np
import pytest
from tools.shipped_models.car import car_parts
from tools.shipped_models.car_body import DESIGNS, CarBody, body_surface
from tools.shipped_models.painted_mesh import PaintedMesh
from tools.shipped_models.person import person_parts
from tools.shipped_models.truck import truck_parts

from lightsim_lab.synthetic.shapes import Part

NAMES = sorted(DESIGNS)


def areas_and_normals(part: Part) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (part.vertices[part.faces[:, k]].astype(np.float64) for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return length / 2, cross / np.maximum(length, 1e-15)[:, None]


@pytest.mark.parametrize("name", NAMES)
def test_bodies_are_closed_symmetric_and_as_large_as_designed(name: str) -> None:
    design, body = DESIGNS[name], CarBody(DESIGNS[name])
    vertices, faces = body_surface(body)
    assert np.abs(body.distance_m(vertices)).max() < 2e-3
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    there, back = (np.unique(e @ [len(vertices), 1]) for e in (edges, edges[:, ::-1]))
    np.testing.assert_array_equal(there, back)
    np.testing.assert_allclose(np.abs(body.distance_m(vertices * [1, -1, 1])).max(), 0, atol=2e-3)
    size = np.ptp(vertices, axis=0)
    p = design.proportions
    assert size[0] == pytest.approx((p.rear - p.front) * design.length_m, abs=0.08)
    assert size[1] == pytest.approx(p.width * design.width_m, abs=0.06)
    assert vertices[:, 2].max() == pytest.approx(p.roof_height * design.height_m, abs=0.04)
    assert vertices[:, 2].min() == pytest.approx(p.clearance * design.height_m, abs=0.06)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.einsum("nc,nc->n", a, np.cross(b, c)).sum() > 0


@pytest.mark.parametrize("name", NAMES)
def test_what_a_car_shows(name: str) -> None:
    body = CarBody(DESIGNS[name])
    parts = car_parts(name, "red")
    looks = {part.material for part in parts}
    assert looks == {"red", "plastic", "black", "car_glass", "lamp", "tail", "plate", "rubber",
                     "steel"}  # fmt: skip
    glass = next(part for part in parts if part.material == "car_glass")
    area, normal = areas_and_normals(glass)
    is_ahead = normal[:, 0] > 0.4
    assert 0.5 < area[is_ahead].sum() < 2.5
    assert (normal[is_ahead, 2] > 0).all()
    assert area.sum() > 2.0
    for part in parts:
        if part.material in {"lamp", "tail"}:
            size, is_left = areas_and_normals(part)[0], part.vertices[part.faces[:, 0], 1] > 0
            assert size[is_left].sum() == pytest.approx(size[~is_left].sum(), rel=0.05)
            is_front = part.vertices[:, 0] > 0
            assert is_front.all() if part.material == "lamp" else not is_front.any()
        if part.material in {"red", "car_glass"}:
            # No paint in the arches: wheels have room to turn.
            assert body.arch_m(part.vertices.astype(np.float64)).min() > -0.02


def test_cutting_keeps_the_surface_and_splits_it_at_the_edge() -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = PaintedMesh(vertices, faces, np.zeros(2, dtype=np.int64), ("a",))
    mesh = mesh.painted("b", lambda v: v[:, 0] - 0.5)
    mesh = mesh.lined("c", lambda v: v[:, 0] - 1.5, lambda v: v[:, 1] * 0 - 1, 0.01)
    area = {part.material: areas_and_normals(part)[0].sum() for part in mesh.parts()}
    assert area == pytest.approx({"a": 1.49, "b": 0.5, "c": 0.01})
    for part in mesh.parts():
        assert (areas_and_normals(part)[1][:, 2] > 0.99).all()


def test_a_truck_has_a_cab_with_panes_and_a_box_in_rails() -> None:
    parts = {part.material: part for part in truck_parts()}
    points = np.concatenate([part.vertices for part in parts.values()])
    np.testing.assert_allclose(points[:, [0, 2]].min(axis=0), [-3.79, 0.0], atol=0.02)
    np.testing.assert_allclose(points[:, [0, 2]].max(axis=0), [3.74, 3.4], atol=0.02)
    area, normal = areas_and_normals(parts["car_glass"])
    assert 1.2 < area[normal[:, 0] > 0.5].sum() < 2.2
    assert area[normal[:, 1] > 0.9].sum() == pytest.approx(
        area[normal[:, 1] < -0.9].sum(), rel=0.05
    )
    # Rails lie along the edges: no white within their width of two sides.
    white = parts["white"].vertices
    assert (np.abs(white[:, 1]) < 1.11).sum() > 0
    is_on_side = np.abs(white[:, 1]) > 1.19
    assert white[is_on_side, 2].max() < 3.31


def test_a_person_is_closed_stands_on_the_ground_and_is_dressed() -> None:
    parts = person_parts()
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    assert abs(low[2]) < 0.03
    assert 1.7 < high[2] < 1.8
    area = {part.material: areas_and_normals(part)[0].sum() for part in parts}
    assert area["cloth"] > area["skin"] > area["hair"] > 0
    assert area["trousers"] > area["rubber"]
    # By the divergence theorem the area vectors of a closed surface cancel.
    total = sum((a[:, None] * n).sum(axis=0) for a, n in map(areas_and_normals, parts))
    np.testing.assert_allclose(total, 0, atol=1e-3)
