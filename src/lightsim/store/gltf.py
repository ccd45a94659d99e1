"""Reader of glTF 2.0, binary (.glb) and text (.gltf): triangles with materials and textures.

Reference: Khronos glTF 2.0 specification (registry.khronos.org/glTF/specs/2.0).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from lightsim.errors import InputError
from lightsim.store.gltf_accessors import Accessors
from lightsim.store.gltf_document import GltfCode, GltfDocument, extensions, read_document
from lightsim.store.gltf_extensions import DRACO, check_required, note_unknown, unsupported
from lightsim.store.gltf_materials import Geometry, Materials, Surface
from lightsim.store.gltf_scene import Placement, Scene, skinned
from lightsim.store.gltf_textures import LARGEST_UV, Textures
from lightsim.store.notes import Notes
from lightsim.store.primitives import FARTHEST, MAX_PRIMITIVES, MAX_VERTICES, ModelFile, Primitive

# Largest number of faces of all instances together: a closed mesh has twice as many faces as
# vertices.
_MAX_FACES = 2 * MAX_VERTICES


def read_gltf(path: Path) -> ModelFile:
    """Return the triangles of a .glb or .gltf file, with notes on ignored features.

    Points and lines are omitted. Axes and units are the file's: y up, metres.

    Raises:
        InputError: the file is missing or damaged, has no triangles, or needs an extension that is
            not supported.
    """
    try:
        document = read_document(path)
        check_required(path, document.json.get("extensionsRequired", []))
        reader = _Reader(document)
        # Overflow is detected afterwards, in the placed vertices.
        with np.errstate(over="ignore", invalid="ignore"):
            primitives = reader.primitives()
    except (
        ValueError, ArithmeticError, LookupError, TypeError, AttributeError, struct.error,
    ) as error:  # fmt: skip
        is_plain = isinstance(error, ValueError)
        raise InputError(
            "the model cannot be read",
            where=path,
            got=f"{'' if is_plain else type(error).__name__ + ': '}{error}"[:200],
            expected="glTF 2.0 (.glb or .gltf)",
            remedy="Check it with a glTF validator, or export it again.",
        ) from error
    if not primitives:
        raise InputError(
            "the model has no triangles",
            where=path,
            got=reader.left_out or "no mesh in its default scene",
            expected="triangles",
            remedy="Export its surfaces.",
        )
    return ModelFile(path, tuple(primitives), reader.notes.sentences())


@dataclass(frozen=True, eq=False)
class _Part:
    """A primitive in the coordinates of its mesh, before it is placed in the scene."""

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    surface: Surface
    vertex_colour: Float64[np.ndarray, "n 4"] | None
    joints: tuple[Float64[np.ndarray, "n k"], Float64[np.ndarray, "n k"]] | None
    own: Mapping[str, Float32[np.ndarray, "n _"]]


class _Reader:
    """Reader of the primitives of one document."""

    def __init__(self, document: GltfDocument) -> None:
        self.notes = Notes()
        self.left_out = ""
        self._document = document
        self._accessors = Accessors(document)
        self._materials = Materials(document, Textures(document), self.notes)
        self._scene = Scene(document, self._accessors)
        self._parts: dict[tuple[int, tuple[float, ...]], list[_Part]] = {}
        self._n_vertices = self._n_faces = 0

    def primitives(self) -> list[Primitive]:
        """Return all triangles of the default scene."""
        primitives: list[Primitive] = []
        for placement in self._scene.placements():
            key = (placement.mesh, placement.weights)
            # Read once for all nodes with the same mesh and morph weights.
            if key not in self._parts:
                self._parts[key] = list(self._mesh_parts(*key))
            for part in self._parts[key]:
                self._count(part, len(placement.scene_from_mesh))
                primitives.append(_placed(part, placement))
            if len(primitives) > MAX_PRIMITIVES:
                raise ValueError(f"it has more than {MAX_PRIMITIVES} primitives")
        self._note_scene()
        note_unknown(self._document.json.get("extensionsUsed", ()), self.notes)
        return primitives

    def _count(self, part: _Part, n_instances: int) -> None:
        self._n_vertices += n_instances * len(part.vertices)
        self._n_faces += n_instances * len(part.faces)
        if self._n_vertices > MAX_VERTICES or self._n_faces > _MAX_FACES:
            raise ValueError(f"its instances have more than {MAX_VERTICES} vertices or faces")

    def _mesh_parts(self, mesh: int, weights: tuple[float, ...]) -> list[_Part]:
        values = self._document.item("meshes", mesh).get("primitives", [])
        if not values:
            self._leave_out_empty(f"meshes[{mesh}]")
        if len(values) > MAX_PRIMITIVES:
            raise ValueError(f"a mesh has more than {MAX_PRIMITIVES} primitives")
        parts = [self._part(value, weights) for value in values]
        return [part for part in parts if part is not None]

    def _part(self, value: dict[str, Any], weights: tuple[float, ...]) -> _Part | None:
        """Read one primitive; None if it has no triangles."""
        mode = value.get("mode", GltfCode.TRIANGLES)
        if mode not in range(7):
            raise ValueError(f"a primitive of mode {str(mode)[:20]}, not 0 to 6")
        if mode < GltfCode.TRIANGLES:
            self.left_out = "points or lines alone"
            self.notes.add("points and lines are left out")
            return None
        attributes = value.get("attributes", {})
        named = [attributes.get("POSITION"), *([value["indices"]] if "indices" in value else [])]
        if named[0] is None or any(self._accessors.is_empty(index) for index in named):
            self._leave_out_empty("no position or corner")
            return None
        self._require_data(value, named)
        vertices = self._accessors.floats(attributes["POSITION"], 3)
        faces = _faces(self._corners(value, len(vertices)), mode)
        if not len(faces):
            return None
        vertices = vertices + self._morphed(value, weights, len(vertices))
        geometry = Geometry(vertices, faces, lambda n: self._uv(attributes, n, len(vertices)))
        own = {
            name: self._accessors.rows(index).astype(np.float32)
            for name, index in attributes.items()
            if name.startswith("_")
        }
        if any(len(values) != len(vertices) for values in own.values()):
            raise ValueError(
                "an attribute has another number of rows than the primitive has vertices"
            )
        return _Part(
            vertices,
            faces,
            self._materials.surface(value.get("material"), geometry),
            self._vertex_colour(attributes, len(vertices)),
            self._joints(attributes, len(vertices)),
            own,
        )

    def _leave_out_empty(self, what: str) -> None:
        self.left_out = "empty meshes or primitives alone"
        self.notes.add("empty meshes and primitives are left out", what)

    def _require_data(self, value: dict[str, Any], named: list[Any]) -> None:
        """Raise an error if positions or indices exist only in compressed form.

        Args:
            named: accessors of positions and indices.
        """
        if all(self._accessors.has_data(index) for index in named):
            return
        if DRACO in extensions(value):
            raise unsupported(self._document.path, DRACO)
        raise ValueError("a primitive has positions or indices without data")

    def _corners(self, value: dict[str, Any], n_vertices: int) -> Int64[np.ndarray, " n"]:
        if "indices" not in value:
            return np.arange(n_vertices)
        corners = self._accessors.indices(value["indices"])
        if corners.min() < 0 or corners.max() >= n_vertices:
            raise ValueError(f"a triangle names vertex {corners.max()}, of {n_vertices}")
        return corners

    def _morphed(
        self, value: dict[str, Any], weights: tuple[float, ...], n_vertices: int
    ) -> Float64[np.ndarray, "n 3"]:
        """Return the displacements by morph targets with their default weights."""
        moved = np.zeros((n_vertices, 3))
        for target, weight in zip(value.get("targets", ()), weights, strict=False):
            if weight != 0 and "POSITION" in target:
                moved += weight * self._rows(target["POSITION"], n_vertices, 3)
            if weight != 0 and any(name.startswith(("TEXCOORD", "COLOR")) for name in target):
                self.notes.add("morph targets of colours and texture coordinates are not read")
        return moved

    def _rows(
        self, index: object, count: int, *widths: int, is_fraction: bool = False
    ) -> Float64[np.ndarray, "n c"]:
        """Return the rows of an attribute, one per vertex."""
        rows = self._accessors.floats(index, *widths, is_fraction=is_fraction)
        if len(rows) != count:
            raise ValueError(f"accessors[{index}] has {len(rows)} rows for {count} vertices")
        return rows

    def _uv(
        self, attributes: dict[str, Any], number: int, count: int
    ) -> Float64[np.ndarray, "n 2"] | None:
        name = f"TEXCOORD_{number}"
        if name not in attributes:
            return None
        uv = self._rows(attributes[name], count, 2)
        if (np.abs(uv) > LARGEST_UV).any():
            raise ValueError(f"a texture coordinate is {np.abs(uv).max():.3g}")
        return uv

    def _vertex_colour(
        self, attributes: dict[str, Any], count: int
    ) -> Float64[np.ndarray, "n 4"] | None:
        if "COLOR_0" not in attributes:
            return None
        rows = self._rows(attributes["COLOR_0"], count, 3, 4, is_fraction=True)
        rgba = np.concatenate([rows, np.ones((count, 4 - rows.shape[1]))], axis=1)
        return np.clip(rgba, 0.0, 1.0)

    def _joints(
        self, attributes: dict[str, Any], count: int
    ) -> tuple[Float64[np.ndarray, "n k"], Float64[np.ndarray, "n k"]] | None:
        """Return joint numbers and weights of each vertex, all sets side by side."""
        # Each set has four joints per vertex (section 3.7.3.3).
        numbers, weights = [], []
        while f"JOINTS_{len(numbers)}" in attributes:
            suffix = len(numbers)
            numbers.append(self._rows(attributes[f"JOINTS_{suffix}"], count, 4))
            weights.append(self._rows(attributes[f"WEIGHTS_{suffix}"], count, 4, is_fraction=True))
        return (np.hstack(numbers), np.hstack(weights)) if numbers else None

    def _note_scene(self) -> None:
        document = self._document
        nodes = [document.item("nodes", index) for index in self._scene.visited]
        if len(document.items("scenes")) > 1:
            self.notes.add(f"of {len(document.items('scenes'))} scenes the default one is read")
        if any("KHR_lights_punctual" in extensions(node) for node in nodes):
            self.notes.add("lights are not read")
        channels = [c for a in document.items("animations") for c in a.get("channels", ())]
        if any(c.get("target", {}).get("node") in self._scene.moving for c in channels):
            self.notes.add("animations are not read: the model has its rest pose")
        variants = extensions(document.json).get("KHR_materials_variants", {}).get("variants", [])
        if len(variants) > 1:
            names = ", ".join(str(v.get("name"))[:40] for v in variants[:4])
            self.notes.add(f"of {len(variants)} variants ({names} ...) the default look is read")


def _faces(corners: Int64[np.ndarray, " n"], mode: int) -> Int32[np.ndarray, "m 3"]:
    """Return the triangles of a list, strip or fan.

    Triangles of strips and fans with two equal corners, which only join pieces, are removed.
    """
    if mode == GltfCode.TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3).astype(np.int32)
    i = np.arange(max(len(corners) - 2, 0))
    if mode == GltfCode.TRIANGLE_STRIP:
        # Every second triangle is turned over, so that all have the strip's orientation.
        faces = np.stack([corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]], axis=1)
    else:
        faces = np.stack([corners[i + 1], corners[i + 2], np.broadcast_to(corners[:1], i.shape)], 1)
    is_whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return faces[is_whole].astype(np.int32)


def _placed(part: _Part, placement: Placement) -> Primitive:
    """Place a part in the scene; all its instances become one primitive."""
    n = len(part.vertices)
    if placement.joints is not None and part.joints is not None:
        # Joints place vertices in the scene; the transform of the mesh's node is ignored (section
        # 3.7.3).
        vertices, is_mirrored = skinned(part.vertices, placement.joints, *part.joints)
        mirrored = np.array([is_mirrored])
    else:
        matrices = placement.scene_from_mesh
        moved = part.vertices @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3]
        vertices = moved.reshape(-1, 3)
        mirrored = np.linalg.det(matrices[:, :3, :3]) < 0
    if not (np.abs(vertices) < FARTHEST).all():
        raise ValueError(f"a vertex is not finite, or {FARTHEST:.0e} or more from the origin")
    k = len(mirrored)
    # A mirroring transform turns triangles over: reverse them (section 3.7.4).
    faces = np.where(mirrored[:, None, None], part.faces[:, ::-1], part.faces)
    faces = faces + (np.arange(k) * n)[:, None, None]
    surface = part.surface
    factor = np.broadcast_to(surface.factor, (n, 4))
    if part.vertex_colour is not None:
        factor = part.vertex_colour * factor
    factor = np.tile(factor, (k, 1))
    return Primitive(
        vertices,
        faces.reshape(-1, 3).astype(np.int32),
        factor[:, :3].astype(np.float32),
        None if surface.uv is None else np.tile(surface.uv, (k, 1)),
        surface.texture,
        surface.material,
        {name: np.tile(values, (k, 1)) for name, values in part.own.items()},
        surface.alpha_mode,
        factor[:, 3].astype(np.float32),
        surface.alpha_cutoff,
        surface.transmission,
    )
