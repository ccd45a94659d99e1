"""Paths, headings and wheels on the ground, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from tests.render.rendering_scenes import plane

from lightsim.core.actors import ActorKind
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.edits import Waypoint
from lightsim.scenario.ground import StandingGround
from lightsim.scenario.motion import moved_along, shifted, standing_poses

CAR = (ActorKind.CAR, np.array([4.0, 2.0, 1.5]))
SPAN_NS = (10**9, 5 * 10**9)


def slope(ahead: float = 0.0, left: float = 0.0) -> StandingGround:
    """z = ahead x + left y, known within 10 m."""
    x, y = np.meshgrid(np.arange(81) * 0.5 - 20, np.arange(81) * 0.5 - 20, indexing="ij")
    is_known = (np.abs(x) <= 10) & (np.abs(y) <= 10)
    height = (ahead * x + left * y).astype(np.float32)
    return StandingGround(GroundMap(np.array([-20.0, -20.0]), 0.5, height, is_known))


@pytest.mark.parametrize("yaw_deg", [0.0, 40.0, -160.0])
def test_wheels_stand_on_a_slope(yaw_deg: float) -> None:
    ground = slope(0.1, -0.05)
    yaw = np.radians([yaw_deg])
    (pose,) = standing_poses(np.array([[1.0, 2.0]]), yaw, CAR, ground)
    normal = np.array([-0.1, 0.05, 1.0]) / np.linalg.norm([-0.1, 0.05, 1.0])
    np.testing.assert_allclose(pose[:3, 2], normal, atol=1e-6)
    # All four corners of the underside lie on the plane, and the front looks along the heading.
    corners = np.array([[x, y, -0.75, 1] for x in (-2, 2) for y in (-1, 1)]) @ pose.T
    np.testing.assert_allclose(corners[:, 2], 0.1 * corners[:, 0] - 0.05 * corners[:, 1], atol=1e-6)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(yaw[0], abs=1e-6)


def test_persons_stand_upright_and_a_given_height_is_kept() -> None:
    person = (ActorKind.PEDESTRIAN, np.array([0.6, 0.6, 1.8]))
    (pose,) = standing_poses(np.array([[2.0, 0.0]]), np.zeros(1), person, slope(0.1))
    np.testing.assert_allclose(pose[:3, 2], [0, 0, 1])
    assert pose[2, 3] == pytest.approx(0.2 + 0.9)
    here = (Waypoint(x_m=0.0, y_m=0.0, z_m=3.0, yaw_deg=0.0),)
    flying = moved_along(here, SPAN_NS, CAR, slope(0.1), "edit")
    assert flying.at(3 * 10**9).translation_m.tolist() == [0.0, 0.0, 3.75]


def test_a_path_goes_through_its_waypoints_and_looks_ahead() -> None:
    way = ((0.0, 0.0, 0.0), (1.0, 4.0, 0.0), (2.0, 8.0, 4.0), (3.0, 8.0, 4.0))
    points = tuple(Waypoint(time_s=t, x_m=x, y_m=y) for t, x, y in way)
    path = moved_along(points, SPAN_NS, CAR, slope(), "edit")
    for t, x, y in way:
        pose = path.at(SPAN_NS[0] + int(t * 1e9))
        np.testing.assert_allclose(pose.translation_m, [x, y, 0.75], atol=1e-3)
    steps = np.diff(path.positions_m[:, :2], axis=0)
    moving = np.linalg.norm(steps, axis=1) > 0.02
    ahead = path.matrices[:-1, :2, 0][moving]
    along = steps[moving] / np.linalg.norm(steps[moving], axis=1, keepdims=True)
    assert (np.einsum("nc,nc->n", ahead, along) > 0.98).all()
    # While it stands at the end it keeps its last heading.
    yaw = np.arctan2(path.matrices[-15:, 1, 0], path.matrices[-15:, 0, 0])
    assert np.ptp(yaw) < 0.05


def test_a_path_ends_with_the_log() -> None:
    points = tuple(Waypoint(time_s=t, x_m=t, y_m=0.0) for t in (0.0, 4.5))
    with pytest.raises(InputError, match=r"0 to 4\.000 s"):
        moved_along(points, SPAN_NS, CAR, slope(), "edit")


def test_an_offset_lies_in_the_actors_own_axes() -> None:
    here = (Waypoint(x_m=1.0, y_m=1.0, yaw_deg=90.0),)
    path = moved_along(here, SPAN_NS, CAR, slope(), "edit")
    moved = shifted(path, (2.0, 1.0, 0.5)).positions_m[0]
    np.testing.assert_allclose(moved, [0.0, 3.0, 1.25], atol=1e-9)


def test_the_twins_road_is_what_things_stand_on_and_a_bridge_is_not() -> None:
    road = plane(20.0, 1, np.full(3, 0.3, np.float32))
    lower, bridge = (_lifted(road, z) for z in (0.04, 4.0))
    ground = StandingGround(slope().heights, make_embree_caster([lower, bridge]))
    height_m = ground.height_m(np.array([[1.0, 2.0], [30.0, 0.0]]))
    np.testing.assert_allclose(height_m, [0.04, 0.0], atol=1e-6)
    assert ground.is_known(np.array([[9.0, 0.0], [12.0, 0.0], [15.0, 0.0]])).tolist() == [
        True,
        True,
        False,
    ]


def _lifted(mesh: TriMesh, z_m: float) -> TriMesh:
    from dataclasses import replace

    return replace(mesh, vertices=mesh.vertices + np.array([0, 0, z_m], np.float32))
