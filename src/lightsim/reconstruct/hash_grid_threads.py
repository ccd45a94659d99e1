"""Threads for compiled loops that release the interpreter lock.

numba's own parallel loops are not used: its portable scheduler aborts the process when two threads
launch loops at the same time, its OpenMP one refuses forks and spins against torch's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


def thread_count() -> int:
    """As many threads as torch uses (OMP_NUM_THREADS, torch.set_num_threads)."""
    return torch.get_num_threads()


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="hash-grid")


def for_each(work: Callable[..., None], tasks: Sequence[tuple]) -> None:
    """Call `work(*task)` for every task, several at a time; returns when all are done."""
    workers = thread_count()
    if workers == 1 or len(tasks) <= 1:
        for task in tasks:
            work(*task)
        return
    for done in [_pool(workers).submit(work, *task) for task in tasks]:
        done.result()


def for_ranges(work: Callable[[int, int], None], size: int, *, smallest: int) -> None:
    """Call `work(first, last)` on parts of [0, size), about four for each thread."""
    step = max(smallest, -(-size // (4 * thread_count())))
    for_each(work, [(first, min(size, first + step)) for first in range(0, size, step)])
