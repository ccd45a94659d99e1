"""Boxes in one place, and walls in boxes."""

from __future__ import annotations

import numpy as np
import pytest
from tests.render.rendering_scenes import box, plane

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.conflicts import boxes_overlap, cuts_static


def standing(x: float, y: float, yaw_deg: float = 0.0, z: float = 0.75) -> ActorTrack:
    pose = RigidTransform.from_yaw("world", "actor", np.radians(yaw_deg), np.array([x, y, z]))
    path = Trajectory("world", "actor", np.array([0]), pose.matrix[None])
    return ActorTrack("a", ActorKind.CAR, np.array([4.0, 2.0, 1.5]), path, False)


@pytest.mark.parametrize(
    ("other", "is_overlap"),
    [
        (standing(3.8, 0), True),
        (standing(4.1, 0), False),
        (standing(0, 1.95), False),  # They touch by less than labels do.
        (standing(0, 1.8), True),
        (standing(3.0, 0, 90.0), False),
        (standing(2.8, 0, 90.0), True),
        # A corner points at the side: the circles around them overlap, the boxes do not.
        (standing(0.0, 3.2, 45.0), False),
        (standing(0.0, 2.9, 45.0), True),
        (standing(0.5, 0.2, 30.0, z=2.6), False),
    ],
)
def test_boxes_overlap_as_they_stand(other: ActorTrack, is_overlap: bool) -> None:
    here = standing(0, 0)
    for a, b in ((here, other), (other, here)):
        found = boxes_overlap(
            a.trajectory.matrices, a.size_lwh_m, b.trajectory.matrices, b.size_lwh_m
        )
        assert found.tolist() == [is_overlap]


def test_a_wall_in_the_box_is_found_and_the_ground_is_not() -> None:
    ground = plane(20.0, 4, np.full(3, 0.3, np.float32))
    wall = box((0.0, 5.0, 3.0), (20.0, 0.4, 6.0), 0.5)
    caster = make_embree_caster([ground, wall])
    places = [standing(0, 0), standing(0, 3.6), standing(0, 4.2), standing(0, 3.2, 90.0)]
    poses = np.concatenate([place.trajectory.matrices for place in places])
    is_cut = cuts_static(caster, poses, places[0].size_lwh_m)
    assert is_cut.tolist() == [False, False, True, True]
