"""Webs that a coarse field spans beside a mast go where views show sky; the mast stays."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.test_buildings import GROUND, LEFT_HOUSE, WIDE, View, _house, _street, _views

from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.before_sky import remove_before_sky
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.surface import keep_faces
from lightsim.render.casters.embree import EmbreeCaster

MAST, WEB = (-20.0, -0.4, -19.2, 0.4, 9.0), (-20.0, 0.4, -19.2, 3.0, 9.0)


def _measured(*boxes: tuple[float, float, float, float, float]) -> TriMesh:
    whole = [_house(box, box[4], True) for box in (LEFT_HOUSE, *boxes)]
    return concatenate_meshes([_street(), *whole]).with_provenance(Provenance.MEASURED)


@pytest.fixture(scope="module")
def views() -> list[View]:
    return _views(_measured(MAST), WIDE)


def _over(mesh: TriMesh, box: tuple[float, float, float, float, float], low_m: float) -> float:
    """Area of what lies within a box, above a height."""
    low, high = np.array([*box[:2], low_m]) - 0.05, np.array([*box[2:4], box[4]]) + 0.05
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    return float(mesh.face_areas_m2()[((centres > low) & (centres < high)).all(axis=1)].sum())


def test_a_web_goes_from_all_its_sides_and_the_mast_stays(views: list[View]) -> None:
    measured = _measured(MAST, WEB)
    kept = remove_before_sky(measured, ViewEvidence(views), GROUND, EmbreeCaster)
    inner = (WEB[0], WEB[1] + 0.6, *WEB[2:])
    assert _over(kept, inner, 2.5) < 0.02 * _over(measured, inner, 2.5)
    outer = (MAST[0], MAST[1], MAST[2], 0.2, MAST[4] - 0.5)
    assert _over(kept, outer, 0.0) > 0.95 * _over(measured, outer, 0.0)
    house = (*LEFT_HOUSE[:4], LEFT_HOUSE[4])
    assert _over(kept, house, 0.0) > 0.99 * _over(measured, house, 0.0)
    assert kept.has_provenance(Provenance.MEASURED).all()
    # The ground tells where views look from below.
    assert _over(kept, (-40, -9, 60, 8, 0.1), -1.0) == _over(measured, (-40, -9, 60, 8, 0.1), -1.0)


def test_nothing_changes_where_all_is_right(views: list[View]) -> None:
    measured = _measured(MAST)
    kept = remove_before_sky(measured, ViewEvidence(views), GROUND, EmbreeCaster)
    assert kept.face_areas_m2().sum() == pytest.approx(measured.face_areas_m2().sum(), rel=0.01)


def test_one_wrong_matte_cuts_nothing(views: list[View]) -> None:
    measured = _measured(MAST)
    shown = [(frame, camera, np.zeros_like(matte)) for frame, camera, matte in views]
    shown[0] = (*shown[0][:2], np.ones_like(shown[0][2]))
    kept = remove_before_sky(measured, ViewEvidence(shown), GROUND, EmbreeCaster)
    np.testing.assert_array_equal(kept.faces, measured.faces)
    empty = keep_faces(measured, np.zeros(len(measured.faces), dtype=bool))
    assert len(remove_before_sky(empty, ViewEvidence(shown), GROUND, EmbreeCaster).faces) == 0
