"""Ground where no surface was drawn: holes near the path, and the road far ahead."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.fields import GroundMap
from lightsim.core.laplace import fill_smoothly
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.ground import ground_patches
from lightsim.geometry.surface import quad_mesh
from lightsim.render.casters.embree import make_embree_caster

RADIUS_M = 70.0
PATH = np.array([[-4.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def _height(xy: np.ndarray) -> np.ndarray:
    """A road that falls by 3 % and bends down further from 30 m on."""
    return -0.03 * xy[..., 0] - 0.001 * np.maximum(np.abs(xy[..., 0]) - 30.0, 0.0) ** 2


def _grid(half_m: float, cell_m: float) -> np.ndarray:
    axis = np.arange(-half_m, half_m + cell_m / 2, cell_m)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)


def _map(is_observed: np.ndarray, height_m: np.ndarray, xy: np.ndarray, cell_m: float) -> GroundMap:
    height = fill_smoothly(np.where(is_observed, height_m, 0.0), is_observed)
    return GroundMap(xy[0, 0], cell_m, height.astype(np.float32), is_observed)


def _measured(reach_m: float, hole_m: float) -> TriMesh:
    """The road's surface to `reach_m` from the origin, without a square in its middle."""
    xy = _grid(reach_m, 0.5)
    index = np.arange(xy[..., 0].size).reshape(xy.shape[:2])
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1)
    is_kept = np.abs(xy[:-1, :-1] + 0.25).max(axis=-1) > hole_m
    points = np.concatenate([xy, _height(xy)[..., None]], axis=-1).reshape(-1, 3)
    return quad_mesh(points, quads[is_kept])


def _height_below(mesh: TriMesh, xy: np.ndarray) -> np.ndarray:
    start = np.concatenate([xy, np.full((len(xy), 1), 10.0)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(xy), 1))
    return 10.0 - make_embree_caster([mesh]).intersect(start, down).distance_m


@pytest.fixture(scope="module")
def closed() -> tuple[TriMesh, np.ndarray]:
    """Patches, and the places where rings of beams met the road beyond the measured surface."""
    xy = _grid(80.0, 1.0)
    away = np.linalg.norm(xy, axis=-1)
    is_ring = (np.abs(away[..., None] - [0.5, 46.0, 52.0, 60.0]) < 0.75).any(axis=-1)
    is_road = np.abs(xy[..., 1]) < 8.0
    ground = _map((away < 30.0) & (away > 6.0) | is_ring & is_road, _height(xy), xy, 1.0)
    surface = _measured(30.0, 6.0)
    patches = ground_patches(surface, ground, PATH, RADIUS_M, make_embree_caster)
    return concatenate_meshes([surface, patches]), xy[is_ring & is_road & (away > 40.0)]


def test_road_far_ahead_is_as_high_as_returns_say(closed: tuple[TriMesh, np.ndarray]) -> None:
    mesh, rings = closed
    np.testing.assert_allclose(_height_below(mesh, rings), _height(rings), atol=0.03)


def test_nothing_is_open_between_surface_and_rings(closed: tuple[TriMesh, np.ndarray]) -> None:
    along = np.linspace([-60.0, 0.21], [60.0, 0.21], 333)
    off = _height_below(closed[0], along) - _height(along)
    assert np.abs(off).max() < 0.12


def test_what_a_lone_return_tells_of_a_wide_hole_counts() -> None:
    """Under a hole of 12 m the road bulges by 20 cm; only its middle was seen."""
    xy = _grid(80.0, 0.5)
    bulge = 0.2 * np.exp(-((xy**2).sum(axis=-1)) / 8.0)
    is_observed = (np.abs(xy).max(axis=-1) > 6.0) | (np.abs(xy).max(axis=-1) < 0.3)
    ground = _map(is_observed, _height(xy) + bulge, xy, 0.5)
    patches = ground_patches(_measured(30.0, 6.0), ground, PATH, RADIUS_M, make_embree_caster)
    assert _height_below(patches, np.zeros((1, 2)))[0] == pytest.approx(0.2, abs=0.01)


def test_patches_say_that_they_are_interpolated(closed: tuple[TriMesh, np.ndarray]) -> None:
    mesh, _ = closed
    assert mesh.has_provenance(Provenance.INTERPOLATED).any()
