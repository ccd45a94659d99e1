"""Ground under parked cars, and walls behind them: the street goes on there as it does around."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.appearance.plane_mesh import plane_mesh

from lightsim.appearance.atlas import edge_lengths_m, pack, patches_of, texels_of
from lightsim.appearance.intrinsic.hidden_surfaces import Road, with_hidden_surfaces
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Texture, TriMesh

_KERB_M, _LINE_M = -4.0, -1.5


def _street_colour(across_m: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Pavement beyond the kerb, asphalt, and a white line."""
    grey = np.where(across_m < _KERB_M, 0.4, np.where(np.abs(across_m - _LINE_M) < 0.1, 0.8, 0.15))
    return (grey * light)[:, None] * np.array([1.0, 0.95, 0.9])


def _street(bearing_deg: float, hole_colour: float) -> tuple[TriMesh, np.ndarray, np.ndarray, Road]:
    """A street whose level falls along it by a tenth in 10 m, with a hole over kerb and line; its
    texels' places along it and across."""
    plane = plane_mesh(24.0, 0.25)
    bearing = np.radians(bearing_deg)
    turn = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
    along, across = plane.vertices[:, :2].astype(np.float64).T
    vertices = plane.vertices.copy()
    vertices[:, :2] = plane.vertices[:, :2] @ turn.T
    is_hidden = (along > 1.0) & (along < 5.5) & (across > -6.0) & (across < -1.0)
    edges = edge_lengths_m(plane.vertices, plane.faces)
    patches = pack(np.full(len(plane.faces), 5, np.int32), edges)
    texels = texels_of(patches)
    corners = plane.vertices[plane.faces[texels.face]].astype(np.float64)
    places = (texels.barycentric[:, :, None] * corners).sum(axis=1)[:, :2]
    colour = _street_colour(places[:, 1], 1 - 0.01 * places[:, 0])
    confidence = np.where(is_hidden, 0.0, 1.0)
    seen = (texels.barycentric * confidence[plane.faces[texels.face]]).sum(axis=1)
    image = np.zeros((patches.height_px * patches.width_px, 3), np.float32)
    image[texels.pixel] = np.where(seen[:, None] < 1, hole_colour, colour)
    texture = Texture(image.reshape(patches.height_px, patches.width_px, 3), patches.corner_uv())
    vertex = _street_colour(across, 1 - 0.01 * along)
    vertex[is_hidden] = hole_colour
    mesh = replace(plane, vertices=vertices, base_colour=vertex.astype(np.float32), texture=texture)
    ground = GroundMap(np.zeros(2), 1.0, np.zeros((2, 2), np.float32), np.ones((2, 2), bool))
    path = np.linspace(-8.0, 8.0, 9)[:, None] * np.append(turn[:, 0], 0.0)
    return mesh, confidence, places, Road(path, ground)


@pytest.mark.parametrize("bearing_deg", [0.0, 30.0])
def test_kerbs_and_lines_go_on_under_what_hid_them(bearing_deg: float) -> None:
    mesh, confidence, places, road = _street(bearing_deg, 0.6)
    done = with_hidden_surfaces(mesh, confidence, road)
    assert done.texture is not None
    assert mesh.texture is not None
    pixel = texels_of(patches_of(done.texture)).pixel
    wanted = _street_colour(places[:, 1], 1 - 0.01 * places[:, 0])
    made = done.texture.image.reshape(-1, 3)[pixel]
    kerb_m, line_m = (np.abs(places[:, 1] - at) for at in (_KERB_M, _LINE_M))
    is_plain = (kerb_m > 0.1) & (np.abs(line_m - 0.1) > 0.1)
    inside = (np.abs(places[:, 0] - 3.25) < 2.0) & (np.abs(places[:, 1] + 3.5) < 2.2)
    error = np.abs(np.log(made / wanted))[inside & is_plain]
    assert np.median(error) < 0.02
    assert np.percentile(error, 99) < 0.06
    outside = (np.abs(places[:, 0] - 3.25) > 2.6) | (np.abs(places[:, 1] + 3.5) > 2.9)
    before = mesh.texture.image.reshape(-1, 3)[pixel]
    np.testing.assert_array_equal(made[outside], before[outside])


