"""Boxes in one place, and walls in boxes."""

from __future__ import annotations

import numpy as np
import pytest
from tests.render.rendering_scenes import box, plane

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.render.casters.embree import make_embree_caster
from lightsim.scenario.conflicts import boxes_overlap, is_cut


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
    assert boxes_overlap(standing(0, 0), other, 0) == is_overlap
    assert boxes_overlap(other, standing(0, 0), 0) == is_overlap


def test_a_wall_in_the_box_is_found_and_the_ground_is_not() -> None:
    ground = plane(20.0, 4, np.full(3, 0.3, np.float32))
    wall = box((0.0, 5.0, 3.0), (20.0, 0.4, 6.0), 0.5)
    caster = make_embree_caster([ground, wall])
    assert not is_cut(caster, standing(0, 0), 0)
    assert not is_cut(caster, standing(0, 3.6), 0)
    assert is_cut(caster, standing(0, 4.2), 0)
    assert is_cut(caster, standing(0, 3.2, 90.0), 0)
