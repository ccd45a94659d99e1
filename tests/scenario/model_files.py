"""Writes meshes of tests as model files with any axis up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.gltf_files import GltfBuilder

from lightsim.core.mesh import TriMesh

AXES = {
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
}
"""Axes of the file along which x, y and z of the mesh are, by the axis that is up."""


def write_model(path: Path, mesh: TriMesh, up: str = "y", unit: float = 1.0) -> Path:
    """Write a mesh as .obj, .gltf or .glb by its suffix, one material for each colour.

    Args:
        up: axis of the file that is up.
        unit: metres per unit of the file.
    """
    vertices = mesh.vertices.astype(np.float64) @ np.array(AXES[up]) / unit
    colours, material = np.unique(mesh.base_colour, axis=0, return_inverse=True)
    of_face = material.reshape(-1)[mesh.faces[:, 0]]
    if path.suffix.lower() == ".obj":
        _write_obj(path, vertices, mesh.faces, colours, of_face)
    else:
        _write_gltf(path, vertices, mesh.faces, colours, of_face)
    return path


def _write_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, of_face: np.ndarray
) -> None:
    lines = [f"mtllib {path.stem}.mtl"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    materials = []
    for n, (r, g, b) in enumerate(colours):
        lines.append(f"usemtl m{n}")
        lines += [f"f {i} {j} {k}" for i, j, k in faces[of_face == n] + 1]
        materials.append(f"newmtl m{n}\nKd {r:.6f} {g:.6f} {b:.6f}\nPr 0.4\n")
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text("".join(materials))


def _write_gltf(
    path: Path, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, of_face: np.ndarray
) -> None:
    builder = GltfBuilder()
    for n, colour in enumerate(colours):
        used, numbers = np.unique(faces[of_face == n], return_inverse=True)
        builder.primitive(vertices[used], numbers, material=n)
        pbr = {"baseColorFactor": [*map(float, colour), 1.0], "roughnessFactor": 0.4,
               "metallicFactor": 0.0}  # fmt: skip
        builder.document["materials"].append({"name": f"m{n}", "pbrMetallicRoughness": pbr})
    builder.write(path, "glb" if path.suffix.lower() == ".glb" else "embedded")
