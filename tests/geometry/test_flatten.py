"""Walls lose their bumps and keep their shape."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.flatten import flatten_walls

VOXEL_M = 0.1
NONE = np.zeros((0, 3), np.float32)


def _height_field(out_m: np.ndarray) -> TriMesh:
    """A wall of samples at 0.1 m that faces -y and stands `out_m` (along x, z) before y = 10."""
    i, k = np.meshgrid(*(np.arange(n) for n in out_m.shape), indexing="ij")
    points = np.stack([VOXEL_M * i, 10.0 - out_m, VOXEL_M * k], axis=-1).reshape(-1, 3)
    number = np.arange(out_m.size).reshape(out_m.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    black = np.zeros((len(points), 3), np.float32)
    return TriMesh("world", points.astype(np.float32), faces.astype(np.int32), black)


def _flattened(out_m: np.ndarray, returns: np.ndarray = NONE) -> np.ndarray:
    mesh = flatten_walls(_height_field(out_m), VOXEL_M, returns)
    return 10.0 - mesh.vertices[:, 1].reshape(out_m.shape)


def test_bumps_go_and_a_bowed_wall_keeps_its_course() -> None:
    rng = np.random.default_rng(0)
    bowed = 0.1 * np.sin(np.linspace(0.0, np.pi, 120))[:, None] + np.zeros((120, 40))
    bumps = np.where(rng.random(bowed.shape) < 0.3, rng.uniform(-0.04, 0.04, bowed.shape), 0.0)
    flat = _flattened(bowed + bumps)
    assert np.abs(flat - bowed)[1:-1, 1:-1].max() < 0.02
    assert np.abs(flat - bowed)[12:-12].mean() < 0.002
    steps, were = (np.abs(np.diff(x, axis=0))[1:-1, 1:-1].max() for x in (flat, bowed + bumps))
    assert steps < 0.25 * were


def test_a_ledge_and_a_wide_recess_stay() -> None:
    wall = np.zeros((120, 40))
    wall[:, 30:32] = 0.2
    wall[30:70, 5:28] = -0.12
    flat = _flattened(wall)
    np.testing.assert_allclose(flat[:, 30:32], 0.2, atol=2e-3)
    np.testing.assert_allclose(flat[40:60, 12:20], -0.12, atol=0.01)


def test_returns_sharpen_what_the_samples_rounded_off() -> None:
    """Panes stood 10 cm too far out, so that their lintels and sills cast no shadow."""
    rng = np.random.default_rng(2)
    wall = np.zeros((120, 40))
    wall[30:70, 5:28] = -0.15
    rounded = gaussian_filter(wall, 4.0)
    x, z = rng.uniform(0.0, 11.9, 20000), rng.uniform(0.0, 3.9, 20000)
    is_pane = (x > 2.95) & (x < 6.95) & (z > 0.45) & (z < 2.75)
    out = np.where(is_pane, -0.15, 0.0) + 0.01 * rng.standard_normal(len(x))
    returns = np.stack([x, 10.0 - out, z], axis=1).astype(np.float32)
    before, after = (_flattened(rounded, r) - wall for r in (NONE, returns))
    # The lowest rows are the ground's.
    assert np.abs(before[:, 3:]).mean() > 0.015
    assert np.abs(after[:, 3:]).mean() < 0.005
    assert np.percentile(np.abs(after[34:66, 9:24]), 90) < 0.015
    # A sparse half stays as it was.
    half = _flattened(rounded, returns[(x < 6.0) | (rng.random(len(x)) < 0.02)])
    np.testing.assert_allclose(half[65:], _flattened(rounded)[65:], atol=0.03)


def test_ground_and_lone_posts_are_no_walls() -> None:
    rng = np.random.default_rng(1)
    ground = _height_field(0.03 * rng.standard_normal((60, 60)))
    level = TriMesh("world", ground.vertices[:, [0, 2, 1]], ground.faces, ground.base_colour)
    same = flatten_walls(level, VOXEL_M, NONE)
    np.testing.assert_array_equal(same.vertices, level.vertices)
    post = _height_field(0.03 * rng.standard_normal((6, 60)))
    same = flatten_walls(post, VOXEL_M, NONE)
    np.testing.assert_array_equal(same.vertices, post.vertices)
