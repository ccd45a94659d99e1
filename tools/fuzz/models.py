"""Damaged models of other programs: glTF in both forms, OBJ with materials and pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.gltf_files import disc_picture, picture, rich_document

from lightsim.core.mesh import TriMesh
from lightsim.scenario.models import load_model
from lightsim.scenario.wheels import find_wheels
from lightsim.store.gltf import read_gltf
from lightsim.store.primitive_mesh import mesh_of

from .containers import mutate_glb
from .mutations import Rng, mutate_bytes, mutate_json, mutate_text, pick

_EDGE_M = 0.3
"""Coarse, as the same code runs at any size."""

_OBJ = """# by hand
mtllib model.mtl
o thing
v 0 0 0 0.5 0.5 0.5
v 2 0 0
v 2 1 0
v 0 1 0
v 0.5 0.5 1
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
s 1
usemtl paint
f 1/1/1 2/2/1 3/3/1 4/1/1
f -1 -2 \\
 -3
usemtl glass
f 1//1 2//1 5//1
s off
f 1 2 3 5 4
l 1 2
curv 0 1 1 2 3
"""
_MTL = """newmtl paint
Kd 0.6 0.03 0.03
Ns 225
map_Kd -s 2 2 1 -o 0.5 picture.png
map_d picture.png
Pr 0.4
newmtl glass
Kd 0.1 0.1 0.1
d 0.3
Tr 0.7
illum 4
"""


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
    _require_finite(mesh)


def write_obj_case(folder: Path, rng: Rng) -> str:
    """A small OBJ with every kind of statement; damage to the text, its materials or picture."""
    (folder / "model.obj").write_text(_OBJ)
    (folder / "model.mtl").write_text(_MTL)
    (folder / "picture.png").write_bytes(picture(disc_picture(8)))
    path = folder / pick(rng, ["model.obj", "model.obj", "model.mtl", "picture.png"])
    if path.suffix == ".png" or rng.random() < 0.3:
        data, words = mutate_bytes(path.read_bytes(), rng)
        path.write_bytes(data)
    else:
        text, words = mutate_text(path.read_text(), rng)
        path.write_text(text, errors="replace")
    return f"{path.name}: {words}"


def read_obj_case(folder: Path) -> None:
    """`lightsim assets add` without the library: reading, axes, size and wheels."""
    mesh = load_model(folder / "model.obj").mesh
    find_wheels(mesh)
    _require_finite(mesh)


def _require_finite(mesh: TriMesh) -> None:
    for values in (mesh.vertices, mesh.base_colour, mesh.face_areas_m2()):
        if not np.isfinite(values).all():
            raise AssertionError("a mesh that is not finite")
