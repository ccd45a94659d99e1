"""Damaged models of other programs: glTF in both forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gltf_files import rich_document
from lightsim.store.gltf import read_gltf
from lightsim.store.primitive_mesh import mesh_of

from .containers import mutate_glb
from .mutations import Rng, mutate_bytes, mutate_json, pick

_EDGE_M = 0.3
"""Coarse, as the same code runs at any size."""


def write_model_case(folder: Path, rng: Rng) -> str:
    """A model with most features of glTF, damaged in its document or its bytes."""
    form = pick(rng, ("glb", "embedded", "separate"))
    path = rich_document().write(folder / f"model.{'glb' if form == 'glb' else 'gltf'}", form)
    if form == "glb":
        return mutate_glb(path, rng)
    damage = mutate_json if rng.random() < 0.7 else mutate_bytes
    target = path.with_suffix(".bin") if form == "separate" and rng.random() < 0.2 else path
    damage = damage if target == path else mutate_bytes
    data, words = damage(target.read_bytes(), rng)
    target.write_bytes(data)
    return f"{target.name}: {words}"


def read_model_case(folder: Path) -> None:
    """The reading part of `lightsim assets add`."""
    mesh, _ = mesh_of(read_gltf(next(folder.glob("model.gl*"))), texture_edge_m=_EDGE_M)
    for values in (mesh.vertices, mesh.base_colour, mesh.face_areas_m2()):
        if not np.isfinite(values).all():
            raise AssertionError("a mesh that is not finite")
