"""Where the time of a command goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import CodeType

from lightsim.profiling import profile_so_far, profile_text, profiled

_BUSY = """
def busy(seconds):
    end = clock() + seconds
    while clock() < end:
        pass
def call(inner, seconds):
    inner(seconds)
"""


def module(name: str, clock: Callable[[], float]) -> dict[str, object]:
    """Return the names of a module `lightsim.NAME` with functions that keep a core busy."""
    code: CodeType = compile(_BUSY, name, "exec")
    names: dict[str, object] = {"__name__": f"lightsim.{name}", "clock": clock}
    exec(code, names)
    return names


def test_time_counts_for_the_innermost_module_and_the_stage_of_the_main_thread() -> None:
    thread_s = time.thread_time
    one, other = module("one", thread_s)["busy"], module("other", thread_s)["busy"]
    library = {**module("", thread_s), "__name__": "numpy.linalg"}
    exec(compile(_BUSY, "library", "exec"), library)
    stage, caller = (
        module("build.stages.twin", thread_s)["call"],
        module("caller", thread_s)["call"],
    )
    assert callable(one)
    assert callable(other)
    assert callable(stage)
    assert callable(caller)
    with profiled() as profiler:
        one(0.2)
        stage(one, 0.4)
        caller(library["busy"], 0.2)
        worker = threading.Thread(target=other, args=(0.4,))
        worker.start()
        stage(lambda _: worker.join(), 0.0)
        assert profile_so_far()
    assert profile_so_far() == []
    found = {(row.stage, row.module): row for row in profiler.rows()}
    wanted = {("", "one"): 0.2, ("twin", "one"): 0.4, ("", "caller"): 0.2, ("twin", "other"): 0.4}
    for key, seconds in wanted.items():
        # Some samples of 10 ms, and what other programs take from this core.
        assert abs(found[key].processor_s - seconds) < 0.12, (key, found)
        assert found[key].peak_mb > 1
    total = sum(row.processor_s for row in profiler.rows())
    assert abs(total - sum(wanted.values())) < 0.2
    assert "twin" in profile_text(profiler.rows())
