"""Builds with weights of one's own, and with a field that learns from some cameras alone."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.build.test_build import CAMERAS, options
from tests.conftest import BuiltStreet

from lightsim.build.pipeline import build
from lightsim.build.status import status
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.lighting.sky.paper_network import PAPER_KIND, PaperSkyConfig, PaperSkyNetwork
from lightsim.networks.stored import stored_tensors
from lightsim.progress import SilentProgress
from lightsim.store.artefact import hash_names
from lightsim.store.images import read_exr
from lightsim.store.weights import WEIGHTS_FOLDER, read_record, write_weights


@pytest.fixture
def work(built_street: BuiltStreet) -> Path:
    return built_street.work


def states(work: Path) -> dict[str, str]:
    """State of each artefact, by stage."""
    return {stage.name: stage.state for stage in status(work)}


@pytest.mark.slow
def test_weights_of_ones_own_make_the_sky_anew_and_nothing_else(work: Path, tmp_path: Path) -> None:
    copied, weights = tmp_path / "work", tmp_path / "mine.safetensors"
    shutil.copytree(work, copied)
    config = PaperSkyConfig((8, 8, 8, 8), (8, 8, 8, 8))
    tensors = stored_tensors(PaperSkyNetwork(config, 3), config, PAPER_KIND)
    write_weights(weights, tensors, read_record(WEIGHTS_FOLDER / "sky-small.safetensors"))
    given = replace(options(), sky_weights=weights, sky_model="paper")
    build(copied, given, SilentProgress(), until="sky")
    assert states(copied)["panorama"] == states(copied)["sky"] == "made"
    assert states(copied)["twin"] == "stale"
    notes = json.loads((copied / "sky" / "artefact.json").read_text())["notes"]
    assert any("mine.safetensors" in note for note in notes)
    before, after = (read_exr(w / "sky" / "source.exr") for w in (work, copied))
    assert not np.allclose(before, after, rtol=0.1)
    # Other weights in the same file, and a file that is gone.
    weights.write_bytes((WEIGHTS_FOLDER / "sky-small.safetensors").read_bytes())
    assert states(copied)["panorama"] == "made"
    assert states(copied)["sky"] == "stale"
    weights.unlink()
    assert states(copied)["sky"] == "stale"
    with pytest.raises(InputError, match=r"mine\.safetensors"):
        build(copied, given, SilentProgress(), until="sky")


@pytest.mark.slow
def test_the_field_learns_from_the_cameras_of_its_own(work: Path, tmp_path: Path) -> None:
    copied = tmp_path / "work"
    shutil.copytree(work, copied)
    given = replace(options(), field_cameras=("left_camera",))
    build(copied, given, SilentProgress(), until="neural")
    frames = Workspace(copied).training_log.frames
    assert {frame.camera_name for frame in frames} == set(CAMERAS)
    seen = [f"{f.camera_name}/{f.stem}" for f in frames if f.camera_name == "left_camera"]
    record = read_record(copied / "neural" / "field.safetensors")
    assert record.split_hash == hash_names({"frames": seen})
    unknown = replace(options(), field_cameras=("rear_camera",))
    with pytest.raises(InputError, match=r"--field-cameras.*front_camera, left_camera"):
        build(copied, unknown, SilentProgress(), until="neural")
