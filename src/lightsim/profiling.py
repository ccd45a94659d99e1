"""Profile of a command: processor time, wall time and memory by build stage and module.

A thread samples the stacks of all Python threads. A sample counts for the innermost module of
LightSim on a stack, so the time of a library counts for the module that calls it. Unlike a tracing
profiler this costs less than a percent, and it sees worker threads.
"""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

# Time between two samples, in seconds. Native code that holds Python's lock delays a sample; the
# whole delay then counts for the code that caused it.
_EVERY_S = 0.01
# Modules in which threads only wait for others.
_WAITING = ("threading", "queue", "selectors", "subprocess", "socket", "concurrent.futures")
_STAGES = "lightsim.build.stages."
_NOBODY = "(none)"
# Resident memory of this process in pages, on Linux.
_STATM = Path("/proc/self/statm")


@dataclass(frozen=True)
class ProfileRow:
    """Use of a module within a build stage.

    Args:
        stage: build stage; empty for work outside of stages.
        module: module, without `lightsim.`; "(none)" for waiting and for imports.
        wall_s, processor_s: time, in seconds. Modules that run at the same time share it equally.
        peak_mb: largest resident memory of the process while the module ran; 0 if unknown.
    """

    stage: str
    module: str
    wall_s: float
    processor_s: float
    peak_mb: int


class Profiler:
    """Sampler of this process, from `start` to `stop`."""

    def __init__(self) -> None:
        self._seconds: defaultdict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
        self._peak_mb: defaultdict[tuple[str, str], int] = defaultdict(int)
        self._is_over, self._lock = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._sample, name="profiler", daemon=True)

    def start(self) -> None:
        """Begin to sample."""
        self._thread.start()

    def stop(self) -> None:
        """End sampling."""
        self._is_over.set()
        self._thread.join()

    def rows(self) -> list[ProfileRow]:
        """Return what was measured so far, in order of processor time, greatest first."""
        with self._lock:
            rows = [
                ProfileRow(*key, round(wall, 2), round(processor, 2), self._peak_mb[key])
                for key, (wall, processor) in self._seconds.items()
            ]
        return sorted(rows, key=lambda row: (-row.processor_s, row.stage, row.module))

    def _sample(self) -> None:
        before = time.perf_counter(), time.process_time()
        while not self._is_over.wait(_EVERY_S):
            now = time.perf_counter(), time.process_time()
            stacks = sys._current_frames()  # pyright: ignore[reportPrivateUsage]
            stacks.pop(threading.get_ident(), None)
            main = stacks.get(threading.main_thread().ident or 0)
            # Worker threads have no stage on their own stack; it is that of the main thread.
            stage = _stage(main)
            busy = [module for stack in stacks.values() if (module := _module(stack))]
            keys = [(stage, module) for module in busy or [_NOBODY]]
            memory_mb = _resident_mb()
            with self._lock:
                for key in keys:
                    self._seconds[key][0] += (now[0] - before[0]) / len(keys)
                    self._seconds[key][1] += (now[1] - before[1]) / len(keys)
                    self._peak_mb[key] = max(self._peak_mb[key], memory_mb)
            before = now
            # A stack keeps the variables of its functions alive.
            del stacks, main


_running: Profiler | None = None


@contextmanager
def profiled() -> Generator[Profiler]:
    """Sample this process within the context; `profile_so_far` has the result meanwhile."""
    global _running
    _running = Profiler()
    _running.start()
    try:
        yield _running
    finally:
        _running.stop()
        _running = None


def profile_so_far() -> list[ProfileRow]:
    """Return the rows of the running profiler; none if the command is not profiled."""
    return [] if _running is None else _running.rows()


def profile_text(rows: Sequence[ProfileRow], most: int = 25) -> str:
    """Return an aligned table of stages, then of the modules with most processor time."""
    stages = {row.stage: [r for r in rows if r.stage == row.stage] for row in rows}
    sums = [_sum(stage or "-", "", own) for stage, own in stages.items()]
    lines = [f"{'stage':<12}  {'module':<44} {'wall s':>8} {'processor s':>12} {'peak MB':>8}"]
    for row in (_sum("total", "", rows), *(sums if len(sums) > 1 else ()), *rows[:most]):
        lines.append(
            f"{row.stage or '-':<12}  {row.module:<44} {row.wall_s:8.1f} {row.processor_s:12.1f}"
            f" {row.peak_mb:8d}"
        )
    return "\n".join(lines)


def _sum(stage: str, module: str, rows: Sequence[ProfileRow]) -> ProfileRow:
    wall_s, processor_s = sum(r.wall_s for r in rows), sum(r.processor_s for r in rows)
    return ProfileRow(stage, module, wall_s, processor_s, max((r.peak_mb for r in rows), default=0))


def _stage(stack: FrameType | None) -> str:
    while stack is not None:
        name = str(stack.f_globals.get("__name__", ""))
        if name.startswith(_STAGES):
            return name.removeprefix(_STAGES)
        stack = stack.f_back
    return ""


def _module(stack: FrameType | None) -> str:
    """Return the innermost module of LightSim on a stack; empty for a thread that waits."""
    if stack is None or str(stack.f_globals.get("__name__", "")).startswith(_WAITING):
        return ""
    while stack is not None:
        name = str(stack.f_globals.get("__name__", ""))
        if name.startswith("lightsim."):
            return name.removeprefix("lightsim.")
        stack = stack.f_back
    return ""


def _resident_mb() -> int:
    try:
        return (int(_STATM.read_text().split()[1]) * resource.getpagesize()) >> 20
    except OSError:
        return 0
