"""Results of a function for many items, in order, computed ahead by threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def mapped_ahead(function: Callable[[T], R], items: Sequence[T], workers: int = 1) -> Iterator[R]:
    """Yield function(item) in the order of the items, while threads compute the next ones.

    Only functions that release Python's lock (reading, NumPy, SciPy, compiled loops) gain time.
    At most `workers` + 1 results are in memory.
    """
    coming = iter(items)
    ahead: deque[Future[R]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for _ in items:
                room = workers + 1 - len(ahead)
                ahead.extend(pool.submit(function, item) for item in islice(coming, room))
                yield ahead.popleft().result()
        finally:
            # After an error or an interruption, only what has begun is waited for.
            for future in ahead:
                future.cancel()
