"""A scanned road with a crown of known density, a wall, a bin and a van."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.scanning import scanned
from tests.geometry.test_poles import GROUND, PATH_M

from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.crowns import Beams, Crowns, find_crowns
from lightsim.geometry.completion.free_space_kernels import walk_beams
from lightsim.geometry.completion.leaf_cards import cards_above, crown_cards, without_crown_surface
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.surface import quad_mesh
from lightsim.render.casters.embree import EmbreeCaster

EXTINCTION, LOW, SIZE_M = 0.9, np.array([-2.0, 6.0, 2.6]), 3.2
"""Of the true crown, 1 / m; its lowest corner and its edge."""


def _quad(*corners: tuple[float, float, float]) -> TriMesh:
    return quad_mesh(np.array(corners, float), np.arange(4).reshape(1, 4))


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    corner = np.array([[(low, high)[(k >> i) & 1][i] for i in range(3)] for k in range(8)])
    sides = [[0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5], [4, 5, 7, 6]]
    return quad_mesh(corner, np.array(sides))


def _leaves() -> TriMesh:
    """Squares of 0.1 m that stop light as EXTINCTION says: half of their area, on average."""
    rng = np.random.default_rng(3)
    count = round(2 * EXTINCTION * SIZE_M**3 / 0.1**2)
    normal, other = rng.standard_normal((2, count, 3))
    return squares(LOW + SIZE_M * rng.random((count, 3)), normal, other, 0.05)


def squares(centres: np.ndarray, normal: np.ndarray, other: np.ndarray, half_m: float) -> TriMesh:
    """Of some size, square to their normals."""
    along = np.cross(normal, other)
    sides = [along, np.cross(normal, along)]
    sides = [half_m * s / np.linalg.norm(s, axis=1, keepdims=True) for s in sides]
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = np.stack([centres + a * sides[0] + b * sides[1] for a, b in signs], axis=1)
    return quad_mesh(corners.reshape(-1, 3), np.arange(4 * len(centres)).reshape(-1, 4))


def _surfaces() -> TriMesh:
    ground = _quad((-40, -40, 0), (40, -40, 0), (40, 40, 0), (-40, 40, 0))
    wall = _quad((25, 12, 0), (-25, 12, 0), (-25, 12, 14), (25, 12, 14))
    van = _box((4.0, 4.0, 0.3), (8.0, 6.0, 2.4))
    return concatenate_meshes([ground, wall, van, _box((-5.0, 4.0, 0.0), (-4.4, 4.6, 1.3))])


def _found(*parts: TriMesh) -> Crowns:
    walls = find_walls(_surfaces())
    return find_crowns(
        Beams(*scanned(concatenate_meshes(list(parts)), 0.4, 30.0)), walls, GROUND, PATH_M
    )


@pytest.fixture(scope="module")
def crowns() -> Crowns:
    return _found(_surfaces(), _leaves())


def test_a_beam_is_counted_where_it_stops_and_measured_where_it_passes() -> None:
    stops, entries = np.zeros((2, 4, 3, 3), np.int32)
    lengths = np.zeros((4, 3, 3))
    origins = np.array([[-2.0, 0.5, 0.5], [0.5, -1.0, 0.5], [5.0, 5.0, 5.0]])
    ends = np.array([[2.25, 0.5, 0.5], [0.5, 9.0, 0.5], [9.0, 9.0, 9.0]])
    walk_beams(origins, ends, stops, entries, lengths)
    np.testing.assert_array_equal(entries[:, 0, 0], [2, 1, 1, 0])
    np.testing.assert_allclose(lengths[:, 0, 0], [2.0, 1.0, 0.25, 0.0])
    np.testing.assert_allclose(lengths[0, :, 0], [2.0, 1.0, 1.0])
    assert stops.sum() == stops[2, 0, 0] == 1


def test_a_crown_is_found_with_its_density(crowns: Crowns) -> None:
    assert len(crowns) == 1
    middle = crowns.low_m + (crowns.cells + 0.5) * crowns.voxel_m
    assert (middle > LOW - 0.5).all()
    assert (middle < LOW + SIZE_M + 0.5).all()
    is_inner = ((middle > LOW + 0.4) & (middle < LOW + SIZE_M - 0.4)).all(axis=1)
    assert is_inner.sum() > 0.9 * ((SIZE_M - 0.8) / crowns.voxel_m) ** 3
    assert crowns.extinction[is_inner].mean() == pytest.approx(EXTINCTION, rel=0.15)


def test_cards_let_as_much_light_through_as_beer_and_lambert_say(crowns: Crowns) -> None:
    cards = crown_cards(crowns, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    for axis in range(3):
        origins = LOW + SIZE_M * (0.2 + 0.6 * rng.random((4000, 3)))
        origins[:, axis] = LOW[axis] - 2.0
        way = np.tile(np.eye(3)[axis], (4000, 1))
        is_stopped = EmbreeCaster([cards]).is_occluded(origins, way)
        assert 1 - is_stopped.mean() == pytest.approx(np.exp(-EXTINCTION * SIZE_M), abs=0.04)
    assert cards.has_provenance(Provenance.MEASURED).all()
    # Cameras on the path see fronts.
    centres = cards.vertices[cards.faces].mean(axis=1)
    towards = crowns.nearest_path_points(centres.astype(np.float64)) - centres
    assert ((cards.face_normals() * towards).sum(axis=1) >= 0).mean() > 0.99


def test_the_same_beams_make_the_same_cards(crowns: Crowns) -> None:
    again = _found(_surfaces(), _leaves())
    one, other = (crown_cards(c, np.random.default_rng(0)) for c in (crowns, again))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def test_walls_and_vans_are_no_crowns() -> None:
    found = _found(_surfaces())
    assert len(found) == 0
    assert len(crown_cards(found, np.random.default_rng(0)).faces) == 0
    assert len(without_crown_surface(_surfaces(), found).faces) == len(_surfaces().faces)


def test_shreds_go_and_what_stands_beside_stays(crowns: Crowns) -> None:
    shreds = _leaves()
    left = without_crown_surface(concatenate_meshes([_surfaces(), shreds]), crowns)
    assert len(left.faces) - len(_surfaces().faces) < 0.02 * len(shreds.faces)
    assert left.vertices[:, 1].max() == pytest.approx(40.0)


def test_leaves_above_the_beams_are_as_dense_as_those_below(crowns: Crowns) -> None:
    steps = np.stack(np.meshgrid(*[np.arange(8) + 0.5] * 3), axis=-1).reshape(-1, 3)
    middle = LOW + [0.8, 0.8, SIZE_M] + 0.2 * steps
    cards = cards_above(crowns, middle, 0.2, np.random.default_rng(0))
    assert cards.has_provenance(Provenance.INFERRED).all()
    wanted = 2 * EXTINCTION * 1.6**3
    assert cards.face_areas_m2().sum() == pytest.approx(wanted, rel=0.3)


def test_no_returns_no_crowns() -> None:
    none = np.zeros((0, 3), np.float32)
    assert len(find_crowns(Beams(none, none), [], GROUND, PATH_M)) == 0