def test_the_vertices_follow_and_nothing_comes_of_nothing() -> None:
    mesh, confidence, _, road = _street(0.0, 0.6)
    done = with_hidden_surfaces(mesh, confidence, road)
    hidden = confidence == 0
    wanted = _street_colour(mesh.vertices[:, 1].astype(np.float64), 1 - 0.01 * mesh.vertices[:, 0])
    error = np.abs(np.log(done.base_colour / wanted)).mean(axis=1)
    assert np.median(error[hidden]) < 0.02
    np.testing.assert_array_equal(done.base_colour[~hidden], mesh.base_colour[~hidden])
    assert with_hidden_surfaces(mesh, np.zeros_like(confidence), road) is mesh
    assert with_hidden_surfaces(mesh, np.ones_like(confidence), road) is mesh
    bare = replace(mesh, texture=None)
    assert with_hidden_surfaces(bare, confidence, road) is bare


def test_what_stands_above_the_ground_or_far_from_the_path_stays() -> None:
    mesh, confidence, _, road = _street(0.0, 0.6)
    roof = replace(mesh, vertices=mesh.vertices + np.array([0, 0, 3.0], np.float32))
    assert with_hidden_surfaces(roof, confidence, road) is roof
    beside = Road(road.path_m + np.array([0.0, 40.0, 0.0]), road.ground)
    assert with_hidden_surfaces(mesh, confidence, beside) is mesh


def test_a_car_that_never_moved_has_a_road_too() -> None:
    mesh, confidence, _, road = _street(0.0, 0.6)
    done = with_hidden_surfaces(mesh, confidence, Road(road.path_m[:1], road.ground))
    assert np.median(done.base_colour[confidence == 0]) != pytest.approx(0.6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_front_goes_on_downward_behind_what_hid_its_foot(side: float) -> None:
    """Windows' stripes above, nothing known below 1.5 m."""
    plane = plane_mesh(24.0, 0.25)
    along, up = plane.vertices[:, 0].copy(), plane.vertices[:, 1] + 11.0
    # The front is on the left at +8, on the right at -8, and faces the path between.
    points = np.stack([side * along, np.full_like(along, 8.0 * side), up], axis=1)
    edges = edge_lengths_m(plane.vertices, plane.faces)
    patches = pack(np.full(len(plane.faces), 5, np.int32), edges)
    texels = texels_of(patches)
    places = (
        texels.barycentric[:, :, None] * points[plane.faces[texels.face]].astype(np.float64)
    ).sum(axis=1)

    def stripes(x: np.ndarray) -> np.ndarray:
        return np.repeat(np.where(np.sin(2 * x) > 0, 0.5, 0.1)[:, None], 3, axis=1)

    confidence = np.where(up < 1.5, 0.0, 1.0)
    seen = (texels.barycentric * confidence[plane.faces[texels.face]]).sum(axis=1)
    image = np.zeros((patches.height_px * patches.width_px, 3), np.float32)
    image[texels.pixel] = np.where(seen[:, None] < 1, 0.9, stripes(places[:, 0]))
    texture = Texture(image.reshape(patches.height_px, patches.width_px, 3), patches.corner_uv())
    vertex = np.where(confidence[:, None] < 1, 0.9, stripes(points[:, 0])).astype(np.float32)
    mesh = replace(plane, vertices=points.astype(np.float32), base_colour=vertex, texture=texture)
    np.testing.assert_allclose(mesh.face_normals()[:, 1], -side, atol=1e-5)
    ground = GroundMap(np.zeros(2), 1.0, np.zeros((2, 2), np.float32), np.ones((2, 2), bool))
    road = Road(np.linspace(-8.0, 8.0, 9)[:, None] * np.array([1.0, 0.0, 0.0]), ground)
    done = with_hidden_surfaces(mesh, confidence, road)
    assert done.texture is not None
    made = done.texture.image.reshape(-1, 3)[texels.pixel]
    is_plain = np.abs(np.sin(2 * places[:, 0])) > 0.3
    is_foot = (places[:, 2] < 1.0) & (np.abs(places[:, 0]) < 8.0)
    np.testing.assert_allclose(
        made[is_foot & is_plain], stripes(places[:, 0])[is_foot & is_plain], rtol=1e-3
    )
    is_above = places[:, 2] > 1.8
    np.testing.assert_array_equal(made[is_above], image[texels.pixel][is_above])
