"""Whole files: nothing half written stays, and a full disk is one clear error."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lightsim.errors import ArtefactError, LightSimError
from lightsim.store.atomic import partial_name, sweep_partials, whole_file

FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from lightsim.errors import ArtefactError
from lightsim.store.arrays import save_arrays
from lightsim.store.artefact import write_text
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.images import write_exr, write_png
from lightsim.store.mp4 import Mp4Writer
from lightsim.store.weights import WeightsRecord, write_weights
import torch
folder = Path(sys.argv[1])
noise = np.random.default_rng(0).random((256, 512, 3)).astype(np.float32)
tensor = {"step": 0, "noise": torch.from_numpy(noise)}
def film(path):
    with Mp4Writer(path, 512, 256, 10.0) as video:
        for _ in range(8):
            video.write((noise * 255).astype(np.uint8))
writers = {
    "a.exr": lambda p: write_exr(p, noise),
    "a.png": lambda p: write_png(p, (noise * 255).astype(np.uint8)),
    "a.npz": lambda p: save_arrays(p, {"noise": noise}),
    "a.safetensors": lambda p: write_weights(
        p, {"noise": torch.from_numpy(noise)}, WeightsRecord(*"noise by hand".split(), *[""] * 6)
    ),
    "checkpoint.pt": lambda p: FolderCheckpointer(p.parent).save(tensor),
    "a.txt": lambda p: write_text(p, "x" * 500_000),
    "a.mp4": film,
}
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
for name, write in writers.items():
    try:
        write(folder / name)
        print(name, "was written")
    except ArtefactError as error:
        assert name in str(error), error
        assert "MB left" in str(error), error
print("left:", sorted(p.name for p in folder.iterdir()))
"""


def test_a_full_disk_is_our_error_whatever_is_written(tmp_path: Path) -> None:
    """A limit on the size of files fails like a full disk, in the middle of a write."""
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)], capture_output=True, text=True
    )
    assert done.stdout == "left: []\n", done.stdout + done.stderr


def test_a_failing_writer_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    for failure, seen in ((ZeroDivisionError(), ZeroDivisionError), (OSError(28), ArtefactError)):
        with pytest.raises(seen):
            write_half(path, failure)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def write_half(path: Path, failure: Exception) -> None:
    with whole_file(path) as temporary:
        temporary.write_text("half of the n")
        raise failure


def test_our_own_errors_pass_unchanged(tmp_path: Path) -> None:
    ours = LightSimError("a reason")
    with pytest.raises(LightSimError) as caught, whole_file(tmp_path / "a"):
        raise ours
    assert caught.value is ours


def test_what_killed_processes_left_is_swept_and_nothing_else(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / "deep").mkdir()
    mine = partial_name(tmp_path / "deep" / "01.exr")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}.", f"-{ended.pid}."))
    of_another_machine = tmp_path / f".01.otherhost-{ended.pid}.partial.exr"
    for path in (mine, dead, of_another_machine, tmp_path / ".partial", tmp_path / ".x.partial.y"):
        path.write_bytes(np.zeros(3).tobytes())
    sweep_partials(tmp_path)
    assert not dead.exists()
    assert len(list(tmp_path.rglob("*"))) == 5
