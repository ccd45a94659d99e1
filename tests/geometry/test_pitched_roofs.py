"""A gable house of which the front wall and the front slope are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tests.geometry.test_buildings import GROUND, NO_CROWNS, inputs_of

from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.pitched_roofs import find_pitched_roofs, lowest_roof_m
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.table import STEPS, complete
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.materials import UNKNOWN
from lightsim.geometry.surface import grid_mesh
from lightsim.render.casters.embree import EmbreeCaster

# The roof: from the eave, which overhangs the wall, to the ridge.
LEFT_M, RIGHT_M, EAVE_M, WALL_M, RIDGE_M, REAR_M = 4.0, 16.0, 7.8, 8.25, 12.0, 16.2
EAVE_Z_M, RISE = 3.0, 0.7
RIDGE_Z_M = EAVE_Z_M + RISE * (RIDGE_M - EAVE_M)


def _sheet(start: list[float], first: list[float], second: list[float]) -> TriMesh:
    """A parallelogram of shared corners every half metre, as the field's surface has them."""
    sides = [np.array(side) for side in (first, second)]
    u, v = (np.linspace(0, 1, round(2 * np.linalg.norm(side)) + 1) for side in sides)
    corners = np.array(start) + u[:, None, None] * sides[0] + v[:, None] * sides[1]
    return grid_mesh(corners, UNKNOWN)


def _slope() -> TriMesh:
    length, run = RIGHT_M - LEFT_M, RIDGE_M - EAVE_M
    return _sheet([LEFT_M, EAVE_M, EAVE_Z_M], [length, 0, 0], [0, run, RISE * run])


def _wall() -> TriMesh:
    return _sheet([4.4, WALL_M, 0.0], [11.2, 0, 0], [0, 0, 2.5])


def _street() -> TriMesh:
    return _sheet([-10, -5, 0], [40, 0, 0], [0, 13, 0])


def _seen() -> TriMesh:
    return concatenate_meshes([_street(), _wall(), _slope()])


def _true_z_m(y: np.ndarray) -> np.ndarray:
    return RIDGE_Z_M - RISE * np.abs(y - RIDGE_M)


def test_a_measured_slope_is_continued_beyond_its_ridge() -> None:
    roofs = find_pitched_roofs(_seen(), GROUND, EmbreeCaster([_seen()]))
    assert len(roofs) == 1
    y = np.linspace(EAVE_M - 1, REAR_M + 1, 41)
    found = lowest_roof_m(roofs, np.column_stack([np.full(41, 10.0), y, np.zeros(41)]))
    is_under = (y > EAVE_M) & (y < REAR_M)
    np.testing.assert_array_equal(np.isfinite(found), is_under)
    # The ridge is a quantile of the slope's corners, which are half a metre apart.
    np.testing.assert_allclose(found[is_under], _true_z_m(y[is_under]), atol=0.1)
    beside = np.array([[LEFT_M - 0.1, 10.0, 0.0], [RIGHT_M + 0.1, 10.0, 0.0]])
    assert np.isinf(lowest_roof_m(roofs, beside)).all()


def test_what_is_inferred_lies_within_the_house_and_shades_nothing_measured() -> None:
    others = {step.name for step in STEPS} - {"pitched_roofs"}
    scene, _ = complete(inputs_of([]), Scene(_seen(), NO_CROWNS), others)
    is_new = scene.background.has_provenance(Provenance.INFERRED)
    x, y, z = scene.background.vertices[np.unique(scene.background.faces[is_new])].T
    assert (x > LEFT_M).all()
    assert (x < RIGHT_M).all()
    assert (z < _true_z_m(y) + 0.03).all()
    caster = EmbreeCaster([scene.background])
    rng = np.random.default_rng(0)
    for mesh, out in ((_slope(), [0.0, -RISE, 1.0]), (_wall(), [0.0, -1.0, 0.0])):
        points = mesh.vertices[rng.integers(0, len(mesh.vertices), 100)] + 0.01 * np.array(out)
        assert not caster.is_occluded(points, np.tile(out, (100, 1))).any()
    # Sun from behind, over the ridge: the street before the house lies in its shadow.
    sun = np.array([0.0, np.cos(0.5), np.sin(0.5)])
    reach_m = RIDGE_Z_M / np.tan(0.5) - RIDGE_M
    for y_m, is_dark in ((-reach_m + 0.5, True), (-reach_m - 0.5, False)):
        assert caster.is_occluded(np.array([[10.0, y_m, 0.01]]), sun[None])[0] == is_dark


def test_a_slope_too_short_to_be_inset_is_left_alone() -> None:
    run = RIDGE_M - EAVE_M
    mesh = _sheet([LEFT_M, EAVE_M, EAVE_Z_M], [2.5, 0, 0], [0, run, RISE * run])
    assert find_pitched_roofs(mesh, GROUND, EmbreeCaster([mesh])) == []


def test_hillsides_and_roofs_that_lean_on_a_wall_are_not_mirrored() -> None:
    hill = _sheet([LEFT_M, -5, 0.0], [12, 0, 0], [0, 14, 0.5 * 14])
    behind = _sheet([LEFT_M, RIDGE_M, 0.0], [12, 0, 0], [0, 0, 10.0])
    for mesh in (hill, concatenate_meshes([_seen(), behind])):
        assert find_pitched_roofs(mesh, GROUND, EmbreeCaster([mesh])) == []


def test_a_wall_ends_at_the_roof_above_it() -> None:
    """Nothing reaches higher: without the roof, the street's usual height would be assumed."""
    seen = _seen()
    before = Scene(seen, NO_CROWNS, [w for w in find_walls(seen) if abs(w.normal[1]) > 0.9])
    names = {step.name for step in STEPS}
    known, _ = complete(inputs_of([]), before, names - {"pitched_roofs", "roofs"})
    unknown, _ = complete(inputs_of([]), replace(before), names - {"roofs"})
    assert np.median(unknown.rooflines[0].top_m) > 6.0
    inner = slice(4, -4)
    np.testing.assert_allclose(known.rooflines[0].top_m[inner], EAVE_Z_M + 0.5, atol=0.5)
    assert (known.rooflines[0].depth_m[inner] == 0).all()
