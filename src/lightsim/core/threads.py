"""Threads for native code that releases the interpreter lock: compiled loops and ray casting.

Callers do not use numba's parallel loops for this: its portable scheduler aborts the process when
two threads launch loops at the same time; its OpenMP scheduler refuses forks, and its waiting
threads compete with torch's.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="lightsim")


# A forked process inherits the pool but not its threads, and would wait for them forever.
os.register_at_fork(after_in_child=_pool.cache_clear)


def for_each(work: Callable[..., None], tasks: Sequence[tuple], workers: int) -> None:
    """Call `work(*task)` for every task, on several threads, and wait for all.

    `work` must not call this function: it would wait for threads that wait for it.
    """
    if workers == 1 or len(tasks) <= 1:
        for task in tasks:
            work(*task)
        return
    for done in [_pool(workers).submit(work, *task) for task in tasks]:
        done.result()


def for_ranges(
    work: Callable[[int, int], None],
    size: int,
    workers: int,
    *,
    smallest: int,
    largest: int | None = None,
) -> None:
    """Call `work(first, last)` on parts of [0, size), about four for each thread.

    Args:
        smallest, largest: bounds on the length of a part; the last one may be shorter.
    """
    step = max(smallest, -(-size // (4 * workers)))
    if largest is not None:
        step = min(step, largest)
    parts = [(first, min(size, first + step)) for first in range(0, size, step)]
    for_each(work, parts, workers)
