"""A house whose roof no camera reaches: its shadow on the road tells how high it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.decompose import mesh_surfels
from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.appearance.intrinsic.roofs import carve_roofs
from lightsim.core.buildings import Roofline, Wall
from lightsim.core.mesh import TriMesh

_CELL_M, _LABELS, _MEASURED_M = 0.25, 120, 4.0
_WALL = Wall(
    np.array([0.0, 12.0, 0.0]),
    np.array([0.0, -1.0, 0.0]),
    np.array([1.0, 0.0, 0.0]),
    (-12.0, 12.0),
    (0.0, _MEASURED_M),
)
_SUN = np.array([0.1, 0.8, 0.6]) / np.linalg.norm([0.1, 0.8, 0.6])
_SUN_LIGHT, _SKY_LIGHT = np.array([1.0, 0.9, 0.7]), np.array([0.15, 0.2, 0.3])


def _height_m(x: np.ndarray) -> np.ndarray:
    """Two houses behind one front."""
    return np.where(x < 1.0, 7.0, 12.0)


def _guess(top_m: float, energy_at: float = 0.02) -> Roofline:
    count = round(24.0 / _CELL_M)
    tops = _CELL_M * np.arange(_LABELS)
    energy = energy_at * np.log(np.maximum(tops, _CELL_M) / top_m) ** 2
    energy = np.where(tops < _MEASURED_M, 5.0, energy)
    return Roofline(
        _WALL,
        _CELL_M,
        np.zeros(count),
        np.tile(energy.astype(np.float32), (count, 1)),
        np.full(count, round(_MEASURED_M / _CELL_M)),
        np.full(count, round(top_m / _CELL_M)),
        np.zeros(count, dtype=bool),
        np.full(count, 12.0),
        0.35,
    )


def _road() -> TriMesh:
    line = np.linspace(-11.0, 11.0, 177)
    x, y = np.meshgrid(line, line)
    i = (np.arange(176)[:, None] * 177 + np.arange(176)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 178], 1), np.stack([i, i + 178, i + 177], 1)])
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    return TriMesh("world", vertices, faces.astype(np.int32), np.full_like(vertices, 0.5))


def _is_lit(points: np.ndarray, top_m: np.ndarray | float) -> np.ndarray:
    way = (_WALL.origin_m[1] - points[:, 1]) / _SUN[1]
    return points[:, 2] + way * _SUN[2] > top_m


def _light(points: np.ndarray, guess_m: float) -> SurfaceLight:
    lit = np.stack([np.ones(len(points)), _is_lit(points, guess_m)], axis=1).astype(np.float32)
    shape = (len(points), 3)
    sun = np.broadcast_to(_SUN_LIGHT * _SUN[2], shape).astype(np.float32)
    sky = np.broadcast_to(_SKY_LIGHT, shape).astype(np.float32)
    none = np.zeros(shape, np.float32)
    return SurfaceLight(sun, lit, sky, none, none)


def _carved(guess_m: float, is_overcast: bool = False, is_seen: bool = False) -> Roofline:
    mesh = _road()
    crossing_x = mesh.vertices[:, 0] + (12.0 - mesh.vertices[:, 1]) / _SUN[1] * _SUN[0]
    lit = _is_lit(mesh.vertices, _height_m(crossing_x))[:, None] & (not is_overcast)
    rng = np.random.default_rng(0)
    albedo = 0.15 * np.exp(0.05 * rng.normal(size=(len(mesh.vertices), 1)))
    radiance = albedo * (_SKY_LIGHT + lit * _SUN_LIGHT * _SUN[2])
    mesh = replace(mesh, base_colour=radiance.astype(np.float32))
    config = IntrinsicConfig()
    patches = mesh_surfels(mesh, config, rng)
    assert patches is not None
    observed = patches.with_light(lambda seen: _light(seen.position, guess_m))
    guess = _guess(guess_m)
    guess = replace(guess, is_seen=np.full(len(guess.top), is_seen))
    return carve_roofs([guess], observed, _SUN, config)[0]


@pytest.mark.parametrize("guess_m", [6.0, 9.0, 12.0])
def test_both_heights_come_back_from_the_shadow(guess_m: float) -> None:
    found = _carved(guess_m)
    x = found.s_m
    # Away from the ends, beyond which the way of the rays leads off the road.
    inner = (np.abs(x) < 9.0) & (np.abs(x - 1.0) > 1.0)
    np.testing.assert_allclose(found.height_m[inner], _height_m(x)[inner], atol=0.6)


def test_roofs_that_views_show_stay() -> None:
    np.testing.assert_allclose(_carved(9.0, is_seen=True).height_m, 9.0)


def test_no_patch_no_change() -> None:
    """The sun stands before the wall, so nothing can be in its shadow."""
    config = IntrinsicConfig()
    rng = np.random.default_rng(0)
    patches = mesh_surfels(_road(), config, rng)
    assert patches is not None
    observed = patches.with_light(lambda seen: _light(seen.position, 9.0))
    guess = _guess(9.0)
    assert carve_roofs([guess], observed, -_SUN * [1, 1, -1], config)[0] is guess
