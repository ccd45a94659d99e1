"""Numbers of threads."""

from __future__ import annotations

import pytest

from lightsim.core import cores


@pytest.mark.parametrize(
    ("asked", "threads"), [("", 6), ("2", 2), ("3,1", 3), ("64", 6), ("0", 6), ("many", 6)]
)
def test_workers_obey_omp_num_threads_within_the_usable_cores(
    asked: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: 6)
    monkeypatch.setenv(cores.THREADS, asked)
    assert cores.worker_count() == threads
