"""Artefacts of the wrong type, shape or size: named when they are read, before memory is taken."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightsim.core.dome import MAX_RADIANCE, SkyDome
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.solar import solar_position
from lightsim.core.twin import Panorama
from lightsim.errors import ArtefactError, InputError, LightSimError
from lightsim.lighting.target_sky import dome_from_array
from lightsim.reconstruct.field.config import config_from_json
from lightsim.simulation.skies import parse_time
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.assets import read_assets, read_mesh, write_mesh
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.entries import Entries
from lightsim.store.log import reading_from_json
from lightsim.store.reading import read_bytes
from lightsim.store.sky import read_panorama, write_panorama
from lightsim.store.twin import read_twin_assets
from lightsim.store.weights import read_weights


def _mesh() -> TriMesh:
    faces = np.array([[0, 1, 2]], np.int32)
    return TriMesh("world", np.eye(3, dtype=np.float32), faces, np.ones((3, 3), np.float32))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("vertices", np.zeros((3, 2), np.float32)),
        ("vertices", np.zeros((3, 3))),
        ("vertices", np.full((3, 3), np.nan, np.float32)),
        ("faces", np.zeros((1, 3), np.int64)),
        ("base_colour", np.ones((2, 3), np.float32)),
        ("confidence", np.ones(2, np.float32)),
        ("face_material", np.ones(1, np.uint8)),
        ("face_provenance", np.full(1, len(Provenance), np.uint8)),
        ("material", np.ones((2, 2))),
        ("texture", np.zeros((0, 4, 3), np.float16)),
    ],
)
def test_a_mesh_with_a_wrong_array_is_refused(tmp_path: Path, name: str, array: np.ndarray) -> None:
    path = tmp_path / "mesh.npz"
    write_mesh(path, _mesh())
    save_arrays(path, {**load_arrays(path), name: array})
    with pytest.raises(ArtefactError, match=r"mesh\.npz"):
        read_mesh(path, "world")


def test_arrays_that_claim_more_than_the_file_holds_take_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("zeros.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(80):
            member.write(bytes(1 << 24))
    with pytest.raises(InputError, match="compressed, 1342177280 bytes"):
        load_arrays(path)
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999,), }\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + bytes([len(head), 0]) + head + bytes(64))
    with pytest.raises(InputError, match="claims 8000000000071 bytes of 143"):
        load_arrays(path)


def test_what_is_no_regular_file_is_not_opened(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for read in (load_arrays, read_weights, lambda path: read_bytes(path, "mesh", 1 << 30)):
        for path in (fifo, Path("/dev/zero")):
            with pytest.raises(LightSimError, match="a pipe, device or socket"):
                read(path)
    giant = tmp_path / "giant.glb"
    with giant.open("wb") as handle:
        handle.truncate(1 << 40)
    with pytest.raises(InputError, match="too large"):
        read_bytes(giant, "mesh", 1 << 30)


def test_masks_of_another_size_are_refused(tmp_path: Path) -> None:
    seen = np.ones((4, 8), bool)
    write_panorama(tmp_path, Panorama(np.ones((4, 8, 3), np.float32), seen, seen, seen))
    path = tmp_path / "panorama.npz"
    save_arrays(path, load_arrays(path) | {"is_sky": np.ones((4, 9), bool)})
    with pytest.raises(ArtefactError, match="'is_sky' is damaged"):
        read_panorama(tmp_path)


@pytest.mark.parametrize("name", ["../x", "/x", "", ".", "..", "a\nb", "a\0b"])
def test_names_that_leave_their_folder_are_refused(tmp_path: Path, name: str) -> None:
    value = {"actors": [], "camera_gains": {}, "background": f"actors/{name}", "inferred": None}
    (tmp_path / "twin.json").write_text(json.dumps(value))
    with pytest.raises(ArtefactError, match="leads out of its folder"):
        read_twin_assets(tmp_path)


@pytest.mark.parametrize(
    "value",
    [
        [],
        {"camera_gains": 1.0, "actors": []},
        {"camera_gains": {"front": [1, 1]}, "actors": []},
        {"camera_gains": {"front": [1, 1, 0]}, "actors": []},
        {"camera_gains": {"front": [1, 1, float("nan")]}, "actors": []},
        {"camera_gains": {}, "actors": [{}]},
        {"camera_gains": {}, "actors": {}},
    ],
)
def test_broken_summaries_are_named(tmp_path: Path, value: Any) -> None:
    write_mesh(tmp_path / "background.npz", _mesh())
    (tmp_path / "assets.json").write_text(json.dumps(value))
    with pytest.raises(ArtefactError):
        read_assets(tmp_path)


def test_entries_of_another_type_are_named() -> None:
    entries = Entries({"n": "1", "flag": 1, "text": None, "big": 10**400, "yes": True}, "f.json")
    numbers = [(entries.number, key) for key in ("n", "big", "yes")]
    others = [(entries.flag, "flag"), (entries.text, "text"), (entries.object, "n")]
    for read, key in (*numbers, *others):
        with pytest.raises(ArtefactError, match=r"f\.json"):
            read(key)
    for value in (None, {}, {"source": 1}):
        with pytest.raises(ArtefactError):
            reading_from_json(value)
    with pytest.raises(ArtefactError, match="neural field"):
        config_from_json({"steps": 3})


def test_a_broken_line_of_metrics_is_named(tmp_path: Path) -> None:
    checkpointer = FolderCheckpointer(tmp_path)
    checkpointer.save({"step": 3})
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"step"\n')
    with pytest.raises(ArtefactError, match=r"metrics\.jsonl"):
        checkpointer.load()
    checkpointer.save({"steps": 3})
    with pytest.raises(ArtefactError, match=r"checkpoint\.pt"):
        checkpointer.load()


def test_skies_beyond_float_sums_are_refused() -> None:
    with pytest.raises(InputError, match="too bright"):
        dome_from_array(np.full((4, 8, 3), 3e38, np.float32), "a.hdr")
    dome = SkyDome(np.ones((4, 8, 3), np.float32), None)
    for factor in (1e300, 2 * MAX_RADIANCE, float("nan"), float("inf")):
        with pytest.raises(InputError, match="too bright"):
            dome.scaled(factor)
    with pytest.raises(InputError, match="cannot be turned"):
        dome.rotated(float("inf"))
    np.testing.assert_array_equal(dome.rotated(1e300).radiance, dome.radiance)


def test_places_and_times_that_are_none() -> None:
    for year in ("0001-01-01", "9999-12-31"):
        with pytest.raises(InputError, match="out of range"):
            parse_time(f"time:{year}")
    for latitude, longitude in ((91.0, 0.0), (float("nan"), 0.0), (0.0, float("inf"))):
        with pytest.raises(InputError, match="latitude or longitude is out of range"):
            solar_position(latitude, longitude, 0)


def test_a_message_is_one_line_that_steers_no_terminal() -> None:
    text = str(InputError("broken", where="a\nb\x1b[2J", got="x" * 10_000))
    assert text.isprintable()
    assert len(text) < 1200
