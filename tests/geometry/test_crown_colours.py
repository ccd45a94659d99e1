"""Clusters of scattered returns are crowns where pictures show green."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.scanning import scanned
from tests.geometry.test_crowns import _quad, squares
from tests.geometry.test_poles import GROUND, PATH_M

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.crown_colours import is_green
from lightsim.geometry.completion.crowns import Beams, Crowns, find_crowns
from lightsim.geometry.completion.leaf_cards import crown_cards
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.completion.walls import find_walls
from lightsim.render.casters.embree import EmbreeCaster

CENTRE, RADIUS_M, CUT_M = np.array([0.0, 8.0, 4.6]), 1.6, 4.6
"""Of the crown; half of it lies above the beams."""
CAMERA = PinholeCamera("left", 240, 180, 120.0, 120.0, 120.0, 120.0)
GREEN, GREY, BLUE = (60, 110, 40), (128, 128, 128), (120, 160, 230)


def _leaves() -> np.ndarray:
    rng = np.random.default_rng(3)
    offsets = rng.uniform(-RADIUS_M, RADIUS_M, (20000, 3))
    return CENTRE + offsets[np.linalg.norm(offsets, axis=1) < RADIUS_M][:1500]


def _cards(centres: np.ndarray) -> TriMesh:
    rng = np.random.default_rng(4)
    normal, other = rng.standard_normal((2, len(centres), 3))
    return squares(centres, normal, other, 0.08)


def _walls() -> TriMesh:
    ground = _quad((-40, -40, 0), (40, -40, 0), (40, 40, 0), (-40, 40, 0))
    return concatenate_meshes([ground, _quad((25, 10, 0), (-25, 10, 0), (-25, 10, 9), (25, 10, 9))])


def _beams(scene: TriMesh) -> Beams:
    """From seven places, none higher than a line through the middle of the crown."""
    highest_deg = float(np.degrees(np.arctan2(CUT_M - 1.9, CENTRE[1])))
    return Beams(*scanned(scene, 0.4, highest_deg, rings=60, noise_m=0.0))


def _views(leaves: TriMesh, walls: TriMesh, colour: tuple[int, int, int] = GREEN) -> ViewEvidence:
    """A camera looks at the crown and drives by, with the pictures of what stands there."""
    both, solid = EmbreeCaster([leaves, walls]), EmbreeCaster([walls])
    rotation = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    views = []
    for x_m in np.arange(-6.0, 7.0, 3.0):
        pose = RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, 0, 1.6]))
        frame = CameraFrame("left", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), "u1"))
        origins, rays = frame.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
        first, behind = (caster.intersect(origins, rays) for caster in (both, solid))
        is_leaf = first.is_hit & ~(first.distance_m > behind.distance_m - 1e-3)
        picture = np.where(behind.is_hit[:, None], GREY, BLUE)
        picture[is_leaf] = colour
        image = picture.astype(np.uint8).reshape(CAMERA.height_px, -1, 3)
        sky = (~first.is_hit).reshape(CAMERA.height_px, -1).astype(np.float32)
        shown = CameraFrame("left", frame.stem, 0, pose, lambda image=image: image)
        views.append((shown, CAMERA, sky))
    return ViewEvidence(views)


@pytest.fixture(scope="module")
def crowns() -> Crowns:
    scene = concatenate_meshes([_walls(), _cards(_leaves())])
    return find_crowns(_beams(scene), find_walls(_walls()), GROUND, PATH_M)


@pytest.mark.parametrize("colour", [GREEN, GREY, BLUE, (150, 80, 60)])
def test_a_crown_is_green(crowns: Crowns, colour: tuple[int, int, int]) -> None:
    """A transformer on a mast scatters beams as leaves do."""
    cards = crown_cards(crowns, np.random.default_rng(0))
    scene = EmbreeCaster([_walls(), cards])
    kept = is_green(crowns, _views(_cards(_leaves()), _walls(), colour), scene)
    assert kept.tolist() == [colour == GREEN] * len(crowns)
    left = crowns.only(kept)
    assert len(left) == kept.sum()
    assert len(left.returns_m) == left.first_return[-1] == kept.all() * len(crowns.returns_m)
    # What no picture shows stays.
    assert is_green(crowns, ViewEvidence([]), scene).all()


def test_some_of_the_crowns() -> None:
    cells = np.array([[0, 0, 0], [5, 0, 0], [6, 0, 0], [9, 0, 0]])
    returns = np.arange(21.0).reshape(7, 3)
    first = np.array([0, 2, 3, 6, 7])
    number = np.array([0, 1, 1, 2])
    crowns = Crowns(np.zeros(3), 0.4, cells, number, np.arange(4.0), returns, first, PATH_M)
    left = crowns.only(np.array([True, False, True]))
    assert left.cells.tolist() == [[0, 0, 0], [9, 0, 0]]
    assert left.crown.tolist() == [0, 1]
    assert left.first_return.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(left.returns_m, returns[[0, 1, 6]])
    np.testing.assert_array_equal(left.extinction, [0, 3])
