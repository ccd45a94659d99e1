"""Masts and boards whose feet a LiDAR saw rise as far as pictures show them, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from tests.geometry.test_buildings import (
    NO_CROWNS,
    WIDE,
    Box,
    _house,
    _street,
    _views,
    inputs_of,
)

from lightsim.core.buildings import Wall
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.uprights import raise_uprights
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.materials import VEGETATION

_MAST: Box = (14.0, 4.0, 14.5, 4.5, 8.0)
_BOARD: Box = (-20.0, -4.0, -19.75, 2.0, 9.0)
_BUSH: Box = (4.0, 5.0, 6.0, 6.0, 3.0)
_HALL: Box = (-5.0, 8.25, 25.0, 20.0, 14.0)


def _raised(
    true: Sequence[Box],
    seen: Sequence[Box],
    measured: Sequence[Box],
    crowns: Crowns = NO_CROWNS,
    material: Material | None = None,
) -> TriMesh:
    """What rises on `measured` boxes, of a material, in a street of `true` ones; `seen` stops
    beams."""
    truth = concatenate_meshes([_street(), *(_house(b, b[4], True) for b in true)])
    parts = [_street(), *(_house(b, b[4], True) for b in (*seen, *measured))]
    if material is not None:
        parts = [*parts[:-1], replace(parts[-1], materials=(material,))]
    background = concatenate_meshes(parts)
    return raise_uprights(inputs_of(_views(truth, WIDE)), Scene(background, crowns))


def _cut(box: Box, height_m: float) -> Box:
    return (*box[:4], height_m)


@pytest.mark.parametrize(("box", "seen_m"), [(_MAST, 3.0), (_BOARD, 4.0)])
def test_what_the_highest_beam_cut_off_rises_to_its_top(box: Box, seen_m: float) -> None:
    mesh = _raised([box], [], [_cut(box, seen_m)])
    assert mesh.comes_from(Provenance.INFERRED).all()
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert high[2] == pytest.approx(box[4], abs=0.6)
    np.testing.assert_allclose(low[:2], box[:2], atol=0.3)
    np.testing.assert_allclose(high[:2], box[2:4], atol=0.3)
    # Closed but for cells that touch at an edge, and outward: the volume is positive.
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    volume = np.einsum("nc,nc->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    wanted = (box[2] - box[0]) * (box[3] - box[1]) * (box[4] - seen_m)
    assert 0.5 * wanted < volume < 2.5 * wanted


def test_what_stands_on_a_crown_is_leaves() -> None:
    """As dense as the crown below, whose voxels reach up to 3 m."""
    box = (14.0, 4.0, 15.2, 5.2, 6.0)
    cells = np.argwhere(np.ones((3, 3, 2), bool))
    crowns = Crowns(
        np.array([14.0, 4.0, 2.2]), 0.4, cells, np.zeros(18, np.int64), np.full(18, 2.0),
        np.zeros((0, 3)), np.zeros(19, np.int64), np.array([[14.0, 0.0, 0.0]]),
    )  # fmt: skip
    leaves = _raised([box], [], [_cut(box, 3.0)], crowns)
    assert leaves.comes_from(Provenance.INFERRED).all()
    middle = leaves.vertices[leaves.faces].mean(axis=1)
    assert middle[:, 2].min() > 2.8
    assert middle[:, 2].max() == pytest.approx(6.0, abs=0.4)
    # Leaves that were guessed higher up than voxels reach carry leaves, too.
    higher = _raised([box], [], [_cut(box, 4.0)], crowns, VEGETATION)
    assert higher.face_material is not None
    assert {higher.materials[k] for k in higher.face_material} == {VEGETATION}
    boxes = _raised([box], [], [_cut(box, 3.0)])
    corners = boxes.vertices[boxes.faces].astype(np.float64)
    volume = np.einsum("nc,nc->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert leaves.face_areas_m2().sum() == pytest.approx(2.0 / 0.5 * volume, rel=0.2)


def test_a_bush_before_a_hall_stays_a_bush() -> None:
    """Its own top is all that was measured; above it every view shows the hall, whose upper part
    no beam reached."""
    mesh = _raised([_BUSH, _HALL], [_cut(_HALL, 4.0)], [_BUSH])
    x, y = mesh.vertices[:, :2].T
    over_bush = (x > 3.5) & (x < 6.5) & (y > 4.5) & (y < 6.5)
    assert not over_bush.any()


def test_nothing_rises_where_views_show_sky() -> None:
    assert len(_raised([_cut(_MAST, 3.0)], [], [_cut(_MAST, 3.0)]).faces) == 0
    assert len(_raised([], [], []).faces) == 0


def test_the_top_of_a_wall_is_left_to_its_roof_edge() -> None:
    """The measured part of a board rises if it is no wall."""
    background = concatenate_meshes([_street(), _house(_cut(_BOARD, 4.0), 4.0, True)])
    truth = concatenate_meshes([_street(), _house(_BOARD, _BOARD[4], True)])
    inputs = inputs_of(_views(truth, WIDE))

    def height_m(walls: list[Wall]) -> float:
        mesh = raise_uprights(inputs, Scene(background, NO_CROWNS, walls))
        is_inner = np.abs(mesh.vertices[:, 1] + 1.0) < 2.5
        return float(mesh.vertices[is_inner, 2].max(initial=0.0))

    assert height_m([]) == pytest.approx(_BOARD[4], abs=0.6)
    assert height_m(find_walls(background)) == 0.0
