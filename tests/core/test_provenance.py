"""Where faces come from, through everything that makes one mesh of another."""

from __future__ import annotations

import numpy as np

from lightsim.core.mesh import Provenance, concatenate_meshes
from lightsim.geometry.surface import keep_faces, make_mesh


def test_faces_are_measured_until_told_otherwise() -> None:
    triangle = make_mesh("world", np.eye(3), np.arange(3)[None])
    assert triangle.has_provenance(Provenance.MEASURED).all()
    assert not triangle.has_provenance(Provenance.INFERRED, Provenance.MIRRORED).any()
    assert concatenate_meshes([triangle, triangle]).face_provenance is None
    guessed = triangle.with_provenance(Provenance.INFERRED)
    mesh = concatenate_meshes([triangle, guessed, triangle])
    assert mesh.has_provenance(Provenance.INFERRED).tolist() == [False, True, False]
    assert mesh.has_provenance(Provenance.MEASURED).tolist() == [True, False, True]
    kept = keep_faces(mesh, np.array([False, True, True]))
    assert kept.has_provenance(Provenance.INFERRED).tolist() == [True, False]
