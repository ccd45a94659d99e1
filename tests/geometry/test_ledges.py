"""A facade that beams draw: what stands out of it, level and solid, is a box; nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.buildings import Wall
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance
from lightsim.geometry.completion.ledges import find_ledges, with_ledges
from lightsim.geometry.surface import make_mesh
from lightsim.render.casters.embree import EmbreeCaster

# The wall stands at y = 8, looks to -y and reaches from x = 0 to 12 and up to 8 m.
WALL = Wall(
    np.array([0.0, 8.0, 0.0]),
    np.array([0.0, -1.0, 0.0]),
    np.array([1.0, 0.0, 0.0]),
    (0.0, 12.0),
    (0.0, 8.0),
)
FLAT = np.zeros((2, 2), np.float32)
GROUND = GroundMap(np.array([-20.0, -20.0]), 40.0, FLAT, FLAT == 0)
# Low and high x, low and high z, how far out: a sill, a band, a canopy, a cornice.
LEDGES = (
    (2.0, 3.5, 1.0, 1.1, 0.10),
    (0.0, 12.0, 3.0, 3.25, 0.12),
    (8.0, 9.6, 2.4, 2.52, 0.8),
    (0.0, 12.0, 7.2, 7.5, 0.35),
)
EMPTY = make_mesh("world", np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def _wall(rng: np.random.Generator, count: int = 40_000) -> tuple[np.ndarray, np.ndarray]:
    """x and z of beams that meet the facade: many below, few above."""
    return rng.uniform(0.0, 12.0, count), 8.0 * rng.beta(1.0, 2.5, count)


def _points(x: np.ndarray, out: np.ndarray, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = 8.0 - out + rng.normal(0.0, 0.015, len(x))
    return np.stack([x, noisy, z], axis=1).astype(np.float32)


def _out(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    out = np.zeros_like(x)
    for x0, x1, z0, z1, far in LEDGES:
        out[(x > x0) & (x < x1) & (z > z0) & (z < z1)] = far
    return out


def test_ledges_are_where_beams_end_before_the_wall() -> None:
    """Each within 4 cm of its place but along it, where few beams tell of its ends."""
    rng = np.random.default_rng(0)
    x, z = _wall(rng)
    found = find_ledges([WALL], _points(x, _out(x, z), z, rng), GROUND)
    assert len(found) == len(LEDGES)
    for x0, x1, z0, z1, far in LEDGES:
        (own,) = (k for k in found if z0 < np.mean(k.height_m) < z1)
        assert own.out_m[1] - own.out_m[0] == pytest.approx(far, abs=0.03)
        assert own.height_m == pytest.approx((z0, z1), abs=0.04)
        assert own.span_m == pytest.approx((x0, x1), abs=0.2)


def test_two_planes_of_one_wall_have_its_ledges_once() -> None:
    rng = np.random.default_rng(1)
    x, z = _wall(rng)
    behind = Wall(
        WALL.origin_m + [0.0, 0.1, 0.0], WALL.normal, WALL.along, WALL.span_m, WALL.height_m
    )
    assert len(find_ledges([WALL, behind], _points(x, _out(x, z), z, rng), GROUND)) == len(LEDGES)


def test_rails_leaves_signs_and_what_stands_on_the_ground_are_no_ledges() -> None:
    rng = np.random.default_rng(2)
    x, z = _wall(rng)
    out = np.zeros_like(x)
    is_rail = (x > 2) & (x < 5) & (z > 3) & (z < 4)
    out[is_rail & (x % 0.25 < 0.05)] = 0.95
    is_leaf = (x > 6) & (x < 9) & (z > 2) & (z < 5) & (rng.random(len(x)) < 0.8)
    out[is_leaf] = rng.uniform(0.1, 1.2, is_leaf.sum())
    out[(x > 10) & (x < 11) & (z > 2.5) & (z < 3.5)] = 0.3
    out[(x > 0) & (x < 12) & (z < 0.35)] = 0.6
    assert find_ledges([WALL], _points(x, out, z, rng), GROUND) == []


def test_walls_without_returns_have_none() -> None:
    nothing = np.zeros((0, 3), np.float32)
    assert find_ledges([WALL], nothing, GROUND) == []
    assert with_ledges(EMPTY, []) is EMPTY


def test_a_cornice_shades_the_wall_below_as_far_as_the_sun_is_high() -> None:
    """Under a sun straight before the wall, as high as the tangent says: depth times tangent."""
    rng = np.random.default_rng(3)
    x, z = _wall(rng)
    cornice = max(
        find_ledges([WALL], _points(x, _out(x, z), z, rng), GROUND), key=lambda k: k.height_m
    )
    mesh = with_ledges(EMPTY, [cornice])
    assert mesh.has_provenance(Provenance.INTERPOLATED).all()
    sun = np.array([0.0, -1.0, 1.5]) / np.hypot(1.0, 1.5)
    heights = np.arange(5.0, 7.0, 0.01)
    points = WALL.at(np.full_like(heights, 6.0), heights, cornice.out_m[0])
    is_dark = EmbreeCaster([mesh]).is_occluded(points, np.broadcast_to(sun, points.shape).copy())
    depth = cornice.out_m[1] - cornice.out_m[0]
    assert heights[is_dark].min() == pytest.approx(cornice.height_m[0] - 1.5 * depth, abs=0.02)
