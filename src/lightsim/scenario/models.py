"""CAD files as actors: metres, z up, the front along x, the origin in the middle of the box."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32

from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.scenario.kinds import is_plausible, named_kinds
from lightsim.scenario.orientation import (
    DEFAULT_UP,
    Front,
    Up,
    find_front,
    find_up,
    is_horizontal,
    turned,
)
from lightsim.store.foreign import foreign_content
from lightsim.store.gltf import read_gltf
from lightsim.store.gltf_document import GLB_MAGIC
from lightsim.store.obj import read_obj
from lightsim.store.obj_text import as_utf8
from lightsim.store.primitive_mesh import mesh_of
from lightsim.store.primitives import Y_UP_FROM_Z_UP, ModelFile
from lightsim.store.reading import open_regular

_LOGGER = logging.getLogger(__name__)
MODEL_SUFFIXES = (".glb", ".gltf", ".obj")
_READERS: dict[str, Callable[[Path], ModelFile]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
}
_BLENDER = "Convert it: Blender reads it by File > {}, and writes .glb by File > Export > glTF 2.0."
_EXPORT = "Export it as .glb from the program that wrote it."
_REMEDY_BY_SUFFIX = {
    **dict.fromkeys((".fbx", ".dae", ".stl", ".ply", ".abc", ".usd", ".usda", ".usdc", ".usdz",
                     ".wrl", ".x3d", ".svg"), _BLENDER.format("Import")),
    ".blend": _BLENDER.format("Open"),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"),
                    "Convert it: FreeCAD opens it, and writes .glb or .obj by File > Export."),
    **dict.fromkeys((".3ds", ".3mf", ".max", ".c4d", ".ma", ".mb", ".skp", ".3dm"),
                    "Export it from the program that wrote it as .glb, .obj or .fbx."),
    ".zip": "Unpack it, and give the model in it.",
}  # fmt: skip
# First bytes of other model formats, and the suffix whose remedy applies.
_MAGIC = (
    (b"Kaydara FBX", ".fbx"), (b"; FBX", ".fbx"), (b"ply", ".ply"), (b"solid", ".stl"),
    (b"#usda", ".usda"), (b"PXR-USDC", ".usdc"), (b"BLENDER", ".blend"), (b"ISO-10303", ".step"),
    (b"#VRML", ".wrl"), (b"OFF", ".off"),
)  # fmt: skip
# COLLADA and X3D, which are XML.
_XML = re.compile(rb"<.{0,999}?<?(COLLADA|X3D)\b", re.DOTALL)
# Largest file for any reader, in bytes; each reader has a lower limit of its own.
_MAX_BYTES = 2 << 30
# Bytes in which the first vertex of an OBJ file is searched for: more than exporters' comments.
_HEAD_BYTES = 1 << 16
_OBJ_VERTEX = re.compile(rb"^[ \t]*[vV][ \t]+[-+.\d]", re.MULTILINE)
# Longest side of the largest object in a street, in metres: a tram.
_LONGEST_M = 60.0
# Longest side of the smallest object in a street, in metres: a bottle.
_SHORTEST_M = 0.05
# Metres per unit of common programs; the last ones occur if an exporter applies a factor twice.
_UNITS = {
    0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 0.1: "decimetres", 0.3048: "feet",
    10.0: "decametres", 100.0: "metres, divided by 100 on export",
    1000.0: "metres, divided by 1000 on export",
}  # fmt: skip
# Longest side of most objects in a street, in metres; used to propose a unit.
_TYPICAL_M = (0.2, 20.0)
# Largest thickness of a card, as a fraction of its longest side. Panels of signs have at least
# 0.003.
_CARD = 1e-3


@dataclass(frozen=True, kw_only=True)
class ModelSettings:
    """Choices of a user about a model file.

    Args:
        up: axis of the file that points up.
        front: axis of the file that points ahead.
        metres_per_unit: size of the file's unit, in metres.
        length_m: length along the front to which the model is scaled, in metres; replaces the unit.
    """

    up: Up = "auto"
    front: Front = "auto"
    metres_per_unit: float = 1.0
    length_m: float | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """A model file as an actor.

    Args:
        mesh: mesh in frame `actor`.
        up, front: axes of the file that point up and ahead.
        notes: parts of the file that were not read, and decisions, one sentence each.
    """

    mesh: TriMesh
    up: Up
    front: Front
    notes: tuple[str, ...]


def read_model(path: Path, front: Front = "auto", metres_per_unit: float = 1.0) -> TriMesh:
    """Return the mesh of a model file in frame `actor`; see `load_model`."""
    return load_model(path, ModelSettings(front=front, metres_per_unit=metres_per_unit)).mesh


def load_model(path: Path, settings: ModelSettings | None = None) -> Model:
    """Read a .glb, .gltf or .obj file as an actor, and log its notes as one warning.

    Raises:
        InputError: the file cannot be read, has no height, or its size is not
            plausible for an actor; or a setting does not fit it.
    """
    settings = settings or ModelSettings()
    reader, named = _reader(path), _READERS.get(path.suffix.lower())
    model = _placed(_near_origin(reader(path)), settings, is_stated=reader is read_gltf)
    if reader is not named:
        note = f"its content is {'glTF' if reader is read_gltf else 'OBJ'}, so it is read as such"
        model = replace(model, notes=(note, *model.notes))
    if model.notes:
        _LOGGER.warning("%s: %s.", path, "; ".join(model.notes))
    return model


def centred(mesh: TriMesh) -> TriMesh:
    """Return the mesh with the origin at the centre of its box."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return replace(mesh, vertices=mesh.vertices - middle)


