"""Rooflines come back from disk as they were, and damaged ones are refused."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.buildings import Roofline, Wall
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.rooflines import read_rooflines, write_rooflines


def _roofline(count: int) -> Roofline:
    rng = np.random.default_rng(count)
    wall = Wall(rng.normal(size=3), np.eye(3)[0], np.eye(3)[1], (-1.0, 4.0), (0.5, 9.0))
    return Roofline(
        wall,
        0.25,
        rng.normal(size=count),
        rng.uniform(size=(count, 8)).astype(np.float32),
        rng.integers(0, 8, count),
        rng.integers(0, 8, count),
        rng.uniform(size=count) > 0.5,
        rng.uniform(size=count),
        0.3,
    )


@pytest.mark.parametrize("counts", [(), (3,), (3, 5)])
def test_round_trip(tmp_path: Path, counts: tuple[int, ...]) -> None:
    rooflines = [_roofline(count) for count in counts]
    write_rooflines(tmp_path / "r.npz", rooflines)
    again = read_rooflines(tmp_path / "r.npz")
    assert len(again) == len(rooflines)
    for one, other in zip(rooflines, again, strict=True):
        for a, b in zip(astuple(one.wall), astuple(other.wall), strict=True):
            np.testing.assert_array_equal(a, b)
        for a, b in zip(astuple(one)[1:], astuple(other)[1:], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("name", "value"), [("top", 8), ("shown", -1), ("columns", 4), ("cell_m", 0), ("depth_m", -1)]
)
def test_contradictions_are_refused(tmp_path: Path, name: str, value: int) -> None:
    write_rooflines(tmp_path / "r.npz", [_roofline(3)])
    arrays = load_arrays(tmp_path / "r.npz")
    arrays[name][0] = value
    save_arrays(tmp_path / "r.npz", arrays)
    with pytest.raises(ArtefactError, match=r"r\.npz"):
        read_rooflines(tmp_path / "r.npz")
