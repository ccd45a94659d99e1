"""Sources of inserted actors: files, the library folder, other work folders, shipped models.

An asset is named by a file (`models/van.glb`), by a name in the library (`hatchback`, `cone`), or
by an actor of another twin (`OTHER_WORK#actor_id`).
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import ActorAsset
from lightsim.errors import InputError, LightSimError
from lightsim.scenario.kinds import inferred_kind
from lightsim.scenario.models import (
    MODEL_SUFFIXES,
    Model,
    ModelSettings,
    centred,
    load_model,
)
from lightsim.scenario.wheels import with_wheels
from lightsim.store.artefact import hash_file, hash_names, read_record, write_json
from lightsim.store.entries import Entries
from lightsim.store.meshes import read_glb, write_glb
from lightsim.store.names import is_harmless
from lightsim.store.reading import is_file
from lightsim.store.twin import read_twin_assets

_INFO = ".json"
_REMEDY = "lightsim assets list shows all assets; lightsim assets add adds a file."


def default_folder() -> Path:
    """Return the folder of the user's library, $XDG_DATA_HOME/lightsim/assets."""
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "lightsim" / "assets"


@dataclass(frozen=True)
class AssetInfo:
    """One line of `lightsim assets list`.

    Args:
        name: name for scenarios.
        kind: kind of actor.
        size_lwh_m: length, width and height of the box.
        faces: number of triangles.
        origin: source of the asset, in words.
        score: observed fraction of a harvested actor, 0 to 1; None for other assets.
    """

    name: str
    kind: ActorKind
    size_lwh_m: tuple[float, float, float]
    faces: int
    origin: str
    score: float | None = None


@dataclass(frozen=True, eq=False)
class AssetLibrary:
    """Folder of assets (NAME.glb and NAME.json), with the models that ship with LightSim.

    Args:
        folder: folder of the library; need not exist.
        built_in: shipped models by name.
        beside: folder that is searched first for relative file names: that of SCENARIO.json.
    """

    folder: Path
    built_in: Mapping[str, ActorAsset]
    beside: Path = Path()
    _loaded: dict[str, ActorAsset] = field(default_factory=dict, init=False, repr=False)

    def load(self, words: str) -> ActorAsset:
        """Return the asset of a name; its file is read once for all of its instances.

        Raises:
            InputError: the name is unknown, or the file is damaged.
        """
        if words not in self._loaded:
            self._loaded[words] = self._read(words)
        return self._loaded[words]

    def _read(self, words: str) -> ActorAsset:
        path = self._file(words)
        if path is not None:
            mesh = load_model(path).mesh
            return with_wheels(ActorAsset(path.stem, inferred_kind(path.stem, _size(mesh)), mesh))
        if is_harmless(words) and is_file(self.folder / f"{words}.glb"):
            return self._stored(words)
        if words in self.built_in:
            return self.built_in[words]
        if words.lower().endswith(MODEL_SUFFIXES):
            raise InputError(
                "there is no such file", got=repr(words)[:200],
                expected=f"a model, looked for in {self.beside.resolve()} and {Path.cwd()}",
                remedy="Check the path, and the case of its letters.",
            )  # fmt: skip
        # After files, whose names may contain a #.
        if "#" in words:
            return self._of_work(*words.rsplit("#", 1))
        names = ", ".join(self.names())
        raise InputError(
            "there is no such asset", got=repr(words)[:80],
            expected=f"a .glb, .gltf or .obj file, WORK#actor_id, or one of {names}",
            remedy=_REMEDY,
        )  # fmt: skip

    def key(self, words: str) -> str:
        """Return a hash of the asset's content, which does not depend on the name of its file."""
        path = self._file(words)
        if path is not None:
            # The mesh is hashed, not the file: textures and materials may be in other files.
            return _mesh_key(self.load(words).mesh)
        if "#" in words:
            work, actor_id = words.rsplit("#", 1)
            record = read_record(Path(work) / "twin")
            return hash_names({"twin": None if record is None else record["key"], "id": actor_id})
        path = self.folder / f"{words}.glb"
        return hash_file(path) if is_file(path) else words

    def names(self) -> tuple[str, ...]:
        """Return the names of all assets, in the order of `infos`, without reading their files."""
        stored = sorted(path.stem for path in self.folder.glob(f"*{_INFO}"))
        return tuple(dict.fromkeys((*stored, *self.built_in)))

    def infos(self) -> Iterator[AssetInfo]:
        """Yield all assets with a name: stored ones, then shipped ones."""
        for path in sorted(self.folder.glob(f"*{_INFO}")):
            yield _read_info(path)
        for name, asset in self.built_in.items():
            yield _info(name, asset, "ships with LightSim")

    def add(
        self,
        name: str,
        asset: ActorAsset,
        origin: str,
        score: float | None = None,
        *,
        is_replacing: bool = False,
    ) -> AssetInfo:
        """Store an asset.

        Raises:
            InputError: the name is no valid file name, or is in use.
        """
        if not is_harmless(name):
            raise InputError(
                "the name is not a valid file name",
                where=name[:80],
                expected="letters, digits and . _ -, a letter or digit first",
            )
        if is_file(self.folder / f"{name}.glb") and not is_replacing:
            raise InputError(
                "an asset of this name exists", where=self.folder, got=name,
                remedy="Choose another --name, or give --overwrite.",
            )  # fmt: skip
        self.folder.mkdir(parents=True, exist_ok=True)
        info = _info(name, asset, origin, score)
        self._loaded.pop(name, None)
        write_glb(self.folder / f"{name}.glb", asset.mesh)
        write_json(self.folder / f"{name}{_INFO}", {**vars(info), "label": asset.label})
        return info

    def _stored(self, name: str) -> ActorAsset:
        info = Entries.of_file(self.folder / f"{name}{_INFO}")
        mesh = read_glb(self.folder / f"{name}.glb", "actor")
        asset = ActorAsset(name, info.member("kind", ActorKind), mesh, info.text("label"))
        # Only harvested actors have a score; their meshes have no separate wheels.
        return with_wheels(asset) if info.is_null("score") else asset

    def _file(self, words: str) -> Path | None:
        # Scenarios from Windows have backslashes in paths.
        paths = dict.fromkeys((words, words.replace("\\", "/"))) if Path(words).suffix else ()
        places = [folder / path for path in paths for folder in (self.beside, Path())]
        return next((place for place in places if is_file(place)), None)

    def _of_work(self, work: str, actor_id: str) -> ActorAsset:
        try:
            assets, _ = read_twin_assets(Path(work) / "twin")
        except LightSimError as error:
            raise InputError(
                f"the other twin cannot be read: {error.what}",
                where=work,
                remedy="Give the work folder of a finished build before the #.",
            ) from error
        if actor_id not in assets.actors:
            raise InputError(
                "there is no such actor in the other twin",
                where=work,
                got=repr(actor_id)[:80],
                expected=f"one of {', '.join(list(assets.actors)[:12])} ...",
                remedy=f"lightsim actors {work} lists them.",
            )
        asset = assets.actors[actor_id]
        return replace(asset, mesh=centred(asset.mesh))


