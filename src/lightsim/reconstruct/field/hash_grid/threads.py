"""Threads for compiled loops that release the interpreter lock.

numba's parallel loops are not used: its portable scheduler aborts the process when two threads
launch loops at the same time; its OpenMP scheduler refuses forks, and its waiting threads compete
with torch's.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="hash-grid")


# A forked process inherits the pool but not its threads, and would wait for them forever.
os.register_at_fork(after_in_child=_pool.cache_clear)


def for_each(work: Callable[..., None], tasks: Sequence[tuple]) -> None:
    """Call `work(*task)` for every task, on as many threads as torch, and wait for all."""
    workers = torch.get_num_threads()
    if workers == 1 or len(tasks) <= 1:
        for task in tasks:
            work(*task)
        return
    for done in [_pool(workers).submit(work, *task) for task in tasks]:
        done.result()


def for_ranges(work: Callable[[int, int], None], size: int, *, smallest: int) -> None:
    """Call `work(first, last)` on parts of [0, size), about four for each thread."""
    step = max(smallest, -(-size // (4 * torch.get_num_threads())))
    for_each(work, [(first, min(size, first + step)) for first in range(0, size, step)])
