"""Files of scene assets between the stages: meshes in .npz, camera gains in JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import Material, Provenance, Texture, TriMesh
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.arrays import ArrayFile, save_arrays
from lightsim.store.artefact import json_ready, write_json
from lightsim.store.entries import Entries
from lightsim.store.exr_file import HALF_MAX
from lightsim.store.names import file_names, inside


def write_mesh(path: Path, mesh: TriMesh) -> None:
    """Write one mesh as .npz; texture and `towards_camera` are rounded to half floats."""
    materials = mesh.materials
    arrays = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "base_colour": mesh.base_colour,
        "material": np.array([[m.roughness, m.metallic] for m in materials]),
        "material_name": np.array([m.name for m in materials]),
    }
    optional = {
        "face_material": mesh.face_material,
        "face_provenance": mesh.face_provenance,
        "confidence": mesh.confidence,
    }
    arrays |= {name: values for name, values in optional.items() if values is not None}
    if mesh.towards_camera is not None:
        arrays["towards_camera"] = mesh.towards_camera.astype(np.float16)
    if mesh.texture is not None:
        arrays["texture"] = np.minimum(mesh.texture.image, HALF_MAX).astype(np.float16)
        arrays["corner_uv"] = mesh.texture.corner_uv
    save_arrays(path, arrays)


def read_mesh(path: Path, frame: str) -> TriMesh:
    """Return a mesh that `write_mesh` wrote.

    Raises:
        InputError: the file is damaged, or a face refers to a missing vertex.
        ArtefactError: an array is missing, of another shape or type, or refers to a missing
            material or provenance.
    """
    arrays = ArrayFile(path)
    vertices, faces = arrays.take("vertices", "f4", "n 3"), arrays.take("faces", "i4", "m 3")
    texture = None
    if "texture" in arrays:
        image = arrays.take("texture", "f2", "h w 3").astype(np.float32)
        if not image.size:
            raise ArtefactError("the texture is empty", where=path, remedy="Build again.")
        texture = Texture(image, arrays.take("corner_uv", "f4", "m 3 2"))
    materials = _materials(arrays)
    face_material = arrays.find("face_material", "u1", "m")
    provenance = arrays.find("face_provenance", "u1", "m")
    for of_face, count, what in (
        (face_material, len(materials), "material"),
        (provenance, len(Provenance), "provenance"),
    ):
        if of_face is not None and len(faces) and int(of_face.max()) >= count:
            raise ArtefactError(
                f"a face refers to a missing {what}", where=path, remedy="Build again."
            )
    towards = arrays.find("towards_camera", "f2", "n 3")
    return TriMesh(
        frame,
        vertices,
        faces,
        arrays.take("base_colour", "f4", "n 3"),
        materials,
        face_material,
        texture,
        arrays.find("confidence", "f4", "n"),
        provenance,
        None if towards is None else towards.astype(np.float32),
    )


def _materials(arrays: ArrayFile) -> tuple[Material, ...]:
    numbers = arrays.take("material", "f8", "k 2").tolist()
    # Files of older versions have one material without a name.
    names = ["matte"] * len(numbers)
    if "material_name" in arrays:
        names = arrays.take("material_name", "U", "k").tolist()
    if not numbers:
        raise ArtefactError("the mesh has no material", where=arrays.path, remedy="Build again.")
    return tuple(
        Material(float(roughness), float(metallic), str(name))
        for (roughness, metallic), name in zip(numbers, names, strict=True)
    )


def write_assets(folder: Path, assets: SceneAssets) -> None:
    """Write background.npz, assets.json, and one file per actor, whose name is in assets.json."""
    write_mesh(folder / "background.npz", assets.background)
    (folder / "actors").mkdir(exist_ok=True)
    files = {a: f"actors/{name}.npz" for a, name in file_names(assets.actors).items()}
    for actor_id, actor in assets.actors.items():
        write_mesh(inside(folder, files[actor_id]), actor.mesh)
    write_json(
        folder / "assets.json",
        {
            "camera_gains": json_ready(dict(assets.camera_gains)),
            "notes": list(assets.notes),
            "actors": [
                {
                    "actor_id": actor_id,
                    "kind": actor.kind,
                    "label": actor.label,
                    "mesh": files[actor_id],
                    "faces": len(actor.mesh.faces),
                }
                for actor_id, actor in assets.actors.items()
            ],
        },
    )


def read_assets(folder: Path) -> SceneAssets:
    """Return the assets that `write_assets` wrote.

    Raises:
        InputError, ArtefactError: a file is missing or damaged.
    """
    value = Entries.of_file(folder / "assets.json")
    actors: dict[str, ActorAsset] = {}
    for entry in value.objects("actors"):
        actor_id = entry.text("actor_id")
        mesh = read_mesh(inside(folder, entry.text("mesh")), "actor")
        kind = entry.member("kind", ActorKind)
        actors[actor_id] = ActorAsset(actor_id, kind, mesh, entry.text("label"))
    notes = value.texts("notes") if "notes" in value else ()
    return SceneAssets(
        read_mesh(folder / "background.npz", "world"), actors, read_gains(value), notes
    )


def read_gains(value: Entries) -> dict[str, Float32[np.ndarray, "3"]]:
    """Return the RGB gain of each camera.

    Raises:
        ArtefactError: a gain is not three positive numbers.
    """
    gains = value.object("camera_gains")
    found = {name: gains.numbers(name, (3,)).astype(np.float32) for name in gains}
    for name, gain in found.items():
        if not (gain > 0).all():
            raise ArtefactError(
                "the gain of a camera is not positive",
                where=name,
                got=gain.tolist(),
                remedy="Build again.",
            )
    return found
