"""Shipped relighting weights learned from nothing that chooses or tests."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lightsim.store.weights import WeightsRecord, read_record
from lightsim_lab.baselines.methods import ALL_METHODS
from lightsim_lab.studies.benchmark_options import held_out_names
from lightsim_lab.training.hdr_skies import read_split

SPLIT = Path(__file__).resolve().parents[3] / "benchmarks" / "hdri_split.csv"
OF_STREETS = {"low_sun", "high_sun", "overcast"}
OF_UNKNOWN_LICENCE = {"invrender_envmap12_park", "unk_hemisky_black_ground"}
"""On no side; NOTICE says that the relighting network has seen them."""


@pytest.mark.parametrize("method", ["network", "paper"])
def test_skies_that_taught_are_of_the_training_side(method: str) -> None:
    """Weights that a hand-made data set taught once had seen two skies of the test side."""
    lists = re.findall(r"target skies: ([^;]*)", _record(method).training_data)
    named = {sky for names in lists for sky in names.split(", ")}
    sides = read_split(SPLIT)
    skies = {sky for sky in named - OF_STREETS if not sky.startswith("drawn_")}
    assert skies
    # Two skies of unknown licence have left the training side since.
    assert {sides[sky].split for sky in skies - OF_UNKNOWN_LICENCE} == {"train"}
    assert {sides[sky].split for sky in skies & OF_UNKNOWN_LICENCE} <= {"out"}
    notice = (SPLIT.parents[1] / "NOTICE").read_text()
    assert all(sky in notice for sky in skies)


SHIPPED = [name for name, method in ALL_METHODS.items() if method.weights_name]


@pytest.mark.parametrize("name", SHIPPED)
def test_streets_that_taught_are_not_measured_on(name: str) -> None:
    streets = _record(name).streets
    assert isinstance(streets, dict)
    assert streets["training"]
    assert not held_out_names() & set(streets["training"])


def _record(name: str) -> WeightsRecord:
    path = ALL_METHODS[name].shipped_file()
    assert path is not None
    return read_record(path)
