"""No reader waits for a pipe, reads a device to its end, or takes time in the square of a text."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lightsim.errors import InputError
from lightsim.store.reading import read_bytes
from limits import run_limited

READ_ALL = """
from pathlib import Path
from lightsim.errors import LightSimError
from lightsim.datasets.files import read_packed, read_json
from lightsim.datasets.pandaset.rig import read_rig
from lightsim.store import artefact, arrays, exr, gltf, images, meshes, obj
from lightsim_lab.training.hdr_skies import read_split
path = Path(sys.argv[1])
readers = [
    read_json, lambda p: read_packed(p, 1 << 20), lambda p: read_rig(p.parent), images.read_srgb8,
    images.read_srgb8_alpha, images.read_grey8, images.read_grey8_alpha, images.read_size,
    images.read_hdr, images.read_sky, exr.read_exr, lambda p: meshes.read_glb(p, "world"),
    gltf.read_gltf, obj.read_obj, arrays.load_arrays, artefact.read_json, read_split,
]
for read in readers:
    try:
        read(path)
    except LightSimError as error:
        assert str(path) in str(error), error
        print(error.got)
"""
READ_RIG = """
from pathlib import Path
from lightsim.errors import InputError
from lightsim.datasets.pandaset.rig import read_rig
for folder in sorted(Path(sys.argv[1]).iterdir()):
    try:
        print(sorted(read_rig(folder).camera_from_pandar64))
    except InputError as error:
        print(error)
"""


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_every_reader_refuses_what_is_no_regular_file(tmp_path: Path, kind: str) -> None:
    # The name by which the calibration's reader finds it; the others do not mind.
    path = tmp_path / "static_extrinsic_calibration.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    finished = run_limited(READ_ALL, path, cpu_s=20, memory_mb=6000, wall_s=60)
    assert finished.output.splitlines() == ["a pipe, device or socket"] * 17


def test_files_are_read_whole_and_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, "thing", 5) == b"12345"
    with pytest.raises(InputError, match=r"a: this thing is too large, got 5 bytes"):
        read_bytes(path, "thing", 4)
    with pytest.raises(InputError, match=r"cannot open this thing, got a folder"):
        read_bytes(tmp_path, "thing", 4)
    with pytest.raises(InputError, match=r"cannot open this thing, got No such file"):
        read_bytes(tmp_path / "b", "thing", 4)
    with pytest.raises(InputError, match=r"cannot open this thing"):
        read_bytes(tmp_path / "b\0", "thing", 4)


def test_a_file_of_another_length_than_it_says_is_refused() -> None:
    """Files of the kernel are regular, and their size is 0."""
    if not Path("/proc/self/status").is_file():
        pytest.skip("no /proc")
    with pytest.raises(InputError, match="changed while it was read"):
        read_bytes(Path("/proc/self/status"), "thing", 1000)


def test_calibrations_take_time_in_proportion_to_their_length(tmp_path: Path) -> None:
    good = (
        "front_camera:\n  rotation: {w: 1, x: 0, y: 0, z: 0}\n  translation: {x: 1, y: 2, z: 3}\n"
    )
    texts = [
        good + "\n" * 500_000,
        "front_camera:\n  rotation:" + " " * 900_000 + "\n",
        good.replace("x: 1", "x: " + "1" * 900_000),
        "a" * 900_000,
        good + "w:" * 450_000,
    ]
    for i, text in enumerate(texts):
        (tmp_path / str(i)).mkdir()
        (tmp_path / str(i) / "static_extrinsic_calibration.yaml").write_text(text)
    finished = run_limited(READ_RIG, tmp_path, cpu_s=15, memory_mb=1500)
    lines = finished.output.splitlines()
    assert lines[0] == "['front_camera']"
    assert "rotation is incomplete" in lines[1]
    assert "translation is incomplete" in lines[2]
    assert "contains no sensor" in lines[3]
    assert lines[4] == "['front_camera']"


SIBLINGS = """
import numpy as np
from lightsim.datasets.pandaset.tracks import _Box, _owners
place, names = np.zeros(3), [f"{i:06d}" for i in range(60_000)]
chain = [
    _Box(0, uuid, sibling, 0, "Car", place, 0.0, place, False)
    for uuid, sibling in zip(names, [*names[1:], names[-1]])
]
print(set(_owners([chain[::-1]]).values()))
"""


def test_a_chain_of_siblings_takes_time_in_proportion_to_its_length() -> None:
    finished = run_limited(SIBLINGS, cpu_s=20, memory_mb=2000)
    assert finished.output.strip() == "{'000000'}"