def _reader(path: Path) -> Callable[[Path], ModelFile]:
    """Return the reader of a file, chosen by its content.

    Raises:
        InputError: the suffix or the content is another format's.
    """
    suffix = path.suffix.lower()
    named = _READERS.get(suffix)
    if suffix in _REMEDY_BY_SUFFIX:
        raise _unknown_format(path, _REMEDY_BY_SUFFIX[suffix])
    with open_regular(path, "model", _MAX_BYTES) as handle:
        head = handle.read(_HEAD_BYTES)
    foreign = _other_model(head) or foreign_content(head)
    if foreign is not None:
        raise InputError(
            "the file is not a model", where=path, got=foreign[0],
            expected=f"the content of a {suffix if named else ' or '.join(MODEL_SUFFIXES)} file",
            remedy=foreign[1],
        )  # fmt: skip
    text = as_utf8(head)
    is_glb = text.startswith(GLB_MAGIC)
    reader = read_obj if _OBJ_VERTEX.search(text) else named
    if is_glb or text.lstrip().startswith(b"{"):
        reader = read_gltf
    if named is None or reader is None:
        right = ".glb" if is_glb else ".gltf" if reader is read_gltf else ".obj"
        raise _unknown_format(path, f"Rename it to {path.stem}{right}." if reader else _EXPORT)
    return reader


def _other_model(head: bytes) -> tuple[str, str] | None:
    """Return the name of another model format and the remedy; None if the bytes match none."""
    suffix = next((suffix for magic, suffix in _MAGIC if head.startswith(magic)), None)
    if suffix is None and (xml := _XML.match(as_utf8(head).lstrip())) is not None:
        suffix = ".dae" if xml[1] == b"COLLADA" else ".x3d"
    return (f"a {suffix} file", _REMEDY_BY_SUFFIX.get(suffix, _EXPORT)) if suffix else None


def _near_origin(file: ModelFile) -> ModelFile:
    """Return the file with the middle of its box at the origin.

    Meshes are float32, which resolves half a metre at UTM coordinates; files may be float64.
    """
    corners = [(p.vertices.min(axis=0), p.vertices.max(axis=0)) for p in file.primitives]
    low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    middle = (low + high) / 2
    moved = tuple(replace(p, vertices=p.vertices - middle) for p in file.primitives)
    return replace(file, primitives=moved)


def _unknown_format(path: Path, remedy: str) -> InputError:
    return InputError(
        "the model's format is not supported",
        where=path,
        got=repr(path.suffix.lower() or "no suffix")[:40],
        expected=" or ".join(MODEL_SUFFIXES),
        remedy=remedy,
    )


def _placed(file: ModelFile, settings: ModelSettings, *, is_stated: bool) -> Model:
    """Turn, scale and join the parts of a file."""
    path = file.path
    vertices, faces = _triangles(file)
    up, evidence = _up(path, vertices, faces, settings, is_stated=is_stated)
    front, cabin = settings.front, ""
    if front == "auto":
        front, cabin = find_front(vertices, up, path.stem)
    if not is_horizontal(front, up):
        raise InputError(
            "the front points up or down",
            where=path,
            got=f"--front {front} with --up {settings.up}, {up} being up",
            expected="a front along another axis than up",
            remedy="Choose another --front or --up.",
        )
    extent = np.ptp(turned(vertices, up, front), axis=0)
    scale = _scale(path, extent, settings)
    _check_size(path, extent, scale)
    notes = _card_notes(path, extent, up)
    if evidence:
        notes.append(f"{up} is up, because {evidence} (lightsim assets add --up changes it)")
    if cabin:
        notes.append(f"{front} is ahead, because {cabin} (lightsim assets add --front changes it)")
    notes += _unit_notes(path, extent * scale, settings)
    placed = tuple(
        replace(p, vertices=turned(p.vertices, up, front) * scale @ Y_UP_FROM_Z_UP[:3, :3].T)
        for p in file.primitives
    )
    mesh, reader_notes = mesh_of(replace(file, primitives=placed), "actor")
    if settings.length_m is not None:
        # Fully transparent parts have been removed.
        rest = np.float32(settings.length_m / np.ptp(mesh.vertices[:, 0]))
        mesh = replace(mesh, vertices=mesh.vertices * rest)
    return Model(centred(mesh), up, front, (*reader_notes, *notes))


