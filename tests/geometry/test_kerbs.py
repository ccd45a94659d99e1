"""A road with two kerbs that beams saw: where they are, and what becomes of their ramps."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.test_poles import GROUND

from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.kerbs import Kerb, find_kerbs, with_edges, with_kerbs

PATH_M = np.array([[x, 0.02 * x, 0.0] for x in np.arange(0.0, 12.0)])
HIGH_M, LEFT_M, RIGHT_M = 0.13, 6.8, -3.4
"""Of the kerbs: height, and places to the left of the path, which is turned by a degree."""
AHEAD = np.array([1.0, 0.02]) / np.hypot(1.0, 0.02)
TO_LEFT = np.array([-AHEAD[1], AHEAD[0]])


def _returns(high_m: float = HIGH_M, slope: float = 0.0) -> np.ndarray:
    """Scattered over the ground and the faces, but for where a car is parked along the right, with
    1 cm of noise."""
    rng = np.random.default_rng(0)
    along, aside = rng.uniform(-15, 27, 120_000), rng.uniform(-8, 10, 120_000)
    z = np.where((aside > LEFT_M) | (aside < RIGHT_M), high_m, 0.0) + slope * aside
    face = rng.uniform(-15, 27, 2000), rng.choice([LEFT_M, RIGHT_M], 2000)
    along, aside = (np.r_[a, b] for a, b in zip((along, aside), face, strict=True))
    z = np.r_[z, rng.uniform(0, max(high_m, 1e-3), 2000) + slope * face[1]]
    is_seen = ~((along > 3) & (along < 7.5) & (aside < -1.5) & (aside > -6))
    xy = along[:, None] * AHEAD + aside[:, None] * TO_LEFT
    points = np.column_stack([xy, z + 0.01 * rng.standard_normal(len(z))])
    return points[is_seen].astype(np.float32)


@pytest.fixture(scope="module")
def kerbs() -> list[Kerb]:
    return find_kerbs(_returns(), GROUND, PATH_M)


def test_kerbs_are_found_to_centimetres_past_a_parked_car(kerbs: list[Kerb]) -> None:
    assert len(kerbs) == 2
    for kerb, aside, towards in zip(
        sorted(kerbs, key=lambda k: -k.edge_m[0, 1]), (LEFT_M, RIGHT_M), (-1, 1), strict=True
    ):
        np.testing.assert_allclose(kerb.edge_m @ TO_LEFT, aside, atol=0.03)
        np.testing.assert_allclose(kerb.low_m, 0.0, atol=0.01)
        np.testing.assert_allclose(kerb.high_m, HIGH_M, atol=0.01)
        np.testing.assert_allclose(kerb.towards_low @ TO_LEFT, towards, atol=1e-3)
        assert np.ptp(kerb.edge_m @ AHEAD) > 35.0


@pytest.mark.parametrize(("high_m", "slope"), [(0.0, 0.0), (0.0, 0.08), (0.02, 0.0)])
def test_level_ground_slopes_and_joints_are_no_kerbs(high_m: float, slope: float) -> None:
    points = _returns(high_m, slope)
    points = points[np.abs(points[:, 1]) < 4] if slope else points
    assert find_kerbs(points, GROUND, PATH_M) == []


def test_a_path_that_leads_nowhere_has_no_kerbs() -> None:
    assert find_kerbs(_returns(), GROUND, PATH_M[:1]) == []
    assert find_kerbs(np.zeros((0, 3), np.float32), GROUND, PATH_M) == []


def test_a_ramp_becomes_an_upright_face(kerbs: list[Kerb]) -> None:
    """Samples 0.1 m apart, moved, the ramp three of them wide: the face has the kerb's length and
    height, all else is level."""
    x, y = (k.ravel() for k in np.meshgrid(np.arange(0, 8, 0.1), np.arange(-5, 0, 0.1)))
    x, y = (k + np.random.default_rng(7).uniform(-0.02, 0.02, len(k)) for k in (x, y))
    aside = np.column_stack([x, y]) @ TO_LEFT
    z = HIGH_M * np.clip((RIGHT_M + 0.15 - aside) / 0.3, 0, 1)
    rows, columns = 50, 80
    at = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate(
        [np.stack([at, at + 1, at + columns + 1], 1),
         np.stack([at, at + columns + 1, at + columns], 1)]
    ).astype(np.int32)  # fmt: skip
    points = np.column_stack([x, y, z]).astype(np.float32)
    before = TriMesh("world", points, faces, np.zeros_like(points))
    after = with_kerbs(before, kerbs, 0.1)
    normal, area = after.face_normals(), after.face_areas_m2()
    is_upright = np.abs(normal[:, 2]) < 0.2
    assert (np.abs(before.face_normals()[:, 2]) > 0.9).all()
    assert area[is_upright].sum() == pytest.approx(7.9 * HIGH_M, rel=0.05)
    # But for slivers.
    is_level = normal[:, 2] > 0.98
    assert area[~is_upright & ~is_level].sum() < 0.03 * area[is_upright].sum()
    # Towards the road.
    assert (normal[is_upright][:, :2] @ TO_LEFT > 0.95).all()
    assert area.min() > 0
    assert with_kerbs(before, kerbs, 0.4) is before
    # Shaded as upright and as level, not as round.
    sharp = with_edges(after, kerbs)
    lean = np.abs(sharp.vertex_normals()[sharp.faces][..., 2])
    assert lean[is_upright].max() < 0.3
    assert np.median(lean[is_level]) > 0.999
    np.testing.assert_array_equal(sharp.vertices[sharp.faces], after.vertices[after.faces])
