"""A crown that the highest beam cuts off goes on, where pictures do not say otherwise."""

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
from lightsim.geometry.completion.crown_shapes import unseen_leaves
from lightsim.geometry.completion.crowns import Beams, Crowns, find_crowns
from lightsim.geometry.completion.leaf_cards import cards_above, crown_cards
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


def _unseen(shown: np.ndarray) -> tuple[Crowns, np.ndarray]:
    """What is made of the beams that met the whole crown, with pictures of `shown` leaves."""
    scene = concatenate_meshes([_walls(), _cards(_leaves())])
    beams, walls = _beams(scene), find_walls(_walls())
    crowns = find_crowns(beams, walls, GROUND, PATH_M)
    measured = concatenate_meshes([_walls(), crown_cards(crowns, np.random.default_rng(0))])
    views = _views(_cards(shown), _walls())
    return crowns, unseen_leaves(crowns, beams, walls, views, EmbreeCaster([measured]))


@pytest.fixture(scope="module")
def whole() -> tuple[Crowns, np.ndarray]:
    return _unseen(_leaves())


def test_a_crown_goes_on_above_the_highest_beam(whole: tuple[Crowns, np.ndarray]) -> None:
    crowns, found = whole
    own = crowns.low_m + (crowns.cells + 0.5) * crowns.voxel_m
    away = np.linalg.norm(found - CENTRE, axis=1)
    whole_m3, cell_m3 = 4 / 3 * np.pi * RADIUS_M**3, crowns.voxel_m**3
    assert len(own) * cell_m3 < 0.7 * whole_m3
    assert (away < RADIUS_M + 0.4).mean() > 0.85
    assert 0.9 * whole_m3 < (len(own) + len(found)) * cell_m3 < 1.4 * whole_m3
    assert found[:, 2].max() == pytest.approx(CENTRE[2] + RADIUS_M, abs=0.5)
    # Nothing grows in the wall, nor where beams passed below.
    assert found[:, 1].max() < 10.0
    assert found[:, 2].min() > CENTRE[2] - RADIUS_M - 0.4


def test_a_crown_ends_where_pictures_show_what_is_behind(
    whole: tuple[Crowns, np.ndarray],
) -> None:
    """A clipped tree: the beams are the same, pictures show the wall and the sky above the cut."""
    leaves = _leaves()
    _, found = _unseen(leaves[leaves[:, 2] < CUT_M])
    above, grown = (int((cells[:, 2] > CUT_M + 0.8).sum()) for cells in (found, whole[1]))
    assert above < 0.1 * grown


@pytest.mark.parametrize("colour", [GREEN, GREY, BLUE, (150, 80, 60)])
def test_a_crown_is_green(whole: tuple[Crowns, np.ndarray], colour: tuple[int, int, int]) -> None:
    """A transformer on a mast scatters beams as leaves do."""
    crowns, _ = whole
    cards = crown_cards(crowns, np.random.default_rng(0))
    scene = EmbreeCaster([_walls(), cards])
    kept = is_green(crowns, _views(_cards(_leaves()), _walls(), colour), scene)
    assert kept.tolist() == [colour == GREEN] * len(crowns)
    left = crowns.select(kept)
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
    left = crowns.select(np.array([True, False, True]))
    assert left.cells.tolist() == [[0, 0, 0], [9, 0, 0]]
    assert left.crown.tolist() == [0, 1]
    assert left.first_return.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(left.returns_m, returns[[0, 1, 6]])
    np.testing.assert_array_equal(left.extinction, [0, 3])


def test_without_a_crown_there_is_nothing_to_go_on() -> None:
    none = np.zeros((0, 3), np.float32)
    caster = EmbreeCaster([_walls()])
    crowns = Crowns.none(PATH_M)
    cells = unseen_leaves(crowns, Beams(none, none), [], ViewEvidence([]), caster)
    assert len(cells) == 0
    assert len(cards_above(crowns, cells, 0.4, np.random.default_rng(0)).faces) == 0
