"""Sweeps are decoded once while there is room; one form of each is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.kept_sweeps import KeptSweeps
from lightsim.core.sensors import LazySweep, LidarSweep

_BYTES = 100 * (3 + 3 + 1 + 1) * 4 + 100 * 2 * 2


def counted(stem: str, decoded: list[str]) -> LazySweep:
    def load() -> LidarSweep:
        decoded.append(stem)
        xyz, one = np.ones((100, 3), np.float32), np.ones(100, np.float32)
        ring = np.zeros(100, np.int16)
        return LidarSweep(stem, 0, xyz, xyz.copy(), one, one.copy(), ring, ring.copy())

    return LazySweep(stem, 0, load)


def test_each_sweep_is_decoded_once_and_its_arrays_cannot_be_changed() -> None:
    decoded: list[str] = []
    sweeps = KeptSweeps(2 * _BYTES).of((counted("00", decoded), counted("01", decoded)))
    first, *_ = [[s.load() for s in sweeps] for _ in range(3)]
    assert decoded == ["00", "01"]
    with pytest.raises(ValueError, match="read-only"):
        first[0].points_world[0] = 0


def test_what_finds_no_room_is_decoded_anew_and_pushes_nothing_out() -> None:
    decoded: list[str] = []
    sweeps = KeptSweeps(_BYTES).of((counted("00", decoded), counted("01", decoded)))
    for sweep in sweeps * 3:
        sweep.load()
    assert decoded == ["00", "01", "01", "01"]


def test_the_aligned_form_takes_the_place_of_the_recorded_one() -> None:
    decoded: list[str] = []
    kept = KeptSweeps(_BYTES)
    (recorded,) = kept.of((counted("00", decoded),))
    moved: list[str] = []

    def load_moved() -> LidarSweep:
        moved.append("00")
        return replace(recorded.load(), points_world=recorded.load().points_world + 1)

    (aligned,) = kept.of((replace(recorded, load=load_moved),))
    recorded.load()
    assert [float(aligned.load().points_world[0, 0]) for _ in range(3)] == [2.0] * 3
    assert decoded == moved == ["00"]
    assert float(recorded.load().points_world[0, 0]) == 1.0
