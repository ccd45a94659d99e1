"""Prefetching of training batches by threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class Prefetcher(Generic[T]):
    """Computes the items of a numbered sequence in threads before they are requested.

    Args:
        make: function from number to item; it must be safe to call from several threads.
        workers: threads, each with one item in advance; 0 computes an item when it is requested.
        stride: difference of successive requests (of several interleaved sequences).
        stop: exclusive upper limit of the numbers.
    """

    def __init__(self, make: Callable[[int], T], workers: int, stride: int, stop: int) -> None:
        self._make = make
        self._pool = ThreadPoolExecutor(workers) if workers else None
        self._stride, self._stop = stride, stop
        self._reach = stride * (workers + 1)
        self._coming: dict[int, Future[T]] = {}

    def get(self, number: int) -> T:
        """Return the item of a number, once, and start the computation of the following items."""
        if self._pool is None:
            return self._make(number)
        # Each worker has one item in progress, so that memory does not grow with the wait.
        for later in range(number, min(number + self._reach, self._stop), self._stride):
            if later not in self._coming:
                self._coming[later] = self._pool.submit(self._make, later)
        return self._coming.pop(number).result()

    def __enter__(self) -> Prefetcher[T]:
        return self

    def __exit__(self, *error: object) -> None:
        # Items not yet started are cancelled after an error or an early end.
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
