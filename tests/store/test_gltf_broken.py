"""Broken, truncated and hostile glTF files: an error that names the file, in bounded time."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gltf_files import BOX, BOX_FACES, QUAD, QUAD_FACES, GltfBuilder, glb, picture
from lightsim.errors import InputError
from lightsim.store import gltf, gltf_accessors, gltf_scene
from lightsim.store.gltf import read_gltf


def _draco(document: dict[str, Any]) -> None:
    for accessor in document["accessors"]:
        del accessor["bufferView"]
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}


def _meshopt(document: dict[str, Any]) -> None:
    document["buffers"] = [{"byteLength": 96}, {"byteLength": 96}]
    extension = {"EXT_meshopt_compression": {"buffer": 0}}
    document["bufferViews"][0] |= {"buffer": 1, "extensions": extension}


def _accessor(**more: Any) -> Callable[[dict[str, Any]], None]:
    return lambda d: d["accessors"][0].update(more)


def _skin(**skin: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        document["nodes"][0]["skin"] = 0
        document["skins"] = [{"joints": [0], **skin}]
        document["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 2, "WEIGHTS_0": 2}

    return change


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "required": (lambda d: d.update(extensionsRequired=["EXT_x"]), "EXT_x, expected.*Export"),
    "draco": (_draco, "KHR_draco_mesh_compression, .*gltf-transform"),
    "meshopt": (_meshopt, "EXT_meshopt_compression, .*gltf-transform"),
    "ktx2": (lambda d: d.update(extensionsRequired=["KHR_texture_basisu"]), "basisu.*PNG"),
    "version": (lambda d: d["asset"].update(version="1.0"), "it is glTF 1.0"),
    "points": (lambda d: d["meshes"][0]["primitives"][0].update(mode=0), "no triangles.*points"),
    "nothing": (lambda d: d["nodes"][0].pop("mesh"), "no triangles.*no mesh"),
    "index": (lambda d: d["accessors"][0].update(count=5), "a triangle names vertex 7, of 5"),
    "negative": (lambda d: d["nodes"][0].update(mesh=-1), r"meshes\[-1\] is named"),
    "count": (_accessor(count=10**9), "runs past"),
    "sparse": (_accessor(sparse={"count": 9}), "KeyError: 'indices'"),
    "no buffer": (lambda d: (d.update(buffers=[{"byteLength": 9}, {}]),
                             d["bufferViews"][0].update(buffer=1)), r"buffers\[1\] has no data"),
    "buffer": (lambda d: d["bufferViews"][0].update(buffer=3), r"buffers\[3\] is named"),
    "far": (lambda d: d["nodes"][0].update(scale=[1e30] * 3), "1e\\+12 or more from the origin"),
    "loop": (lambda d: d["nodes"][0].update(children=[0]), "form a loop"),
    "loop of joints": (lambda d: (_skin()(d), d["nodes"].append({"children": [0]}),
                                  d["nodes"][0].update(children=[1])), "form a loop"),
    "joint": (_skin(joints=[0]), "names no joint"),
    "no joints": (_skin(joints=[]), "a skin has 0 joints"),
    "material": (lambda d: d["meshes"][0]["primitives"][0].update(material=4), r"materials\[4\]"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "form"),
    [(case, form) for case in BROKEN for form in ("glb", "embedded")
     if form == "glb" or case not in ("meshopt", "no buffer")],  # The buffer is another one there.
)  # fmt: skip
def test_what_is_broken_is_named_with_its_file(tmp_path: Path, case: str, form: str) -> None:
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    builder.accessor(np.full((8, 4), 3), "u1")
    change, message = BROKEN[case]
    change(builder.document)
    path = builder.write(tmp_path / "model.gltf", form)
    with pytest.raises(InputError, match=rf"model\.gltf: .*{message}"):
        read_gltf(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"solid ascii", "neither glTF binary nor JSON"), (b"", "neither"), (b"\xff\xfe{", "neither"),
     (b"[]", "not a glTF document"), (b'{"asset":' * 100_000, "nested too deep|neither"),
     (struct.pack("<4sII", b"glTF", 1, 12), "glTF 1, not"), (glb(b"{}", b"")[:-3], "truncated"),
     (b" " * (17 << 20), "more than 16777216")],
)  # fmt: skip
def test_what_is_no_gltf(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.gltf").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.gltf: the model cannot be read, .*{message}"):
        read_gltf(tmp_path / "a.gltf")


def test_a_missing_buffer_is_named(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    path = builder.write(tmp_path / "my car.gltf", "separate")
    path.with_suffix(".bin").unlink()
    with pytest.raises(InputError, match=r"my car\.gltf: the model's buffer is missing.*car\.bin'"):
        read_gltf(path)


def _claims(builder: GltfBuilder) -> None:
    accessor = builder.document["accessors"][builder.primitive(BOX)["attributes"]["POSITION"]]
    del accessor["bufferView"]
    places = {"bufferView": builder.view(b"\0"), "componentType": 5121}
    values = {"bufferView": builder.view(bytes(12))}
    accessor |= {"count": 10**9, "sparse": {"count": 1, "indices": places, "values": values}}


def _copies(builder: GltfBuilder) -> None:
    builder.primitive(np.zeros((30_000, 3)), [0, 1, 2])
    moves = builder.accessor(np.zeros((900, 3)))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}}
    builder.document["nodes"][0]["extensions"] = instances


def _tree(builder: GltfBuilder) -> None:
    """Nodes of which each has the next one twice: 2 to the power of 60 places."""
    builder.primitive(QUAD, QUAD_FACES)
    nodes = [{"children": [i + 1, i + 1]} for i in range(60)]
    builder.document["nodes"] = [*nodes, {"mesh": 0}]


def _morphs(builder: GltfBuilder) -> None:
    value = builder.primitive(np.zeros((30_000, 3)), [0, 1, 2])
    value["targets"] = [{"POSITION": 0}] * 50_000
    builder.document["meshes"][0]["weights"] = [1e-9] * 50_000


@pytest.mark.parametrize("attack", [_claims, _copies, _tree, _morphs])
def test_small_files_do_not_become_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attack: Callable[[GltfBuilder], None]
) -> None:
    """The limits are lowered, so that the test is quick; without them it would take for ever."""
    monkeypatch.setattr(gltf_accessors, "_MAX_VALUES", 10**7)
    monkeypatch.setattr(gltf_scene, "_MAX_VISITS", 1000)
    builder = GltfBuilder()
    attack(builder)
    path = builder.write(tmp_path / "a.glb")
    with pytest.raises(InputError, match=r"a\.glb: .*(claims|more than|loop)"):
        read_gltf(path)


def test_a_picture_is_not_decoded_beyond_the_limit(tmp_path: Path) -> None:
    header = bytearray(picture(np.zeros((1, 1, 3))))
    header[16:24] = struct.pack(">II", 60_000, 60_000)
    header[29:33] = struct.pack(">I", zlib.crc32(header[12:29]))
    builder = GltfBuilder()
    reference = builder.texture(np.zeros((1, 1, 3)))
    builder.document["images"][0]["bufferView"] = builder.view(bytes(header))
    builder.quad({"pbrMetallicRoughness": {"baseColorTexture": reference, "metallicFactor": 0}})
    (note,) = read_gltf(builder.write(tmp_path / "a.glb")).notes
    assert note.startswith("picture 0 is not read (Image size (3600000000 pixels) exceeds")


def test_limits_count_faces_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "_MAX_FACES", 11)
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    path = builder.write(tmp_path / "a.glb")
    with pytest.raises(InputError, match="more than"):
        read_gltf(path)
