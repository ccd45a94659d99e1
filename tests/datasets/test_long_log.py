"""The benchmark's long log: there and back, every sensor where it stood when it recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.long_log import Drive, make_log

from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim_lab.synthetic import shipped_street


def test_frames_come_there_back_and_there_again_in_time() -> None:
    drive = Drive((42, 43, 44, 45), 42_000, 45_000, 9)
    assert drive.visits == [
        (42, 0), (43, 0), (44, 0), (45, 0), (44, 1), (43, 1), (42, 1), (43, 2), (44, 2),
    ]  # fmt: skip
    times_ns = [drive.time_ns(1000 * number, way) for number, way in drive.visits]
    assert times_ns == [1000 * i for i in range(42, 51)]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[DrivingLog, DrivingLog]:
    """The shipped street, and 24 frames made of its 10."""
    source, folder = shipped_street() / "log", tmp_path_factory.mktemp("long") / "log"
    make_log(source, folder, 24)
    short, long = (LogReading(source=str(p), cameras=("left_camera",)) for p in (source, folder))
    return read_log(short), read_log(long)


@pytest.mark.slow
def test_mirrored_sensors_stand_where_they_recorded(logs: tuple[DrivingLog, DrivingLog]) -> None:
    short, long = logs
    numbers = [*range(10), *range(8, -1, -1), *range(1, 6)]
    assert [f.stem for f in long.frames] == [f"{i:02d}" for i in range(24)]
    assert (np.diff([f.time_ns for f in long.frames]) > 0).all()
    assert (np.diff([s.time_ns for s in long.sweeps]) > 0).all()
    for frame, number in zip(long.frames, numbers, strict=True):
        recorded = short.frames[number].world_from_camera.matrix
        np.testing.assert_allclose(frame.world_from_camera.matrix, recorded, atol=1e-12)
    for i in (12, 21):
        sweep, recorded = long.sweeps[i].load(), short.sweeps[numbers[i]].load()
        np.testing.assert_array_equal(sweep.points_world, recorded.points_world)
        np.testing.assert_array_equal(sweep.origins_world, recorded.origins_world)


def test_a_long_log_is_made_once(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    make_log(tmp_path / "nowhere", tmp_path / "log", 80)
    assert not any((tmp_path / "log").iterdir())
