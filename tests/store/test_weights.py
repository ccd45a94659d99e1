"""Weights and the record that they carry."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from lightsim.errors import ArtefactError, InputError
from lightsim.store.weights import (
    UNKNOWN,
    WEIGHTS_FOLDER,
    WeightsRecord,
    list_weights,
    load_weights,
    read_record,
    read_weights,
    write_weights,
)
from lightsim_lab.training.hdr_skies import read_split, split_hash
from lightsim_lab.weights import LAB_WEIGHTS_FOLDER

SPLIT = Path(__file__).parents[2] / "benchmarks" / "hdri_split.csv"
RECORD = WeightsRecord(
    description="two numbers",
    command="lightsim train sky --out 'a b'",
    training_data="45 skies",
    split_hash="0" * 64,
    seed=3,
    steps=12,
    scores={"angle_mean_deg": 1.25, "log_peak_error": None},
    licence="CC0",
    version="0.2.0",
    streets={"training": ["77", "412"], "validation": []},
)


def test_weights_and_record_come_back(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.safetensors", "b.safetensors")]
    for path in paths:
        write_weights(path, {"w": torch.tensor([0.5, -2.0])}, RECORD)
    assert read_record(paths[0]) == RECORD
    assert torch.equal(read_weights(paths[0])["w"], torch.tensor([0.5, -2.0]))
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert RECORD.line() == "two numbers; 12 steps, seed 3, lightsim 0.2.0; CC0"


def test_a_record_without_streets_is_read(tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    older = {key: value for key, value in asdict(RECORD).items() if key != "streets"}
    header = json.dumps({"__metadata__": {"record": json.dumps(older)}}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    assert read_record(path) == replace(RECORD, streets=UNKNOWN)


@pytest.mark.parametrize("header", [b"{}", b'{"__metadata__": {"record": "{}"}}', b"[1]", b"{"])
def test_weights_without_a_whole_record_are_named(header: bytes, tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(ArtefactError, match=r"old\.safetensors: the weights have no record"):
        read_record(path)


@pytest.mark.parametrize("folder", [WEIGHTS_FOLDER, LAB_WEIGHTS_FOLDER])
def test_all_shipped_weights_are_checked_and_have_a_whole_record(folder: Path) -> None:
    shipped = list_weights(folder)
    files = [file for named in shipped.values() for file in named]
    assert sorted(files) == sorted(path.name for path in folder.glob("*.safetensors"))
    for name, named in shipped.items():
        assert load_weights(name, folder)
        for file in named:
            record = read_record(folder / file)
            assert all(value or value == 0 for value in asdict(record).values()), file
            for value in (record.licence, record.version, record.training_data, record.command):
                assert value != UNKNOWN


def test_lighting_weights_have_the_committed_split() -> None:
    for name, steps in (("inpaint-small", 2500), ("sky-small", 9000)):
        record = read_record(WEIGHTS_FOLDER / f"{name}.safetensors")
        assert record.steps == steps
        # Another split would let skies into the tests that these weights have seen.
        assert record.split_hash == split_hash(read_split(SPLIT).values())


def test_other_weights_than_the_published_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no weights of this name"):
        load_weights("nothing")
    (tmp_path / "w.safetensors").write_bytes(b"changed")
    (tmp_path / "manifest.json").write_text(json.dumps({"w": {"w.safetensors": "0" * 64}}))
    with pytest.raises(InputError, match="damaged"):
        load_weights("w", tmp_path)
    (tmp_path / "w.safetensors").unlink()
    with pytest.raises(InputError, match="missing"):
        load_weights("w", tmp_path)