def _triangles(file: ModelFile) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"]]:
    """Return all vertices that faces use, and the faces.

    Raises:
        InputError: the vertices are one point, or not finite.
    """
    starts = np.cumsum([0] + [len(p.vertices) for p in file.primitives[:-1]])
    faces = np.concatenate(
        [p.faces + np.int32(n) for p, n in zip(file.primitives, starts, strict=True)]
    )
    vertices = np.concatenate([p.vertices for p in file.primitives])
    used, numbers = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], numbers.reshape(-1, 3).astype(np.int32)
    with np.errstate(over="ignore", invalid="ignore"):
        longest = np.ptp(vertices, axis=0).max()
    if not (np.isfinite(longest) and longest > 0):
        raise InputError(
            "the model has no extent",
            where=file.path,
            got=f"a longest side of {longest:g}",
            expected="triangles of finite, positive size",
            remedy="Export it again.",
        )
    return vertices, faces


def _up(
    path: Path,
    vertices: Float64[np.ndarray, "n 3"],
    faces: Int32[np.ndarray, "m 3"],
    settings: ModelSettings,
    *,
    is_stated: bool,
) -> tuple[Up, str]:
    if settings.up != "auto":
        return settings.up, ""
    if settings.front[1:] == DEFAULT_UP:
        return "z", "the front is along y"
    scale = settings.metres_per_unit if settings.length_m is None else None
    ahead = settings.front[1:] if settings.front != "auto" else ""
    return find_up(vertices, faces, path.stem, scale, ahead, is_stated=is_stated)


def _scale(path: Path, extent: Float64[np.ndarray, "3"], settings: ModelSettings) -> float:
    for option, value in (
        ("--metres-per-unit", settings.metres_per_unit), ("--length-m", settings.length_m),
    ):  # fmt: skip
        if value is not None and not 0 < value < np.inf:
            raise InputError(
                f"{option} is not a size", where=path, got=value, expected="a number above 0"
            )
    if settings.length_m is None:
        return settings.metres_per_unit
    if extent[0] < _CARD * extent.max():
        raise InputError(
            "the model has no length along its front",
            where=path,
            got=f"{_words(extent)} units (length x width x height), --length-m {settings.length_m}",
            expected="a length that can be scaled",
            remedy="Give --metres-per-unit instead of --length-m, or another --front.",
        )
    return settings.length_m / extent[0]


def _check_size(path: Path, extent: Float64[np.ndarray, "3"], scale: float) -> None:
    if _SHORTEST_M <= extent.max() * scale <= _LONGEST_M:
        return
    proposals = _proposals(extent)
    with_units = "; ".join(proposals) or "no common unit gives a plausible size"
    with_length = f"with --length-m 4.4, {_words(extent * 4.4 / extent[0])} m"
    raise InputError(
        "the model's size is not plausible for an actor",
        where=path,
        got=f"{_words(extent * scale)} m (length x width x height)",
        expected=f"a longest side from {_SHORTEST_M} to {_LONGEST_M:g} m",
        remedy=f"Give its unit or its length to lightsim assets add: {with_units}; {with_length}.",
    )


def _proposals(extent: Float64[np.ndarray, "3"]) -> list[str]:
    """Return options that give a common size, with that size."""
    return [
        f"with --metres-per-unit {unit:g} ({name}) it would be {_words(extent * unit)} m"
        for unit, name in _UNITS.items()
        if _TYPICAL_M[0] <= extent.max() * unit <= _TYPICAL_M[1]
    ]


def _unit_notes(path: Path, size: Float64[np.ndarray, "3"], settings: ModelSettings) -> list[str]:
    """Note a size that the name excludes, with the common units that make it plausible."""
    kinds = named_kinds(path.stem)
    if not kinds or any(is_plausible(k, size) for k in kinds):
        return []
    proposals = [
        f"{settings.metres_per_unit * unit:g} ({_words(size * unit)} m)"
        for unit in _UNITS
        if settings.length_m is None and is_plausible(kinds[0], size * unit)
    ]
    remedy = "check --length-m, --metres-per-unit, --up and --front"
    if proposals:
        remedy = f"--metres-per-unit may be {' or '.join(proposals)}"
    return [f"{_words(size)} m is not the size of a {kinds[0]}: {remedy}"]


def _card_notes(path: Path, extent: Float64[np.ndarray, "3"], up: Up) -> list[str]:
    """Note an upright card; a level one has no height, and is an error."""
    if extent.min() >= _CARD * extent.max():
        return []
    if extent[2] >= _CARD * extent.max():
        return ["it is a card without thickness, which has no shadow for a sun in its plane"]
    others = [axis for axis in "xyz" if axis != up[-1]]
    raise InputError(
        "the model has no height",
        where=path,
        got=f"{_words(extent)} units (length x width x height), {up} being up",
        expected="a height above 0: marks on the road are no actors",
        remedy=f"If it is upright, give lightsim assets add --up {others[0]} or --up {others[1]};"
        " else give it a thickness.",
    )


def _words(size: Float64[np.ndarray, "3"]) -> str:
    return " x ".join(f"{side:.2f}" if 0.1 <= side < 1e4 else f"{side:.3g}" for side in size)