def add_model(
    library: AssetLibrary,
    path: Path,
    name: str = "",
    settings: ModelSettings | None = None,
    *,
    kind: ActorKind | None = None,
    is_replacing: bool = False,
) -> tuple[AssetInfo, Model]:
    """Read a CAD file into the library.

    Args:
        name: name for scenarios; empty: the file name without its suffix.
        settings: axes and size of the file.
        kind: kind of actor; None: inferred from file name and size.

    Returns:
        The new line of the library, and the model with the axes that were chosen.

    Raises:
        InputError: the file cannot be read, or the name exists or is not valid.
    """
    if not name and not is_harmless(path.stem):
        fit = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).strip("-._")
        raise InputError(
            "the file's name is not a valid asset name",
            where=path,
            got=path.stem[:80],
            expected="letters, digits and . _ -, a letter or digit first",
            remedy=f"Give --name {fit if is_harmless(fit) else 'model'}.",
        )
    name = name or path.stem
    model = load_model(path, settings)
    asset = ActorAsset(name, kind or inferred_kind(path.stem, _size(model.mesh)), model.mesh)
    return library.add(name, asset, path.name, is_replacing=is_replacing), model


def _info(name: str, asset: ActorAsset, origin: str, score: float | None = None) -> AssetInfo:
    length, width, height = (float(x) for x in _size(asset.mesh))
    return AssetInfo(
        name, asset.kind, (length, width, height), len(asset.mesh.faces), origin, score
    )


def _size(mesh: TriMesh) -> Float64[np.ndarray, "3"]:
    return np.ptp(mesh.vertices.astype(np.float64), axis=0)


def _mesh_key(mesh: TriMesh) -> str:
    arrays = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "base_colour": mesh.base_colour,
        "face_material": mesh.face_material,
    }
    texture = mesh.texture
    if texture is not None:
        arrays |= {"texture": texture.image, "corner_uv": texture.corner_uv}
    hashes = {
        name: hashlib.blake2b(np.ascontiguousarray(array).data, digest_size=16).hexdigest()
        for name, array in arrays.items()
        if array is not None
    }
    return hash_names({**hashes, "materials": [vars(m) for m in mesh.materials]})


def _read_info(path: Path) -> AssetInfo:
    entries = Entries.of_file(path)
    length, width, height = entries.numbers("size_lwh_m", (3,)).tolist()
    return AssetInfo(
        entries.text("name"),
        entries.member("kind", ActorKind),
        (length, width, height),
        int(entries.number("faces")),
        entries.text("origin"),
        None if entries.is_null("score") else entries.number("score"),
    )
